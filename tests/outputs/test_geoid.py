"""Heights above the sea: EGM96 where nothing is configured."""

from __future__ import annotations

from math import nan

import pytest

from fusiond.navigation.solution import Mode
from fusiond.outputs.geoid import geoid_separation_m, sea_height
from tests.outputs.serving import nav

# Test points of the interpolation program that NIMA published with EGM96 (OUTINTPT.DAT).
PLACES = [
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
]


@pytest.mark.parametrize(("lat_deg", "lon_deg", "separation_m"), PLACES)
def test_separation_is_that_of_egm96(lat_deg: float, lon_deg: float, separation_m: float) -> None:
    assert geoid_separation_m(lat_deg, lon_deg) == pytest.approx(separation_m, abs=0.7)
    assert geoid_separation_m(lat_deg, lon_deg - 360.0) == geoid_separation_m(lat_deg, lon_deg)


def test_poles_and_the_meridian_of_0_have_one_value() -> None:
    assert geoid_separation_m(90.0, 10.0) == pytest.approx(13.6, abs=0.7)
    assert geoid_separation_m(-90.0, 200.0) == pytest.approx(-29.5, abs=0.7)
    before, after = geoid_separation_m(10.0, 359.9999), geoid_separation_m(10.0, 0.0001)
    assert before == pytest.approx(after, abs=0.01)


def test_configured_separation_takes_its_place() -> None:
    at = nav(height_m=20.0)
    own, table = sea_height(at, 11.3), sea_height(at, None)
    assert own == (pytest.approx(8.7), 11.3)
    assert table is not None
    assert table.above_sea_m + table.separation_m == pytest.approx(20.0)


@pytest.mark.parametrize(
    "missing",
    [
        {"height_m": nan},
        {"height_m": None},
        {"sd_d_m": nan},
        {"lat_deg": None},
        {"mode": Mode.INVALID},
    ],
)
def test_unknown_solutions_have_no_sea_height(missing: dict[str, object]) -> None:
    assert sea_height(nav(**missing), None) is None
