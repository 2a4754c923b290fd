"""Cars whose lever arm nobody has measured, with fixes of centimetres: the filter stays honest.

What each correction of the attitude would tell of the lever, and is no turn, is carried over
(fusiond.estimators.antenna_position_after_attitude_update).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.attitude import AttitudeMeasurement, HeadingMeasurement
from fusiond.aiding.base import Innovation, State
from fusiond.aiding.body_velocity import NonHolonomicConstraint
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.antenna_position_after_attitude_update import antenna_slots, keep_antenna
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    FIX_TIME,
    antenna_lever_block,
    time_offset_block,
)
from fusiond.navigation.error_model import DR, PHI
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion, quaternion_from_rpy
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import drive
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error
from tests import runs
from tests.estimators.monte_carlo import interval

Array = NDArray[np.float64]

RATE_HZ, SECONDS, CARS = 50.0, 60, 24
IMU = Imu(sensor_class="mems", rate_hz=RATE_HZ, misalignment_deg=0.0)
LEVER_SD_M, LATE_SD_S = 1.0, 0.02
START_SD = np.array([*np.radians([1.0, 1.0, 3.0]), 0.1, 0.1, 0.1, 0.02, 0.02, 0.04])
FIX_SD_M, VELOCITY_SD_M_S = (0.02, 0.02, 0.04), 0.05
ARM = (0.0, 0.0, 0.0)


def _model() -> Model:
    lever = antenna_lever_block(ANTENNA_LEVER, LEVER_SD_M)
    return make_model("ins21", imu_noise(IMU), lever, time_offset_block(FIX_TIME, LATE_SD_S))


def _fix(t_ns: int, place: Array) -> PositionMeasurement:
    lat, lon, height = (float(x) for x in place)
    return PositionMeasurement(
        "fix", t_ns, 1.0, lat, lon, height, FIX_SD_M, ARM, time=FIX_TIME, rest=ANTENNA_LEVER
    )


@cache
def _nees(kind: type[KalmanEstimator], number: int) -> tuple[float, float]:
    """NEES (3 degrees each) of the lever arm and of the position at the end of one car's drive."""
    rng = np.random.default_rng([710, number])
    model = _model()
    truth = Truth(drive(SECONDS + 1.0, 4.0), runs.ORIGIN, RATE_HZ, SECONDS)
    sensed = imu_output(IMU, truth.gyro, truth.accel, rng)
    imu = ImuBuffer(RATE_HZ, SECONDS + 2.0, np.eye(3), 0.0, 0.5)
    imu.append(runs.sample_times(truth), np.hstack([sensed.gyro, sensed.accel]))
    lever = rng.standard_normal(3) * LEVER_SD_M
    late_s = float(rng.standard_normal()) * LATE_SD_S
    sd = model.initial.copy()
    sd[:9] = START_SD
    begin = true_nav(truth, np.array([0.0]))[0]
    # As a start makes it: the place is the antenna's, less a lever of none.
    off = rng.standard_normal(9) * START_SD
    slots, _ = antenna_slots(model)
    placed = np.eye(model.size)
    placed[DR : DR + 3, slots] = dcm_from_quaternion(begin[6:])
    off[DR:] += dcm_from_quaternion(begin[6:]) @ lever
    filter_ = kind(model, 0.5)
    p = placed @ np.diag(sd**2) @ placed.T
    filter_.initialise(0, 0, with_error(begin, off), np.zeros(model.size), p)
    t_s = np.arange(1.003, SECONDS - 0.5, 0.5)
    arm = (float(lever[0]), float(lever[1]), float(lever[2]))
    seen, moving = truth.at(t_s + late_s, arm), truth.at(t_s, arm)
    for k, t_ns in enumerate(np.rint(t_s * 1e9).astype(np.int64).tolist()):
        filter_.propagate(imu, t_ns)
        to_metres = metres_per_unit(float(seen.position[k, 0]), float(seen.position[k, 2]))
        north, east, down = moving.v_ned[k] + rng.standard_normal(3) * VELOCITY_SD_M_S
        sd_v = (VELOCITY_SD_M_S,) * 3
        velocity = VelocityMeasurement(
            "velocity", t_ns, 1.0, (north, east, down), sd_v, ARM, rest=ANTENNA_LEVER
        )
        filter_.update(velocity)
        filter_.update(_fix(t_ns, seen.position[k] + rng.standard_normal(3) * FIX_SD_M / to_metres))
        filter_.update(NonHolonomicConstraint("slip", t_ns, 1.0, 0.05, 0.05, 1.0, ARM))
    end_s = SECONDS - 0.5
    filter_.propagate(imu, round(end_s * 1e9))
    left = nav_error(filter_.nav, true_nav(truth, np.array([end_s]))[0])[DR:]
    rest = lever - filter_.xi[slots]
    p = filter_.covariance
    of_lever, of_place = p[np.ix_(slots, slots)], p[DR : DR + 3, DR : DR + 3]
    return (
        float(rest @ np.linalg.solve(of_lever, rest)),
        float(left @ np.linalg.solve(of_place, left)),
    )


