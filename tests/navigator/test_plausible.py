"""The navigator's door: what cannot be true is refused by name, too good a sigma not believed."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    Measurement,
    MonotonicStamp,
    PositionFix,
    TimeOfDayStamp,
    UtcStamp,
    WheelSpeed,
)
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.aiding import GnssAiding
from fusiond.configuration.vehicle_class import PLAUSIBILITY, VehicleClass
from fusiond.navigator.intake import Intake

SECOND = 1_000_000_000
STAMP = MonotonicStamp(7)
KNOT_M_S = 1852.0 / 3600.0
FIX = PositionFix(
    *("gnss", 7, STAMP, 0.53, 1.99, 40.0),
    sd_ned_m=(1.0, 1.0, 2.0),
    v_ned_m_s=(10.0, 0.0, 0.0),
    sd_v_ned_m_s=(0.1, 0.1, 0.15),
)
RDSS = DelayedFix("rdss", 7, STAMP, 0.53, 1.99, 40.0, 20.0)
ATTITUDE = Attitude("attitude", 7, STAMP, (0.0, 0.0, 1.0), (0.01, 0.01, 0.02))
BEARING = Bearing("sar", 7, STAMP, 0.5, -0.1, (0.001, 0.001), "", (0.53, 1.99, 20.0))
HEADING = Heading("heading", 7, STAMP, 1.0, 0.02)
HEIGHT = Height("height", 7, STAMP, 40.0, 2.0)
WHEEL = WheelSpeed("wheel", 7, STAMP, 10.0, 0.1)
GOOD = (FIX, RDSS, ATTITUDE, BEARING, HEADING, HEIGHT, WHEEL)


def outcome(m: Measurement, vehicle: VehicleClass = "road") -> str:
    measurements = Intake({}, PLAUSIBILITY[vehicle]).measurements_of(m, 7, 0.0, 7)
    return measurements if isinstance(measurements, str) else "aids"


@pytest.mark.parametrize("m", GOOD, ids=lambda m: m.source)
@pytest.mark.parametrize("vehicle", PLAUSIBILITY)
def test_what_can_be_true_is_taken(m: Measurement, vehicle: VehicleClass) -> None:
    assert outcome(m, vehicle) == "aids"


@pytest.mark.parametrize(
    ("m", "change", "name"),
    [
        (FIX, {"lat_rad": math.nan}, "not_finite"),
        (FIX, {"lon_rad": math.inf}, "not_finite"),
        (FIX, {"height_m": math.nan}, "not_finite"),
        (FIX, {"lat_rad": 1.6}, "position_implausible"),
        (FIX, {"lat_rad": math.radians(89.95)}, "position_implausible"),
        (FIX, {"lon_rad": 7.0}, "position_implausible"),
        (FIX, {"lat_rad": 0.0, "lon_rad": 0.0}, "position_implausible"),
        (FIX, {"height_m": 1e300}, "height_implausible"),
        (FIX, {"height_m": -6.371e6}, "height_implausible"),
        (FIX, {"v_ned_m_s": (1e300, 0.0, 0.0)}, "speed_implausible"),
        (FIX, {"v_ned_m_s": (0.0, 2000.0 * KNOT_M_S, None)}, "speed_implausible"),
        (FIX, {"v_ned_m_s": (0.0, math.nan, None)}, "not_finite"),
        (FIX, {"sd_ned_m": (1.0, math.inf, 1.0)}, "sigma_implausible"),
        (FIX, {"sd_ned_m": (1.0, math.nan, 1.0)}, "not_finite"),
        (FIX, {"sd_ned_m": (1.0, -1.0, 1.0)}, "sigma_implausible"),
        (FIX, {"sd_v_ned_m_s": (0.1, math.inf, None)}, "sigma_implausible"),
        (RDSS, {"lat_rad": math.nan}, "not_finite"),
        (RDSS, {"height_m": 1e300}, "height_implausible"),
        (RDSS, {"precision_class_m": math.inf}, "sigma_implausible"),
        (RDSS, {"precision_class_m": 1e-9}, "sigma_implausible"),
        (ATTITUDE, {"rpy_rad": (0.0, math.inf, 0.0)}, "not_finite"),
        (ATTITUDE, {"sd_rpy_rad": (0.01, 1e-9, 0.01)}, "sigma_implausible"),
        (BEARING, {"azimuth_rad": math.nan}, "not_finite"),
        (BEARING, {"point": (math.nan, 0.0, 0.0)}, "not_finite"),
        (BEARING, {"sd_rad": (math.inf, 0.001)}, "sigma_implausible"),
        (HEADING, {"yaw_rad": math.nan}, "not_finite"),
        (HEADING, {"sd_rad": 1e-9}, "sigma_implausible"),
        (HEIGHT, {"height_m": math.inf}, "not_finite"),
        (HEIGHT, {"height_m": -6.371e6}, "height_implausible"),
        (HEIGHT, {"sd_m": math.inf}, "sigma_implausible"),
        (WHEEL, {"speed_m_s": 1e300}, "speed_implausible"),
        (WHEEL, {"speed_m_s": math.nan}, "not_finite"),
        (WHEEL, {"sd_m_s": math.nan}, "not_finite"),
    ],
)
def test_what_cannot_be_true_is_refused(m: Any, change: dict[str, Any], name: str) -> None:
    assert outcome(replace(m, **change), "aircraft") == name


def test_the_class_of_the_vehicle_says_what_it_can_do() -> None:
    fast, high = replace(FIX, v_ned_m_s=(160.0, 0.0, 0.0)), replace(FIX, height_m=9_000.0)
    assert {v: outcome(fast, v) for v in PLAUSIBILITY} == {
        "road": "speed_implausible",
        "rail": "aids",
        "marine": "speed_implausible",
        "aircraft": "aids",
    }
    assert {v for v in PLAUSIBILITY if outcome(high, v) == "aids"} == {"aircraft"}


def sigmas(change: dict[str, Any], section: GnssAiding | None = None) -> tuple[Any, Any]:
    """Of position and velocity, as the filter believes them."""
    measurements = Intake({"gnss": section or GnssAiding()}).measurements_of(
        replace(FIX, **change), 7, 0.0
    )
    position, velocity = measurements
    assert isinstance(position, PositionMeasurement)
    assert isinstance(velocity, VelocityMeasurement)
    return position.sd, velocity.sd


@pytest.mark.parametrize(
    ("quality", "floor", "height"), [(1, 0.3, 0.5), (2, 0.3, 0.5), (4, 0.02, 0.02), (5, 0.05, 0.05)]
)
def test_no_fix_is_better_than_its_quality(quality: int, floor: float, height: float) -> None:
    tight: dict[str, Any] = {"sd_ned_m": (0.002, 0.01, 0.7), "quality": quality}
    assert sigmas(tight)[0] == (floor, floor, 0.7)
    assert sigmas(tight, GnssAiding(min_position_sd_m=0.005))[0] == (0.005, 0.01, 0.7)
    assert sigmas(tight | {"sd_ned_m": (2.0, 2.0, 0.01)})[0] == (2.0, 2.0, height)


def test_a_sigma_that_nobody_can_measure_is_not_stated() -> None:
    """The ranging error times the assumed DOP instead, and the section's velocity sigma."""
    tiny = {"sd_ned_m": (1e-9,) * 3, "sd_v_ned_m_s": (1e-9,) * 3}
    position, velocity = sigmas(tiny)
    unstated = sigmas({"sd_ned_m": None, "sd_v_ned_m_s": None})
    assert (position, velocity) == unstated
    assert position == pytest.approx((3.0 * math.sqrt(2.0),) * 2 + (9.0,))


