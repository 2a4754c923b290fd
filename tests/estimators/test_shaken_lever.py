"""The noise of a gyro turns nothing: it tells no lever arm."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    AXLE_LEVER,
    antenna_lever_block,
    axle_lever_block,
)
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, follow
from fusiond.studies.navigation_error import true_nav
from tests import runs

RATE_HZ, SECONDS = 100.0, 60.0
IMU = Imu(sensor_class="mems", rate_hz=RATE_HZ)
SHAKEN_RAD_S = 1.0 * DEG
"""Of a sample: an engine and a road, ten times as much as the sheet says."""
NOISE = replace(imu_noise(IMU), rate_noise=SHAKEN_RAD_S / math.sqrt(RATE_HZ))
MODEL = make_model("ins15", NOISE, antenna_lever_block(ANTENNA_LEVER, 1.0), axle_lever_block(1.0))
VELOCITY_SD_M_S, SLIP_SD_M_S = (0.05,) * 3, 0.02
ARM = (0.0, 0.0, 0.0)
LEVER, AXLE_M = np.array([1.2, -0.5, -1.5]), -1.5


def _driven(turn_deg: float) -> tuple[KalmanEstimator, list[int], list[int]]:
    """The filter after a minute at 10 m/s, and the slots of both lever arms."""
    rng = np.random.default_rng(11)
    legs = [Leg(3.0, 10.0), Leg(2.0), *(Leg(8.0, turn_deg=turn) for turn in (turn_deg, -turn_deg))]
    path = follow([*legs, Leg(SECONDS)], SECONDS, course_deg=30.0)
    path = replace(path, arm_m=(-AXLE_M, 0.0, 0.0))
    truth = Truth(path, runs.ORIGIN, RATE_HZ, SECONDS)
    gyro = truth.gyro + rng.standard_normal(truth.gyro.shape) * SHAKEN_RAD_S
    imu = ImuBuffer(RATE_HZ, SECONDS + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(runs.sample_times(truth), np.hstack([gyro, truth.accel]))
    filter_ = KalmanEstimator(MODEL, 0.5)
    sd = MODEL.initial.copy()
    sd[:9] = np.repeat([0.2 * DEG, 0.02, 0.5], 3)
    begin = true_nav(truth, np.array([0.0]))[0]
    filter_.initialise(0, 0, begin, np.zeros(MODEL.size), np.diag(sd**2))
    t_s = np.arange(0.103, SECONDS - 0.5, 0.1)
    moving = truth.at(t_s, (float(LEVER[0]), float(LEVER[1]), float(LEVER[2]))).v_ned
    moving = moving + rng.standard_normal(moving.shape) * VELOCITY_SD_M_S
    for k, t_ns in enumerate(np.rint(t_s * 1e9).astype(np.int64).tolist()):
        filter_.propagate(imu, t_ns)
        north, east, down = moving[k].tolist()
        v = north, east, down
        filter_.update(
            VelocityMeasurement("velocity", t_ns, 1.0, v, VELOCITY_SD_M_S, ARM, rest=ANTENNA_LEVER)
        )
        filter_.update(NonHolonomicConstraint("slip", t_ns, 1.0, SLIP_SD_M_S, 0.05, 2.0, ARM))
    lever, axle = MODEL.slots_of(ANTENNA_LEVER), MODEL.slots_of(AXLE_LEVER)
    return filter_, list(lever), list(axle)


def test_a_straight_way_tells_no_lever() -> None:
    filter_, lever, axle = _driven(0.0)
    sd = np.sqrt(np.diag(filter_.covariance)[lever + axle])
    off = np.append(LEVER, AXLE_M) - filter_.xi[lever + axle]
    print(f"sigma {sd}, off {off}")
    assert (sd > 0.6).all()
    assert (np.abs(off) < 3.0 * sd).all()


@pytest.mark.parametrize("turn_deg", [90.0, -90.0])
def test_bends_tell_it(turn_deg: float) -> None:
    filter_, lever, axle = _driven(turn_deg)
    seen = [*lever[:2], *axle]  # up is told by pitch and roll alone
    sd = np.sqrt(np.diag(filter_.covariance)[seen])
    off = np.array([*LEVER[:2], AXLE_M]) - filter_.xi[seen]
    print(f"sigma {sd}, off {off}")
    assert (sd < 0.1).all()
    assert (np.abs(off) < 3.0 * sd).all()
