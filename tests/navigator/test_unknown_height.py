"""A height that nobody has told is not 0 m: what is published, gated and learned of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.measurements import PositionFix
from drivers.nmea.geoid_fallback import GEOID_SD_M
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import imu_noise
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.alignment.evidence import AlignmentEvidence
from fusiond.navigator.alignment.options import alignment_options
from fusiond.navigator.alignment.start import SLOPE_SD, UNKNOWN_HEIGHT_SD_M
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_state import SavedState
from tests.navigator import vehicle
from tests.navigator.vehicle import CONFIG, RATE_HZ, drive, outcomes_of

GEOID_M = 47.0
PLACELESS = CONFIG | {"alignment": {"heading": ["gnss_course"]}, "aiding": {"gnss": {}}}
"""The place is that of the fixes."""
Said = Callable[[PositionFix], PositionFix]


def without_height(m: PositionFix) -> PositionFix:
    return replace(m, height_m=None)


def above_the_sea(m: PositionFix) -> PositionFix:
    assert m.height_m is not None
    return replace(m, height_m=m.height_m - GEOID_M, geoid_sd_m=GEOID_SD_M)


def driven(said: Said, **settings: Any) -> tuple[Navigator, list[Solution]]:
    """The drive with other heights; a solution each second, those before a start left out."""
    d, navigator = drive(), Navigator(Config.model_validate(PLACELESS | settings))
    waiting = [said(m) if isinstance(m, PositionFix) else m for m in d.measurements]
    found = []
    for first in range(0, len(d.times), 10):
        rows = slice(first, first + 10)
        navigator.add_imu(d.times[rows], d.samples[rows])
        now = int(d.times[rows][-1])
        while waiting and waiting[0].t_seen_ns <= now:
            m = waiting.pop(0)
            assert navigator.add(m, m.t_seen_ns) == "accepted"
        navigator.advance()
        if first % RATE_HZ == 0:
            found.append(navigator.solution(now))
    return navigator, [s for s in found if s.mode is Mode.NAVIGATING]


def off_m(solution: Solution) -> tuple[float, float, float]:
    """North, east, down, from the truth."""
    true = drive().truth.at(np.array([(solution.t_ns - vehicle.START_NS) * 1e-9]))
    lat, lon, height = true.position[0].tolist()
    radius = 6_371_000.0
    return (
        (solution.lat_rad - lat) * radius,
        (solution.lon_rad - lon) * radius * math.cos(lat),
        height - solution.height_m,
    )


def test_no_height_is_published_where_none_is_known() -> None:
    navigator, found = driven(without_height)
    known = driven(lambda m: m)[1]
    assert len(found) == len(known)
    for solution, other in zip(found, known, strict=True):
        assert math.isnan(solution.height_m)
        assert math.isnan(solution.sd_ned_m[2])
        assert solution.sd_ned_m[:2] == pytest.approx(other.sd_ned_m[:2], rel=0.05)
        north, east, _ = off_m(solution)
        assert math.hypot(north, east) < 4.0 * math.hypot(*solution.sd_ned_m[:2])
    assert navigator.estimator.sigmas()[2] == pytest.approx(UNKNOWN_HEIGHT_SD_M, rel=0.05)
    assert "gated" not in outcomes_of(navigator)["gnss"]


def test_the_first_height_that_is_measured_is_taken() -> None:
    came_ns = drive().measurements[-1].t_seen_ns - 20_000_000_000

    def late(m: PositionFix) -> PositionFix:
        return m if m.t_seen_ns >= came_ns else without_height(m)

    navigator, found = driven(late)
    before = [s for s in found if s.t_ns < came_ns - 1_000_000_000]
    after = [s for s in found if s.t_ns > came_ns + 1_000_000_000]
    assert all(math.isnan(s.height_m) for s in before)
    for solution in after:
        assert solution.sd_ned_m[2] < 5.0
        assert abs(off_m(solution)[2]) < 4.0 * solution.sd_ned_m[2]
    assert len(before) > 5
    assert len(after) > 15
    assert "gated" not in outcomes_of(navigator)["gnss"]


def test_a_height_above_the_sea_has_the_geoids_sigma_however_many_fixes_come() -> None:
    navigator, found = driven(above_the_sea)
    for solution in found:
        assert solution.sd_ned_m[2] == pytest.approx(GEOID_SD_M, rel=0.05)
        assert off_m(solution)[2] == pytest.approx(GEOID_M, abs=5.0)
    assert "gated" not in outcomes_of(navigator)["gnss"]


@pytest.mark.parametrize("aiding", [{"gnss": {"bias_sd_m": 0.0}}, {}])
def test_a_geoid_that_nothing_in_the_filter_can_hold_is_no_height(aiding: dict[str, Any]) -> None:
    found = driven(above_the_sea, aiding=aiding)[1]
    assert found
    assert all(math.isnan(s.height_m) for s in found)
    near = driven(lambda m: replace(above_the_sea(m), geoid_sd_m=0.1), aiding=aiding)[1]
    assert near[-1].sd_ned_m[2] < 2.0


@pytest.mark.parametrize(("away_deg", "sd_m"), [(0.0, 20.0), (0.02, 133.0), (3.0, math.nan)])
def test_a_place_that_was_configured_tells_the_height_nearby(away_deg: float, sd_m: float) -> None:
    """As far as roads climb on the way from there."""
    lat, lon, _ = vehicle.runs.ORIGIN
    place = [math.degrees(lat) + away_deg, math.degrees(lon), 321.0]
    alignment = {"heading": ["gnss_course"], "position_deg_m": place, "position_sd_m": 20.0}
    found = driven(without_height, alignment=alignment)[1]
    assert math.isnan(sd_m) == math.isnan(found[0].height_m)
    assert found[0].sd_ned_m[2] == pytest.approx(sd_m, rel=0.1, nan_ok=True)
    assert SLOPE_SD == 0.06


def test_a_saved_place_without_a_height_tells_none() -> None:
    lat, lon, _ = vehicle.runs.ORIGIN
    config = Config.model_validate(PLACELESS)
    for height, sd_m in ((None, UNKNOWN_HEIGHT_SD_M), (321.0, 5.0)):
        saved = SavedState(1.0, (lat, lon, height), 5.0, 0.0, 0.1)
        known = AlignmentEvidence(alignment_options(config), imu_noise(config.imu), saved, print)
        place = known.place()
        assert place is not None
        assert (place.where[2], place.sd_height) == (height or 0.0, sd_m)
        here = PositionCandidate(0, lat, lon, None, (1.0, 1.0, 9.0), (0.0, 0.0, 0.0))
        assert known.place_of(here).sd_height == sd_m


@pytest.mark.parametrize("model", ["planar10", "planar15"])
def test_a_model_that_holds_the_height_holds_none_that_it_does_not_know(model: str) -> None:
    estimator = {"model": model}
    for said, known in ((without_height, False), (above_the_sea, True)):
        found = driven(said, estimator=estimator, constraints={})[1]
        assert found
        assert all(math.isfinite(s.height_m) is known for s in found)
        assert all(math.isnan(s.sd_ned_m[2]) for s in found)
