"""A compass in the navigator: declination, a start that is a claim, and a magnet beside it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from drivers.measurements import MagneticHeading, Measurement, MonotonicStamp, PositionFix, UtcStamp
from fusiond.aiding.compass import CompassMeasurement, lasting
from fusiond.configuration.aiding import CompassAiding
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.navigation.solution import Mode
from fusiond.navigator.intake import Intake
from fusiond.navigator.intake.compass import declination
from fusiond.navigator.navigator import Navigator
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav
from tests import runs
from tests.navigator.vehicle import CONFIG, START_NS, drive, outcomes_of

FIXED = CompassAiding(declination_deg=3.0)


def test_declination_is_that_of_the_world_magnetic_model() -> None:
    """WMM2025_TestValues.txt of NOAA and BGS, sea level, 2025.0; here half a month later."""
    for lat, lon, degrees in ((80, 0, 1.28), (0, 120, -0.16), (-80, 240, 68.78)):
        found = declination(10 * lat, 10 * lon, 2025, 1)
        assert isinstance(found, float)
        assert math.degrees(found) == pytest.approx(degrees, abs=0.05)
    assert declination(860, 1400, 2025, 1) == "near_magnetic_pole"
    assert declination(305, 1143, 2031, 1) == "beyond_magnetic_model"


def heading(t_ns: int, yaw_rad: float) -> MagneticHeading:
    return MagneticHeading("compass", t_ns, MonotonicStamp(t_ns), yaw_rad)


def test_place_and_date_come_of_the_fixes() -> None:
    intake = Intake({"compass": CompassAiding()})
    t = START_NS
    assert intake.measurements_of(heading(t, 0.0), t, 0.0) == "place_unknown"
    place = 30.5 * DEG, 114.3 * DEG, 40.0
    intake.measurements_of(PositionFix("gnss", t, MonotonicStamp(t), *place), t, 0.0)
    assert intake.measurements_of(heading(t, 0.0), t, 0.0) == "date_unknown"
    utc_ns = round(datetime(2026, 11, 22, tzinfo=UTC).timestamp()) * runs.SECOND
    intake.measurements_of(PositionFix("gnss", t, UtcStamp(utc_ns), *place), t, 0.0)
    (measurement,) = intake.measurements_of(heading(t, 0.0), t, 0.0)
    assert isinstance(measurement, CompassMeasurement)
    assert math.degrees(measurement.yaw_rad) == pytest.approx(-4.9, abs=0.2)


def told(start: tuple[str, ...], bent_deg: Any, seed: int) -> tuple[Navigator, list[Any]]:
    """The drive with a compass of 2 Hz, whose deviation at t (s) and yaw (rad) is `bent_deg`."""
    d = drive()
    settings = {
        **CONFIG,
        "aiding": {"compass": FIXED.model_dump(exclude_defaults=True) | {"kind": "compass"}},
        "alignment": {"heading": list(start)},
    }
    told: list[Any] = []
    navigator = Navigator(
        Config.model_validate(settings), on_event=lambda code, text: told.append(code)
    )
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.5, d.truth.duration_s - 0.5, 0.5)
    yaws = d.truth.at(t_s).rpy[:, 2]
    found: list[Measurement] = list(d.measurements)
    first = d.measurements[0]
    assert isinstance(first, PositionFix)
    for t, yaw in zip(t_s.tolist(), yaws.tolist(), strict=True):
        at = START_NS + round(t * 1e9)
        noise = rng.standard_normal() * FIXED.sd_deg
        found.append(heading(at, yaw + (bent_deg(t, yaw) - 3.0 + noise) * DEG))
        if t < 9.0 and t % 1.0 == 0.0:  # the drive's own fixes come later
            noise_m = rng.standard_normal(3) / metres_per_unit(runs.ORIGIN[0], runs.ORIGIN[2])
            place = (float(x) for x in d.truth.at(np.array([t])).position[0] + noise_m)
            fix = PositionFix("gnss", at, MonotonicStamp(at), *place, sd_ned_m=(1.0, 1.0, 1.0))
            found.append(fix)
    found.sort(key=lambda m: m.t_seen_ns)
    for row in range(0, len(d.times), 5):
        navigator.add_imu(d.times[row : row + 5], d.samples[row : row + 5])
        while found and found[0].t_seen_ns <= d.times[min(row + 4, len(d.times) - 1)]:
            m = found.pop(0)
            navigator.add(m, m.t_seen_ns)
        navigator.advance()
    return navigator, told


def yaw_error(navigator: Navigator) -> tuple[float, float]:
    """At the end (rad), and one sigma."""
    e = navigator.estimator
    truth = true_nav(drive().truth, np.array([(e.t_ns - START_NS) * 1e-9]))[0]
    return float(nav_error(e.nav, truth)[2]), math.sqrt(float(e.covariance[2, 2]))


def test_a_start_by_compass_knows_what_the_deviation_shares() -> None:
    """Cars whose deviation is drawn as the filter takes it: of phi at the start, and at the end."""
    first, last = [], []
    for seed in range(4):
        rng = np.random.default_rng([11, seed])
        by = rng.standard_normal(3) * FIXED.deviation_sd_deg / math.sqrt(2.0)

        def bent(t_s: float, yaw: float, by: Any = by) -> float:
            return float(np.dot(by, lasting(yaw, 1.0)[:3]))

        navigator, _ = told(("compass",), bent, seed)
        start = navigator.started
        assert start is not None
        assert start.how == "compass"
        true = true_nav(drive().truth, np.array([(start.t_ns - START_NS) * 1e-9]))[0]
        phi = nav_error(start.nav, true)[2]
        first.append(phi / math.sqrt(start.covariance[2, 2]))
        assert math.sqrt(start.covariance[2, 2]) == pytest.approx(
            math.hypot(1.0, 5.0, 3.0) * DEG, rel=0.05
        )
        error, sd = yaw_error(navigator)
        assert sd < 2.0 * DEG
        last.append(error / sd)
    assert np.mean(np.square(first)) < 4.0  # 99.9 % of four
    assert np.mean(np.square(last)) < 4.6
    assert max(map(abs, last)) < 4.0


def test_a_magnet_beside_it_does_not_turn_the_solution() -> None:
    """A motor runs for 12 s and bends the compass by 40 deg: refused by name, and used again."""

    def bent(t_s: float, yaw: float) -> float:
        return 40.0 if 24.0 < t_s < 36.0 else 0.0

    navigator, _ = told(("gnss_course", "compass"), bent, 5)
    ended = outcomes_of(navigator)["compass"]
    assert ended["gated"] + ended["isolated"] >= 20
    assert ended["fused"] > 20
    error, sd = yaw_error(navigator)
    assert abs(error) < 4.0 * sd
    assert navigator.solution(navigator.imu.latest_ns).mode in (Mode.NAVIGATING, Mode.COASTING)


def test_a_start_by_a_bent_compass_is_put_right_by_the_way() -> None:
    """60 deg off while it starts and for good: velocities contradict it, and what is wrong is the
    heading, not they."""
    navigator, codes = told(("compass", "gnss_course"), lambda t, yaw: 60.0, 6)
    assert navigator.started is not None
    true = true_nav(drive().truth, np.array([(navigator.started.t_ns - START_NS) * 1e-9]))[0]
    if navigator.started.how == "compass":
        assert abs(nav_error(navigator.started.nav, true)[2]) > 50.0 * DEG
        assert "sensor_fault" in codes
    else:
        assert "heading_contradicted" in codes
    error, sd = yaw_error(navigator)
    assert abs(error) < 4.0 * sd
    # The compass itself is still bent: to leave it out is right.
    assert navigator.timeline.diagnosis.excluded.keys() <= {"compass"}
