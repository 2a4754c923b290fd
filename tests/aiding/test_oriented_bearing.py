"""Bearings of a vehicle without an inertial unit: slopes, noise, and which attitude counts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.attitude import STAR_BLOCK, AttitudeMeasurement
from fusiond.aiding.base import Innovation, State
from fusiond.aiding.heading_history import (
    CORNER_RAD_S,
    HOLDS_NS,
    LEVEL_SD_RAD,
    STEADY_RAD_S,
    HeadingHistory,
    KnownHeading,
    Oriented,
)
from fusiond.aiding.landmark_bearing import SAR_BLOCK, BearingMeasurement
from fusiond.models.blocks import misalignment
from fusiond.models.constant_velocity import constant_velocity
from fusiond.navigation.strapdown import LAT, STEP_SIZE
from tests import runs

SECOND, AT_NS = runs.SECOND, 5 * runs.SECOND
RPY, SD = (0.2, -0.1, 1.1), (1e-3, 2e-3, 3e-3)
POINT = (runs.ORIGIN[0] + 1e-3, runs.ORIGIN[1] + 2e-3, 10.0)
MODEL = constant_velocity(
    (0.75, 0.1, 3.0), (misalignment(STAR_BLOCK, 1e-3), misalignment(SAR_BLOCK, 1e-3))
)
BEARING = BearingMeasurement(
    *("sar", AT_NS, 0.999, 0.3, 0.1, (1e-3, 2e-3), POINT, (1.0, 0.5, -0.3)), 500.0, block=SAR_BLOCK
)


def state(nav: np.ndarray | None = None, xi: np.ndarray | None = None) -> State:
    nav = runs.level_nav((0.0, 0.0, 0.0), (12.0, 5.0, 0.0)) if nav is None else nav
    xi = np.zeros(MODEL.size) if xi is None else xi
    return State(nav, xi, np.zeros(STEP_SIZE), MODEL)


def exact(block: str = "") -> Oriented:
    """An attitude without noise."""
    return Oriented(AT_NS, RPY, (0.0, 0.0, 0.0), block)


def asked(measurement: BearingMeasurement, at: State) -> Innovation:
    found = measurement.innovation(at)
    assert isinstance(found, Innovation)
    return found


def test_slopes_are_those_of_the_angles() -> None:
    # Of noise that is the same everywhere: whitening then changes nothing.
    bearing = replace(BEARING, sd=(1.0, 1.0))
    measurement = replace(bearing, attitude=exact(STAR_BLOCK))
    xi = np.zeros(MODEL.size)
    xi[9:15] = 2e-4, -1e-4, 3e-4, 1e-4, 2e-4, -2e-4
    base = state(xi=xi)
    h = asked(measurement, base).h
    # No attitude is estimated, and a velocity turns nothing.
    assert not h[:, :6].any()
    metres = runs.metres_per_unit(base.nav[LAT], base.nav[LAT + 2])
    for axis in range(3):
        ends = []
        for d in (-0.5, 0.5):
            nav = base.nav.copy()
            nav[LAT + axis] += d / metres[axis]
            ends.append(asked(measurement, state(nav, xi)).z)
        assert h[:, 6 + axis] == pytest.approx(ends[1] - ends[0], rel=1e-4, abs=1e-8)
    for slot in range(9, 15):
        ends = []
        for d in (-1e-4, 1e-4):
            moved = xi.copy()
            moved[slot] -= d  # an error is true minus estimate
            ends.append(asked(measurement, state(xi=moved)).z)
        assert h[:, slot] == pytest.approx((ends[1] - ends[0]) / 2e-4, abs=3e-4)


def test_noise_is_that_of_angles_and_attitude_together() -> None:
    """By a thousand drawn attitudes; whitened, it is that of two independent rows."""
    rng = np.random.default_rng(3)
    still = state(runs.level_nav((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    exact = replace(BEARING, sd=(1e-9, 1e-9))
    at_true = asked(replace(exact, attitude=Oriented(AT_NS, RPY, SD)), still)
    z = []
    for _ in range(1000):
        roll, pitch, yaw = (np.array(RPY) + np.array(SD) * rng.standard_normal(3)).tolist()
        of = Oriented(AT_NS, (roll, pitch, yaw), SD)
        z.append(asked(replace(exact, attitude=of), still).z - at_true.z)
    assert np.cov(np.array(z).T) == pytest.approx(np.eye(2), abs=0.15)
    assert at_true.r.tolist() == [1.0, 1.0]


def test_only_with_an_attitude_of_about_that_instant() -> None:
    way = HeadingHistory()
    assert BEARING.without_attitude(way) is None
    way.orient(Oriented(AT_NS - HOLDS_NS - 1, RPY, SD))
    assert BEARING.without_attitude(way) is None
    way.orient(Oriented(AT_NS, RPY, SD, STAR_BLOCK))
    found = BEARING.without_attitude(way)
    assert found is not None
    assert found.attitude == Oriented(AT_NS, RPY, SD, STAR_BLOCK)


def test_between_two_attitudes_it_turns_evenly_and_after_them_it_is_less_sure() -> None:
    way = HeadingHistory()
    for k in range(2):  # of a vehicle that turns by 0.1 rad in a second
        at = AT_NS + k * SECOND
        way.orient(Oriented(at, (0.0, 0.0, 3.1 + 0.1 * k), (1e-3,) * 3))
    middle = way.oriented_at(AT_NS + SECOND // 4)
    assert middle is not None
    assert middle.rpy[2] == pytest.approx(3.125)
    assert middle.sd[2] == pytest.approx(math.hypot(1e-3, 0.1 * 0.25 * 0.75 / 2.0))
    after = way.oriented_at(AT_NS + 3 * SECOND // 2)
    assert after is not None
    assert after.rpy[2] == pytest.approx(3.2)
    assert after.sd[2] == pytest.approx(math.hypot(1e-3, 0.1 * 0.5))
    assert way.oriented_at(AT_NS + 5 * SECOND // 2) is None
    before = way.oriented_at(AT_NS - SECOND // 2)  # nothing tells how it turned before the first
    assert before is not None
    assert before.sd[2] == pytest.approx(math.hypot(1e-3, 0.5 * CORNER_RAD_S))
    steady = HeadingHistory()
    for k in range(2):
        steady.orient(Oriented(AT_NS + k * SECOND, RPY, SD))
    last = steady.oriented_at(AT_NS + 2 * SECOND)
    assert last is not None
    assert last.sd[0] == pytest.approx(math.hypot(SD[0], STEADY_RAD_S))


def test_a_heading_says_that_a_vehicle_on_a_road_is_level() -> None:
    road, free = HeadingHistory(0.1), HeadingHistory()
    for way in (road, free):
        way.add(KnownHeading(AT_NS - SECOND // 2, 1.1, 0.01))
    level = road.oriented_at(AT_NS)
    assert level is not None
    assert level.rpy == (0.0, 0.0, 1.1)
    assert level.sd == pytest.approx(
        (LEVEL_SD_RAD, LEVEL_SD_RAD, math.hypot(0.01, 0.5 * CORNER_RAD_S))
    )
    assert free.oriented_at(AT_NS) is None
    # What a compass errs by is alike in the next one: many of them would be believed too much.
    compass = HeadingHistory(0.1)
    compass.add(KnownHeading(AT_NS, 1.1, 0.01, lasts=True))
    assert compass.oriented_at(AT_NS) is None


def test_half_an_attitude_or_a_steep_one_is_none() -> None:
    def orientation(rpy: tuple[float, float, float]) -> Oriented | None:
        return AttitudeMeasurement("a", AT_NS, 0.999, rpy, SD).orientation

    assert orientation(RPY) == Oriented(AT_NS, RPY, SD)
    assert orientation((math.nan, 0.0, 1.0)) is None
    assert orientation((0.0, 1.5, 1.0)) is None