def test_a_corrected_attitude_tells_nothing_of_the_lever() -> None:
    total = np.sum([_nees(TiltAxesFilter, number) for number in range(CARS)], axis=0)
    low, high = interval(3 * CARS, 0.99)
    print(
        f"NEES a degree {total / (3 * CARS)}, 99 %: {low / (3 * CARS):.2f}, {high / (3 * CARS):.2f}"
    )
    assert (total >= low).all()
    assert (total <= high).all()


def test_the_plain_filter_takes_it_for_a_turn() -> None:
    """The cars are such that it matters: sigma is too small."""
    total = np.sum([_nees(KalmanEstimator, number) for number in range(CARS)], axis=0)
    assert (total > 2.0 * 3 * CARS).all()


def _known_m(filter_: KalmanEstimator) -> Array:
    """One sigma (3,) of where the filter takes the antenna to be."""
    nav, n = filter_.nav, filter_.model.size
    state = State(nav, filter_.xi, np.zeros(STEP_SIZE), filter_.model, np.zeros((n, n)))
    found = _fix(0, nav[:3]).innovation(state)
    assert isinstance(found, Innovation)
    return np.sqrt(np.diag(found.h @ filter_.covariance @ found.h.T))


def _at_speed(lever: tuple[float, float, float]) -> TiltAxesFilter:
    """At 20 m/s, one fix after a start: the antenna's place is known, its lever arm is not."""
    model = _model()
    filter_ = TiltAxesFilter(model, 0.5)
    nav = runs.level_nav((0.02, -0.01, 0.7), (15.0, 13.0, 0.0))
    sd = model.initial.copy()
    sd[:9] = [*np.radians([1.0, 1.0, 3.0]), 0.5, 0.5, 0.5, 10.0, 10.0, 10.0]
    xi = np.zeros(model.size)
    xi[antenna_slots(model)[0]] = lever
    filter_.initialise(0, 0, nav, xi, np.diag(sd**2))
    assert filter_.update(_fix(0, nav[:3])).name == "fused"
    return filter_


@pytest.mark.parametrize("lever", [ARM, (0.8, -0.5, -1.3)])
def test_the_place_of_the_antenna_stays_known(lever: tuple[float, float, float]) -> None:
    filter_ = _at_speed(lever)
    slots, time = antenna_slots(filter_.model)
    lever_sd, known = np.sqrt(np.diag(filter_.covariance)[slots]), _known_m(filter_)
    assert known.max() < 0.1
    for off_deg in (2.0, -3.0, 1.0):
        yaw = 0.7 + math.radians(off_deg)
        turn = HeadingMeasurement("compass", 0, 1.0, yaw, math.radians(0.5))
        assert filter_.update(turn).name == "fused"
        level = AttitudeMeasurement("attitude", 0, 1.0, (0.0, 0.01, math.nan), (0.01, 0.01, 1.0))
        assert filter_.update(level).name == "fused"
        assert _known_m(filter_) == pytest.approx(known, rel=0.02)
        told = np.sqrt(np.diag(filter_.covariance)[slots])
        assert told == pytest.approx(lever_sd, rel=0.01)
        assert filter_.covariance[time[0], time[0]] == pytest.approx(LATE_SD_S**2, rel=0.01)
        assert filter_.covariance == pytest.approx(filter_.covariance.T, abs=1e-12)


