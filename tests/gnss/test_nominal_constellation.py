"""The designed constellations: orbits as published, seen through the broadcast ephemeris."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.gnss.nominal_constellation import (
    GEO_LONGITUDES_DEG,
    IGSO_PRNS,
    Constellation,
    constellation,
    slots,
)
from fusiond.gnss.orbit import WEEK_S

WEEK, TOW = 2400, 345_678.0
T = WEEK * WEEK_S + TOW
WUHAN = (math.radians(30.5276), math.radians(114.3556), 38.0)


@pytest.fixture(scope="module")
def sky() -> Constellation:
    return Constellation(constellation(WEEK, TOW))


def index(sky: Constellation, prns: tuple[int, ...]) -> list[int]:
    return [sky.satellites.index(f"C{prn:02d}") for prn in prns]


def test_numbers_of_satellites() -> None:
    kinds = [slot.kind for slot in slots()]
    assert {k: kinds.count(k) for k in set(kinds)} == {"geo": 3, "igso": 3, "meo": 24, "gps": 24}
    assert len({(s.system, s.prn) for s in slots()}) == 54


def test_geo_stay_at_their_longitude_for_days(sky: Constellation) -> None:
    for prn, longitude in GEO_LONGITUDES_DEG.items():
        (k,) = index(sky, (prn,))
        for hours in range(-48, 49, 3):
            p, v = sky.positions(T + 3600.0 * hours)
            x, y, z = p[k]
            # e = 3e-4: 2 e = 0.034 deg to and fro in a day.
            assert math.degrees(math.atan2(y, x)) == pytest.approx(longitude, abs=0.035)
            assert abs(z) < 1.0
            assert np.linalg.norm(p[k]) == pytest.approx(42_164_170.0, rel=4e-4)
            assert np.linalg.norm(v[k]) < 3.0


def test_igso_cross_the_equator_northward_at_118_degrees(sky: Constellation) -> None:
    rows = index(sky, IGSO_PRNS)
    t = T + np.arange(0.0, 86_164.0, 30.0)
    track = np.array([sky.positions(x)[0][rows] for x in t])
    for k in range(3):
        north = (track[:-1, k, 2] < 0.0) & (track[1:, k, 2] >= 0.0)
        assert np.count_nonzero(north) == 1
        x, y, _ = track[1:, k][north][0]
        assert math.degrees(math.atan2(y, x)) == pytest.approx(118.0, abs=0.3)
        lat = np.degrees(np.arcsin(track[:, k, 2] / np.linalg.norm(track[:, k], axis=1)))
        assert lat.max() == pytest.approx(55.0, abs=0.1)


def test_meo_returns_after_12_h_53_min(sky: Constellation) -> None:
    (k,) = index(sky, (19,))
    # The height above the equatorial plane does not know of the Earth's rotation.
    t = T + np.arange(0.0, 95_000.0, 5.0)
    z = np.array([sky.positions(x)[0][k, 2] for x in t])
    rises = np.flatnonzero((z[:-1] < 0.0) & (z[1:] >= 0.0))
    assert (t[rises[1]] - t[rises[0]]) / 60.0 == pytest.approx(12 * 60 + 53, abs=1.0)


def test_velocity_is_the_derivative_of_position(sky: Constellation) -> None:
    h = 0.5
    ahead, _ = sky.positions(T + h)
    behind, _ = sky.positions(T - h)
    _, v = sky.positions(T)
    # Doubles resolve t to 0.24 us: 1 mm in each position.
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), v, atol=4e-3)


def test_a_later_ephemeris_gives_the_same_orbit(sky: Constellation) -> None:
    for hours in (1, 5, 50):
        later = Constellation(constellation(WEEK, TOW + 3600.0 * hours))
        for t in (T, T + 3600.0 * hours):
            np.testing.assert_allclose(later.positions(t)[0], sky.positions(t)[0], atol=0.01)


def test_broadcast_over_the_end_of_a_week() -> None:
    late = Constellation(constellation(2400, WEEK_S - 10.0))
    early = Constellation(constellation(2401, 5.0))
    t = 2401.0 * WEEK_S
    assert all(0.0 <= e.toe_s < WEEK_S for e in (*late.ephemerides, *early.ephemerides))
    np.testing.assert_allclose(late.positions(t)[0], early.positions(t)[0], atol=0.01)


def test_sky_over_wuhan(sky: Constellation) -> None:
    counts: dict[str, list[int]] = {"C": [], "G": []}
    for hours in range(24):
        seen = sky.line_of_sight(*WUHAN, T + 3600.0 * hours).above(math.radians(10.0))
        for system, n in counts.items():
            n.append(sum(name.startswith(system) for name in seen.satellites))
        assert {"C59", "C60", "C61"} <= set(seen.satellites)
        np.testing.assert_allclose(np.linalg.norm(seen.unit_ned, axis=1), 1.0)
        assert np.all((seen.range_m > 1.9e7) & (seen.range_m < 4.2e7))
    # All three GEO, two or three IGSO, a third of the MEO; a quarter to two fifths of GPS.
    assert min(counts["C"]) >= 9
    assert max(counts["C"]) <= 18
    assert min(counts["G"]) >= 5
    assert max(counts["G"]) <= 12


def test_geo_110_5_stands_in_the_south_of_wuhan(sky: Constellation) -> None:
    view = sky.line_of_sight(*WUHAN, T)
    (k,) = index(sky, (61,))
    # Spherical triangle: cos(psi) = cos(lat) cos(dlon); tan(el) = (cos psi - R/r) / sin psi.
    psi = math.acos(math.cos(WUHAN[0]) * math.cos(math.radians(110.5 - 114.3556)))
    elevation = math.atan((math.cos(psi) - 6371.0 / 42164.17) / math.sin(psi))
    assert view.elevation[k] == pytest.approx(elevation, abs=math.radians(0.3))
    assert math.degrees(view.azimuth[k]) == pytest.approx(187.5, abs=0.5)


def test_unknown_constellation() -> None:
    with pytest.raises(ValueError, match="no constellation"):
        slots(("E",))
