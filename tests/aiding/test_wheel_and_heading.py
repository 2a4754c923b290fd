"""A wheel's speed and a heading of a vehicle without an attitude: rows, slopes, what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.attitude import AttitudeMeasurement, HeadingMeasurement
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.body_velocity import NonHolonomicConstraint, WheelSpeedMeasurement
from fusiond.aiding.compass import CompassMeasurement, deviation, disturbance
from fusiond.aiding.heading_history import HOLDS_NS, HeadingHistory, KnownHeading
from fusiond.aiding.wheel_and_heading import SIGN_SIGMAS, GroundSpeed
from fusiond.models.constant_velocity import constant_velocity
from fusiond.models.vehicle_parameter_blocks import (
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
    drift_block,
    time_offset_block,
    wheel_rounding_block,
    wheel_scale_block,
)
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs

SECOND = runs.SECOND
YAW_RAD = 0.7
FORWARD = np.array([math.cos(YAW_RAD), math.sin(YAW_RAD), 0.0])
SD_M_S = 0.2
BLOCKS = (
    wheel_scale_block(WHEEL_SCALE, 0.02),
    drift_block(WHEEL_DRIFT, 0.1, 1.0),
    time_offset_block(WHEEL_LATENCY, 0.2),
    wheel_rounding_block(WHEEL_ROUNDING, 0.3),
    deviation("iron", 0.05),
    disturbance("bridges", 0.03, 20.0),
)
MODEL = constant_velocity((0.75, 0.1, 3.0), BLOCKS)
WHEEL = WheelSpeedMeasurement(
    *("wheel", 5 * SECOND, 0.99, 4.0, 0.1, (0.0, 0.0, 0.0)),
    drift=WHEEL_DRIFT,
    scale=WHEEL_SCALE,
    latency=WHEEL_LATENCY,
    rounding=WHEEL_ROUNDING,
    shared_step_m_s=0.25,
)


def state(forward_m_s: float, sd_m_s: float = SD_M_S, xi: np.ndarray | None = None) -> State:
    nav = runs.level_nav((0.0, 0.0, 0.0), tuple(forward_m_s * FORWARD))
    covariance = np.zeros((MODEL.size, MODEL.size))
    covariance[3:6, 3:6] = sd_m_s**2 * np.eye(3)
    estimated = np.zeros(MODEL.size) if xi is None else xi
    return State(nav, estimated, np.zeros(STEP_SIZE), MODEL, covariance)


def way(*headings: KnownHeading) -> HeadingHistory:
    found = HeadingHistory(0.2)
    for heading in headings:
        found.add(heading)
    return found


def level(measurement: AidingMeasurement, of: HeadingHistory) -> AidingMeasurement:
    found = measurement.without_attitude(of)
    assert found is not None
    return found


def rows(measurement: AidingMeasurement, at: State) -> Innovation:
    found = measurement.innovation(at)
    assert isinstance(found, Innovation), found
    return found


def refused(measurement: AidingMeasurement, at: State) -> str:
    found = measurement.innovation(at)
    assert isinstance(found, NotApplicable)
    return found.outcome


HEADING = HeadingMeasurement("heading", 5 * SECOND, 0.99, YAW_RAD, 0.02)
COMPASS = CompassMeasurement("compass", 5 * SECOND, 0.99, YAW_RAD, 0.02, "iron", "bridges", 0.06)
FACED = KnownHeading(5 * SECOND, YAW_RAD, 0.02)


@pytest.mark.parametrize(
    ("measurement", "tolerance"),
    [
        (level(WHEEL, way()), 1e-6),
        (level(WHEEL, way(FACED)), 1e-6),
        (level(HEADING, way()), 1e-6),
        (level(COMPASS, way()), 1e-6),
    ],
)
def test_slopes(measurement: AidingMeasurement, tolerance: float) -> None:
    """H against the change of z where the computed state is off; an estimate is short by d."""
    estimated = np.zeros(MODEL.size)
    estimated[MODEL.slots_of("iron")] = 0.02, -0.01, 0.03
    estimated[MODEL.slots_of(WHEEL_SCALE)] = 0.01
    at = state(5.0, xi=estimated)
    h, d = rows(measurement, at).h.copy(), 1e-5
    for k in (3, 4, 5, *range(9, MODEL.size)):
        z = []
        for sign in (1.0, -1.0):
            nav, xi = at.nav.copy(), at.xi.copy()
            if k < 6:
                nav[k] += sign * d
            else:
                xi[k] -= sign * d
            z.append(rows(measurement, at._replace(nav=nav, xi=xi)).z.copy())
        slope = (z[0] - z[1]) / (2.0 * d)
        assert h[:, k] == pytest.approx(slope, abs=tolerance), MODEL.column_of[k]


def test_a_wheel_says_the_speed_along_the_velocity_or_the_heading() -> None:
    fast, turned = replace(WHEEL, speed_m_s=5.0), KnownHeading(5 * SECOND, YAW_RAD + math.pi, 0.02)
    assert rows(level(fast, way()), state(5.5)).z[0] == pytest.approx(0.5)
    # By a heading the sign is told: it reverses.
    back = replace(fast, speed_m_s=-5.0)
    assert rows(level(back, way(turned)), state(5.5)).z[0] == pytest.approx(-0.5)
    assert rows(level(back, way()), state(5.5)).z[0] == pytest.approx(-0.5)
    # Across the heading nothing of the velocity is a wheel's.
    across = KnownHeading(5 * SECOND, YAW_RAD + 0.5 * math.pi, 0.02)
    assert rows(level(fast, way(across)), state(5.5)).z[0] == pytest.approx(-5.0)


def test_without_a_heading_a_slow_velocity_has_no_direction() -> None:
    wheel = level(WHEEL, way())
    edge = SIGN_SIGMAS * SD_M_S
    assert refused(wheel, state(0.99 * edge)) == "direction_unknown"
    assert rows(wheel, state(1.01 * edge)).z.shape == (1,)
    amount = level(replace(WHEEL, signed=False), way(FACED))
    assert refused(amount, state(0.99 * edge)) == "direction_unknown"
    assert rows(amount, state(-5.5)).z[0] == pytest.approx(-1.5)
    # With one the wheel of a vehicle that drives off counts at once.
    assert rows(level(WHEEL, way(FACED)), state(0.0, 2.0)).z[0] == pytest.approx(-4.0)


def test_a_wheel_that_says_nothing_stops_a_vehicle_that_may_face_anywhere() -> None:
    stands = rows(level(replace(WHEEL, speed_m_s=0.0), way()), state(0.0, 2.0))
    assert stands.z.tolist() == [0.0, 0.0]
    assert stands.h[:, 3:5].tolist() == [[1.0, 0.0], [0.0, 1.0]]
    # 0.1 m/s of noise, 0.1 m/s that lasts, and a latency of 0.2 s of a car that brakes.
    assert np.sqrt(stands.r) == pytest.approx([math.sqrt(0.01 + 0.01 + 0.04)] * 2)


def test_a_heading_counts_for_a_second_and_never_one_of_later() -> None:
    late = KnownHeading(5 * SECOND + 1, 2.0, 0.02)
    known = way(late, KnownHeading(5 * SECOND - HOLDS_NS, YAW_RAD, 0.02))
    assert known.at(5 * SECOND) == KnownHeading(5 * SECOND - HOLDS_NS, YAW_RAD, 0.02)
    assert known.at(5 * SECOND + 1) == late
    assert way(KnownHeading(5 * SECOND - HOLDS_NS - 1, YAW_RAD, 0.02)).at(5 * SECOND) is None
    # In whatever order they come.
    wheel = level(WHEEL, way(late, FACED))
    assert isinstance(wheel, GroundSpeed)
    assert wheel.way.at(WHEEL.t_ns) == FACED


def test_a_heading_says_which_way_the_vehicle_goes_or_backs() -> None:
    course = level(HEADING, way())
    for speed in (8.0, -8.0):
        found = rows(course, state(speed))
        assert found.z[0] == pytest.approx(0.0, abs=1e-12)
        square = (speed**2 + SD_M_S**2) * 0.02**2
        assert found.r[0] == pytest.approx(0.2**2 + square)


def test_who_may_slide_has_no_course_and_an_attitude_alone_none_without_a_yaw() -> None:
    free = HeadingHistory()
    free.add(FACED)
    assert HEADING.without_attitude(free) is None
    assert COMPASS.without_attitude(free) is None
    assert free.at(5 * SECOND) is None
    own = "attitude", 5 * SECOND, 0.99
    assert (
        AttitudeMeasurement(*own, (0.0, 0.0, YAW_RAD), (0.1, 0.1, 0.1)).without_attitude(way())
        is not None
    )
    assert (
        AttitudeMeasurement(*own, (0.0, 0.0, math.nan), (0.1, 0.1, 0.1)).without_attitude(way())
        is None
    )
    slides = NonHolonomicConstraint("non_holonomic", 0, 0.99, 0.2, 0.5, 2.0, (0.0, 0.0, 0.0))
    assert slides.without_attitude(way()) is None