def test_what_was_known_of_one_state_is_known_of_the_other() -> None:
    """H of a fix after the transform is H before it, but for the angle that turns l itself."""
    model = _model()
    lever, time = antenna_slots(model)
    rng = np.random.default_rng(3)
    before = runs.level_nav((0.1, -0.2, 0.7), (10.0, -4.0, 1.0))
    after = before.copy()
    after[3:6] += (0.3, -0.2, 0.1)
    after[6:] = quaternion_from_rpy(0.12, -0.17, 0.75)
    arms = rng.standard_normal((2, 3))

    def rows(nav: Array, arm: Array) -> Array:
        c, h = dcm_from_quaternion(nav[6:]), np.zeros((3, model.size))
        h[:, PHI : PHI + 3] = [np.cross(c @ arm, axis) for axis in np.eye(3)]
        h[:, PHI : PHI + 3] = h[:, PHI : PHI + 3].T
        h[:, DR : DR + 3] = np.eye(3)
        h[:, lever] = -c
        h[:, time[0]] = -nav[3:6]
        return h

    transform = np.eye(model.size)
    keep_antenna(transform, before, after, *arms, lever, time)
    off = rows(after, arms[1]) @ transform - rows(before, arms[0])
    turned = dcm_from_quaternion(after[6:]) - dcm_from_quaternion(before[6:])
    left = np.array([np.cross(turned @ arms[0], axis) for axis in np.eye(3)]).T
    assert off[:, :3] == pytest.approx(left, abs=1e-12)
    assert off[:, 3:] == pytest.approx(0.0, abs=1e-12)


def test_what_an_attitude_makes_of_an_unknown_lever_is_noise() -> None:
    """R of a fix beside its own: the variance of phi x C dl, by sampling."""
    model = _model()
    lever, _ = antenna_slots(model)
    rng = np.random.default_rng(4)
    six = [PHI, PHI + 1, PHI + 2, *lever]
    root = rng.standard_normal((6, 6)) * np.r_[np.full(3, 0.03), np.full(3, 0.5)][:, None]
    p = np.zeros((model.size, model.size))
    p[np.ix_(six, six)] = root @ root.T
    nav = runs.level_nav((0.1, -0.2, 0.7), (0.0, 0.0, 0.0))
    state = State(nav, np.zeros(model.size), np.zeros(STEP_SIZE), model, p)
    found = _fix(0, nav[:3]).innovation(state)
    drawn = rng.standard_normal((400_000, 6)) @ root.T
    left = np.cross(drawn[:, :3], drawn[:, 3:] @ dcm_from_quaternion(nav[6:]).T)
    assert isinstance(found, Innovation)
    assert found.r - np.square(FIX_SD_M) == pytest.approx(left.var(axis=0), rel=0.02)


def test_of_two_lever_arms_neither_is_carried() -> None:
    blocks = [antenna_lever_block(f"{ANTENNA_LEVER}{name}", 1.0) for name in ("", "_roof")]
    lever, time = antenna_slots(make_model("ins21", imu_noise(IMU), *blocks))
    assert (lever.size, time.size) == (0, 0)
    of_roof = time_offset_block(f"{FIX_TIME}_roof", 0.1)
    model = make_model(
        "ins21", imu_noise(IMU), blocks[1], time_offset_block(FIX_TIME, 0.1), of_roof
    )
    lever, time = antenna_slots(model)
    assert lever.tolist() == model.slots_of(f"{ANTENNA_LEVER}_roof")
    assert time.tolist() == model.slots_of(f"{FIX_TIME}_roof")
