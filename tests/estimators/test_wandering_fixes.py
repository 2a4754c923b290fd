"""Fixes whose errors last for seconds: through the door into the filter, and its NEES."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.aiding import GnssAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import FIX_MARKOV
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.intake import Intake
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Leg, follow
from fusiond.studies.monte_carlo import nees_interval
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error
from tests import runs

RATE_HZ, FIX_HZ, SECONDS, RUNS = 50.0, 10.0, 150.0, 24
IMU = Imu(
    rate_hz=RATE_HZ,
    sensor_class="mems",
    gyro_bias_initial_deg_h=36.0,
    accel_bias_initial_mg=2.0,
    misalignment_deg=0.0,
)
WANDERS_M, NOISE_M, VELOCITY_SD_M_S = 2.5, 0.8, 0.05
STATED_M = math.hypot(WANDERS_M, NOISE_M)
AIDING = GnssAiding(lever_arm_m=(0.0, 0.0, 0.0))
START_SD = np.array([*np.radians([0.3, 0.3, 1.0]), 0.1, 0.1, 0.1, 3.0, 3.0, 5.0])
LEGS = (
    Leg(6.0, speed_m_s=12.0),
    Leg(20.0),
    Leg(6.0, turn_deg=80.0),
    Leg(15.0),
    Leg(8.0, speed_m_s=0.0),
    Leg(10.0),
    Leg(8.0, speed_m_s=15.0),
    Leg(7.0, turn_deg=-70.0),
    Leg(SECONDS),
)


def _nees(seed: int, lasts_s: float) -> tuple[float, float]:
    """Of position and velocity, horizontal, means of the last minute."""
    rng = np.random.default_rng([5, seed])
    path = follow(LEGS, SECONDS, course_deg=float(rng.uniform(0.0, 360.0)))
    truth = Truth(path, runs.ORIGIN, RATE_HZ, SECONDS)
    sensed = imu_output(IMU, truth.gyro, truth.accel, rng)
    imu = ImuBuffer(RATE_HZ, SECONDS + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(runs.sample_times(truth), np.hstack([sensed.gyro, sensed.accel]))
    intake = Intake({"gnss": AIDING})
    model = make_model("ins15", imu_noise(IMU), *intake.extra_blocks())
    filter_ = KalmanEstimator(model, 0.5)
    sd = model.initial.copy()
    sd[:9] = START_SD
    begin = with_error(true_nav(truth, np.array([0.0]))[0], rng.standard_normal(9) * START_SD)
    filter_.initialise(0, 0, begin, np.zeros(model.size), np.diag(sd**2))
    t_s = np.arange(0.503, SECONDS - 0.5, 1.0 / FIX_HZ)
    n, step = len(t_s), 1.0 / FIX_HZ
    late, late_v = (rng.standard_normal(2) * AIDING.time_offset_sd_s).tolist()
    there = truth.at(t_s + late)
    error = gauss_markov(rng, (n, 3), step_s=step, correlation_s=lasts_s, sigma=WANDERS_M)
    error += gauss_markov(rng, (n, 3), step_s=step, correlation_s=1800.0, sigma=1.0)
    error += rng.standard_normal((n, 3)) * NOISE_M
    v = truth.at(t_s + late_v).v_ned + rng.standard_normal((n, 3)) * VELOCITY_SD_M_S
    found = []
    for k, t in enumerate(t_s.tolist()):
        lat, lon, height = there.position[k].tolist()
        lat, lon, height = (
            there.position[k] + error[k] / metres_per_unit(float(lat), float(height))
        ).tolist()
        north, east, down = v[k].tolist()
        t_ns = round(t * 1e9)
        fix = PositionFix(
            "gnss",
            t_ns,
            MonotonicStamp(t_ns),
            lat,
            lon,
            height,
            sd_ned_m=(STATED_M,) * 3,
            v_ned_m_s=(north, east, down),
            sd_v_ned_m_s=(VELOCITY_SD_M_S,) * 3,
        )
        measurements = intake.measurements_of(fix, t_ns, 0.0)
        assert not isinstance(measurements, str)
        filter_.propagate(imu, t_ns)
        for measurement in measurements:
            filter_.update(measurement)
        if t > SECONDS - 60.0 and k % 50 == 0:
            off = nav_error(filter_.nav, true_nav(truth, np.array([t]))[0])
            p = filter_.covariance
            found.append(
                [
                    off[part] @ np.linalg.solve(p[part, part], off[part])
                    for part in (slice(6, 8), slice(3, 5))
                ]
            )
    assert model.slots_of(FIX_MARKOV)
    position, velocity = np.mean(found, axis=0)
    return float(position), float(velocity)


@pytest.mark.parametrize("lasts_s", [12.0, 30.0])
def test_sigma_is_honest_of_errors_that_last_for_seconds(lasts_s: float) -> None:
    nees = np.mean([_nees(seed, lasts_s) for seed in range(RUNS)], axis=0)
    _, high = nees_interval(RUNS, 2, 0.005)
    print(f"NEES of two, position {nees[0]:.2f}, velocity {nees[1]:.2f}, at most {high:.2f}")
    assert nees[0] < high
    assert nees[1] < high