def rate_of(rate_hz: float, seconds: float, start_s: float = 0.0) -> list[int]:
    return [round((start_s + k / rate_hz) * SECOND) for k in range(round(seconds * rate_hz))]


def outcomes_of(intake: Intake, m: Measurement, instants: list[int]) -> Counter[str]:
    found: Counter[str] = Counter()
    for t_ns in instants:
        measurements = intake.measurements_of(m, t_ns, 0.0)
        found[measurements if isinstance(measurements, str) else "aids"] += 1
    return found


def test_a_kilohertz_of_fixes_is_left_out_and_named() -> None:
    told: list[tuple[str, str]] = []
    intake = Intake({}, report=lambda code, text: told.append((code, text)))
    assert outcomes_of(intake, FIX, rate_of(50.0, 4.0)) == {"aids": 200}
    mixed = sorted(rate_of(1000.0, 0.5, 5.0) + rate_of(5.0, 0.5, 5.0))
    burst = outcomes_of(intake, FIX, mixed)
    assert burst["too_often"] > 490
    assert burst["aids"] <= 6  # what may be chance
    assert [code for code, _ in told] == ["source_too_fast"]
    assert "gnss sends more than 50 fixes a second" in told[0][1]
    assert outcomes_of(intake, WHEEL, rate_of(100.0, 1.0, 5.0)) == {"aids": 100}
    after = outcomes_of(intake, FIX, rate_of(5.0, 4.0, 5.6))
    assert after == {"too_often": 5, "aids": 15}  # for a second it is not believed
    outcomes_of(intake, FIX, rate_of(1000.0, 0.1, 12.0))
    assert len(told) == 2


def test_a_backlog_is_not_haste_and_costs_itself_alone() -> None:
    """What a radio or a server kept comes at once, before its UTC is known: at one instant."""
    told: list[tuple[str, str]] = []
    intake = Intake({}, report=lambda code, text: told.append((code, text)))

    def stamped(at_s: float, interval_s: float, *, dated: bool = True) -> Counter[str]:
        found: Counter[str] = Counter()
        for k in range(20):
            utc = UtcStamp(round((1e9 + k * interval_s) * SECOND))
            stamp = utc if dated else TimeOfDayStamp(7200.0 + k * interval_s)
            measurements = intake.measurements_of(replace(FIX, stamp=stamp), round(at_s * 1e9), 0.0)
            found[measurements if isinstance(measurements, str) else "aids"] += 1
        return found

    assert stamped(3.0, 0.25) == {"aids": 5, "backlog": 15}
    assert outcomes_of(intake, FIX, rate_of(4.0, 2.0, 3.25)) == {"aids": 8}  # at once again
    assert stamped(6.0, 0.02, dated=False) == {"aids": 5, "backlog": 15}
    assert told == []
    assert stamped(9.0, 0.001)["too_often"] >= 15  # as many a second as they came
    assert [code for code, _ in told] == ["source_too_fast"]


def test_order_of_arrival_and_repetition_are_no_haste() -> None:
    intake = Intake({})
    late = [t for pair in zip(rate_of(5.0, 4.0, 4.0), rate_of(5.0, 4.0), strict=True) for t in pair]
    assert outcomes_of(intake, FIX, late) == {"aids": 40}
    twice = [t for t in rate_of(5.0, 4.0, 9.0) for _ in range(2)]
    assert outcomes_of(intake, FIX, twice) == {"aids": 40}
