"""Coordinates and atmosphere against RTKLIB and against geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.raw.messages import SPEED_OF_LIGHT_M_S
from fusiond.gnss.atmosphere import (
    klobuchar_beidou,
    klobuchar_gps,
    mapping,
    mapping_coefficients,
    slant,
    zenith_delays,
)
from fusiond.gnss.ecef import ned_axes, to_ecef, to_geodetic
from tests.gnss.examples import oracle_time, vector
from tests.gnss.examples import rtk as pyrtklib

WEEK = 2381
PLACES = [(0.5328, 1.9958, 38.0), (0.6998, -1.8352, 1600.0), (-0.59, 2.64, 20.0), (1.2, 0.3, 0.0)]
ALPHA = (1.4901e-8, 2.2352e-8, -5.9605e-8, -1.1921e-7)
BETA = (1.1264e5, 1.4746e5, -1.3107e5, -5.8982e5)


@pytest.mark.parametrize("height", [-400.0, 0.0, 1600.0, 12e3, 2.0e7, 3.6e7])
@pytest.mark.parametrize("lat", [-1.5707, -0.9, 0.0, 1e-5, 0.53, 1.55])
def test_geodetic_and_back(lat: float, height: float) -> None:
    for lon in (-3.1, 0.0, 1.9):
        x, y, z = to_ecef(lat, lon, height)
        back = to_geodetic(x, y, z)
        assert abs(back[0] - lat) < 1e-11
        assert abs(back[1] - lon) < 1e-14
        assert abs(back[2] - height) < 1e-7
        out = vector(0, 0, 0)
        pyrtklib.pos2ecef(vector(lat, lon, height), out)
        assert np.abs(np.array([out[i] for i in range(3)]) - (x, y, z)).max() < 1e-6


def test_axes_are_north_east_down() -> None:
    lat, lon, step = 0.53, 1.99, 1e-6
    axes = ned_axes(lat, lon)
    here = np.array(to_ecef(lat, lon, 100.0))
    for k, there in enumerate(
        [(lat + step, lon, 100.0), (lat, lon + step, 100.0), (lat, lon, 99.0)]
    ):
        d = np.array(to_ecef(*there)) - here
        assert np.allclose(axes[:, k], d / np.linalg.norm(d), atol=2e-6)
    assert np.allclose(axes.T @ axes, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(("lat", "lon", "height"), PLACES)
def test_zenith_delay_is_that_of_rtklib(lat: float, lon: float, height: float) -> None:
    dry, wet = zenith_delays(lat, height)
    theirs = pyrtklib.tropmodel(
        oracle_time(WEEK, 1e5), vector(lat, lon, height), vector(0.0, math.pi / 2), 0.7
    )
    assert abs(dry + wet - theirs) < 1e-3
    assert 2.3 < zenith_delays(0.6, 0.0)[0] + zenith_delays(0.6, 0.0)[1] < 2.5


def test_height_is_clamped() -> None:
    assert zenith_delays(0.5, -300.0) == zenith_delays(0.5, 0.0)
    assert zenith_delays(0.5, 5e5) == zenith_delays(0.5, 10_000.0)


@pytest.mark.parametrize("week", [2370, 2383, 2396])
@pytest.mark.parametrize(("lat", "lon", "height"), PLACES)
def test_mapping_is_that_of_rtklib(lat: float, lon: float, height: float, week: int) -> None:
    q = np.empty(7)
    mapping_coefficients(lat, height, week * 7 + 1e5 / 86400, q)
    for elevation in np.radians([5.0, 10.0, 15.0, 30.0, 60.0, 90.0]):
        their_wet = vector(0)
        theirs = pyrtklib.tropmapf(
            oracle_time(week, 1e5), vector(lat, lon, height), vector(1.0, elevation), their_wet
        )
        dry, wet = mapping(math.sin(elevation), q)
        # a day's difference in the season at most, times 2.4 m: 1 mm at 5 deg
        assert abs(dry - theirs) * 2.4 < 1e-3
        assert abs(wet - their_wet[0]) * 0.2 < 1e-3


@pytest.mark.parametrize(("lat", "lon", "height"), PLACES)
def test_gps_ionosphere_is_that_of_rtklib(lat: float, lon: float, height: float) -> None:
    q = np.array(ALPHA + BETA)
    ion = vector(*q)
    seen = []
    for tow in np.arange(0.0, 604800.0, 41000.0):
        for elevation in np.radians([5.0, 20.0, 45.0, 89.0]):
            for azimuth in (0.1, 2.0, 4.5):
                ours = klobuchar_gps(
                    q, tow, lat, lon, elevation, math.cos(azimuth), math.sin(azimuth)
                )
                theirs = pyrtklib.ionmodel(
                    oracle_time(WEEK, tow),
                    ion,
                    vector(lat, lon, height),
                    vector(azimuth, elevation),
                )
                assert abs(ours - theirs) < 1e-3
                seen.append(ours)
    assert max(seen) > 3 * min(seen)


def test_beidou_ionosphere_against_the_geometry_of_its_layer() -> None:
    """The pierce point as the intersection of a line and a sphere, not by the ICD's angles."""
    lat, lon = 0.5328, 1.9958
    q = np.array((2.8e-8, 1.1e-7, -4.2e-7, 5.9e-7, 1.2e5, -3.1e5, 1.9e6, -9.2e5))
    radius, layer = 6_378_000.0, 6_753_000.0
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    axes = ned_axes(lat, lon)
    for tow in (3600.0, 6 * 3600.0, 20 * 3600.0, 6 * 86400.0 + 7 * 3600.0):
        for e, a in ((0.2, 0.3), (0.8, 3.0), (1.4, 5.5)):
            sight = axes @ (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), -math.sin(e))
            along = -radius * (up @ sight) + math.sqrt(
                (radius * (up @ sight)) ** 2 + layer**2 - radius**2
            )
            pierce = (radius * up + along * sight) / layer
            phi = abs(math.asin(pierce[2])) / math.pi
            local = (tow + math.degrees(math.atan2(pierce[1], pierce[0])) * 240.0) % 86400.0
            amplitude = max(np.polynomial.polynomial.polyval(phi, q[:4]), 0.0)
            period = np.clip(np.polynomial.polynomial.polyval(phi, q[4:]), 72000.0, 172800.0)
            vertical = 5e-9
            if abs(local - 50400.0) < period / 4:
                vertical += amplitude * math.cos(2 * math.pi * (local - 50400.0) / period)
            expected = SPEED_OF_LIGHT_M_S * vertical / (pierce @ sight)
            ours = klobuchar_beidou(q, tow, lat, lon, math.sin(e), math.cos(a), math.sin(a))
            assert ours == pytest.approx(expected, abs=1e-6)


def test_slant_grows_from_one() -> None:
    assert slant(1.0) == pytest.approx(1.0, abs=1e-4)
    assert slant(math.sin(math.radians(5.0))) == pytest.approx(10.2, abs=0.1)
