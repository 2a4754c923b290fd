"""The error of simulated RDSS fixes: eq. 4 of paper 000, north, east and height together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import NotApplicable
from fusiond.aiding.rdss_fix_covariance import RdssGeometry, with_floor
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssCentre, RdssOptions
from fusiond.simulation.trajectories import static

Array = NDArray[np.float64]
FIXES = 2000
OPTIONS = RdssOptions()
PLACES = {"sanya": (18.2, 109.5), "yantai": (37.5, 121.4), "urumqi": (43.8, 87.6)}


def errors(place: tuple[float, float], options: RdssOptions, given: float | None = None) -> Array:
    """North, east and height error (FIXES, 3) in m."""
    lat, lon, height = math.radians(place[0]), math.radians(place[1]), 40.0
    truth = Truth(static(10.0), (lat, lon, height), 1.0, 10.0)
    centre = RdssCentre(truth, options, np.random.default_rng(5))
    out = np.empty((FIXES, 3))
    for k in range(FIXES):
        fix = centre.fix(5.0, given)
        out[k] = (
            (math.radians(fix.lat_deg) - lat) * (meridian_radius(lat) + height),
            (math.radians(fix.lon_deg) - lon) * (transverse_radius(lat) + height) * math.cos(lat),
            fix.height_m - height,
        )
    return out


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("class_m", [20, 100])
def test_fixes_have_the_covariance_of_equation_4(name: str, class_m: int) -> None:
    """With the class as its floor; 2000 fixes know each entry to 5 sigma of 3.2 %."""
    lat, lon = (math.radians(x) for x in PLACES[name])
    geometry = RdssGeometry(OPTIONS.satellites_deg)
    found = geometry.covariance(lat, lon, 40.0, OPTIONS.range_sd_m, OPTIONS.height_sd_m)
    by = geometry.sensitivity(lat, lon, 40.0)
    assert not isinstance(found, NotApplicable)
    assert not isinstance(by, NotApplicable)
    expected = np.zeros((3, 3))
    expected[:2, :2] = with_floor(found.total, class_m)
    expected[2, 2] = OPTIONS.height_sd_m**2
    expected[:2, 2] = expected[2, :2] = by.height * OPTIONS.height_sd_m**2
    e = errors(PLACES[name], replace(OPTIONS, precision_class_m=class_m))
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(e.T) / np.outer(sd, sd), expected / np.outer(sd, sd), atol=5 * 0.032
    )


def test_a_given_height_shifts_the_fix_by_its_own_error() -> None:
    """As far north as the geometry says, and the fix states that height."""
    place = PLACES["yantai"]
    by = RdssGeometry().sensitivity(*(math.radians(x) for x in place), 40.0)
    assert not isinstance(by, NotApplicable)
    right, wrong = (errors(place, OPTIONS, given=height) for height in (40.0, 140.0))
    np.testing.assert_allclose(right[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(wrong[:, 2], 100.0)
    shift = (wrong - right)[:, :2]
    np.testing.assert_allclose(shift, np.tile(100.0 * by.height, (FIXES, 1)), rtol=1e-4, atol=1e-2)
    assert by.height[0] > 0.9


def test_errors_may_be_told_instead() -> None:
    e = errors(PLACES["yantai"], replace(OPTIONS, error_sd_m=5.0))
    assert e[:, :2].std(axis=0) == pytest.approx([5.0, 5.0], rel=0.08)
    assert abs(np.corrcoef(e.T)[0, 1]) < 0.11


def test_at_the_equator_the_class_is_all() -> None:
    e = errors((0.0, 110.0), OPTIONS)
    assert e[:, :2].std(axis=0) == pytest.approx([20.0, 20.0], rel=0.08)
