"""A vehicle met straight on, by gyros that nobody has calibrated: nothing tells its tilt."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import mounting_block
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Path, Profile
from fusiond.studies.monte_carlo import nees_interval
from fusiond.studies.navigation_error import nav_error, true_nav, with_error
from tests import runs

Array = NDArray[np.float64]

RATE_HZ, SECONDS, RUNS = 100.0, 20.0, 24
IMU = Imu(rate_hz=RATE_HZ, sensor_class="consumer", misalignment_deg=0.0)
G = 9.8
FORCE_SD, RATE_SD = 0.05 * G, 3.0 * DEG
"""Of the class: a bias of 50 mg is a tilt of 2.9 deg, and a turn at 3 deg/s passes for none."""
SUM_SD, TURN_SD, HEADING_SD = 0.02, 0.1 * DEG, 0.3 * DEG
"""What a start leaves of what moves the vehicle (m/s^2), of its change (rad/s), of the heading:
what that tells while it turns is asked elsewhere (test_tilt_axes)."""
ACROSS = np.array([[0.0, -1.0], [1.0, 0.0]])
VELOCITY_SD = (0.05, 0.05, 0.05)
ARM = (0.0, 0.0, 0.0)


def _tilt_nees(seed: int) -> float:
    rng = np.random.default_rng([61, seed])
    course = Profile([0.0], [float(rng.uniform(0.0, 2.0 * math.pi))])
    path = Path(Profile([0.0], [25.0]), course, Profile([0.0], [0.0]))
    truth = Truth(path, runs.ORIGIN, RATE_HZ, SECONDS)
    sensed = imu_output(IMU, truth.gyro, truth.accel, rng)
    imu = ImuBuffer(RATE_HZ, SECONDS + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(runs.sample_times(truth), np.hstack([sensed.gyro, sensed.accel]))
    model = make_model("ins21", imu_noise(IMU), mounting_block(3.0 * DEG))
    nav = true_nav(truth, np.array([0.0]))[0]
    c = dcm_from_quaternion(nav[6:])
    # True minus estimated: what a level attitude and sensors without errors are taken to be off by.
    force, rate = sensed.accel_bias[0], sensed.gyro_bias[0]
    turn = float((c @ rate)[2])
    # g z x t = C b makes the force's error show nothing; the fit has each t with e = -w z x t.
    tilt = -ACROSS @ (c @ force)[:2] / G + rng.standard_normal(2) * SUM_SD / G
    error = np.zeros(9)
    error[:2], error[2] = tilt, rng.standard_normal() * HEADING_SD
    error[3:6] = rng.standard_normal(3) * 0.05
    error[6:9] = rng.standard_normal(3)
    xi = np.zeros(model.size)
    gyros, forces = ([model.parameters(first + k)[0] for k in range(3)] for first in (9, 12))
    told = rate.copy()
    told += c[:2].T @ (rng.standard_normal(2) * TURN_SD) - (c[2] @ rate) * c[2]
    xi[gyros] = told  # its horizontal part is known, with the turn that is taken for true
    filter_ = TiltAxesFilter(model, 0.5)
    by = np.eye(model.size)
    by[:2][:, forces] = -ACROSS @ c[:2] / G
    by[np.ix_(gyros, range(model.size))] += c[:2].T @ (-turn * ACROSS @ by[:2])
    sd = model.initial.copy()
    sd[:9] = [SUM_SD / G, SUM_SD / G, HEADING_SD, 0.05, 0.05, 0.05, 1.0, 1.0, 1.0]
    sd[forces] = FORCE_SD
    prior = np.diag(sd**2)
    spread = np.diag([TURN_SD**2, TURN_SD**2, RATE_SD**2])
    prior[np.ix_(gyros, gyros)] = c.T @ spread @ c
    filter_.initialise(0, 0, with_error(nav, error), xi, by @ prior @ by.T)
    t_s = np.arange(0.103, SECONDS - 0.2, 0.1)
    v = truth.at(t_s).v_ned + rng.standard_normal((len(t_s), 3)) * VELOCITY_SD
    for k, t_ns in enumerate(np.rint(t_s * 1e9).astype(np.int64).tolist()):
        filter_.propagate(imu, t_ns)
        north, east, down = v[k].tolist()
        filter_.update(VelocityMeasurement("v", t_ns, 1.0, (north, east, down), VELOCITY_SD, ARM))
        filter_.update(NonHolonomicConstraint("slip", t_ns, 1.0, 0.1, 0.2, 2.0, ARM))
    off = nav_error(filter_.nav, true_nav(truth, np.array([t_s[-1]]))[0])[:2]
    return float(off @ np.linalg.solve(filter_.covariance[:2, :2], off))


def test_a_turn_that_was_none_tells_no_tilt() -> None:
    nees = float(np.mean([_tilt_nees(seed) for seed in range(RUNS)]))
    low, high = nees_interval(RUNS, 2, 0.005)
    print(f"NEES of two {nees:.2f}, {low:.2f} to {high:.2f}")
    assert low < nees < high
