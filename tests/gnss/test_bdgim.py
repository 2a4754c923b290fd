"""BDGIM against an independent evaluation, the bits that broadcast it, and the walk's ranges."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import assoc_legendre_p

from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    Bdgim,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    RawEvent,
    RawGnssEpoch,
)
from fusiond.gnss import bdgim as model
from fusiond.gnss.atmosphere import klobuchar_gps
from fusiond.gnss.bdgim import bdgim, bdgim_terms
from fusiond.gnss.ecef import ned_axes, to_geodetic
from fusiond.gnss.group_delay import group_delay
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import single_point
from fusiond.gnss.store import EphemerisStore

# The example of the program of the model's authors: a GEO seen from Beijing, 35 deg high.
EXAMPLE = Bdgim(
    "gnss", 0,
    (13.82642069, -1.78004616, 5.172, 3.1303094, -4.58961329, 0.32483867, -0.07802383, 1.2431259,
     0.37763627),
)  # fmt: skip
SATELLITE = np.array((-34342443.2642, 24456393.0586, 12949.4754))
STATION = np.array((-2159945.3149, 4383237.1901, 4085412.3177))
WHEN = datetime(2020, 11, 5, 17, tzinfo=UTC)


def gps_time(bdt: datetime) -> tuple[int, float]:
    week, tow = divmod((bdt - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + 14.0, 604_800)
    return int(week), tow


def harmonic(degree: int, order: int, lat: float, lon: float) -> float:
    """Fully normalised, by scipy (whose functions carry the sign (-1)^m)."""
    m = abs(order)
    p = float(assoc_legendre_p(degree, m, math.sin(lat))[0]) * (-1) ** m
    square = math.factorial(degree - m) * (2 * degree + 1) * (2 if m else 1)
    wave = math.sin(m * lon) if order < 0 else math.cos(m * lon)
    return math.sqrt(square / math.factorial(degree + m)) * p * wave


def evaluated(alpha: tuple[float, ...], bdt: datetime, sat: Any, sta: Any) -> tuple[float, float]:
    """VTEC (TECU) and delay at B1C (m) by vectors in space, step by step as the ICD lists them."""
    mjd = (bdt - datetime(1858, 11, 17, tzinfo=UTC)).total_seconds() / 86_400.0
    lat, lon, _ = to_geodetic(*sta)
    line = (sat - sta) / np.linalg.norm(sat - sta)
    up = np.array((math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)))
    elevation = math.asin(float(line @ up))
    # On a sphere: from the earth's radius below the receiver along the ray to the layer.
    beta = math.acos(model.RADIUS_M * math.cos(elevation) / (model.RADIUS_M + model.LAYER_M))
    arc = beta - elevation
    level = (line - up * (line @ up)) / math.cos(elevation)
    point = up * math.cos(arc) + level * math.sin(arc)
    # Turned so that z is the geomagnetic pole and the pole's meridian, seen from there, is -x.
    pl, pb = math.radians(-72.58), math.radians(80.27)
    x = np.array((math.sin(pb) * math.cos(pl), math.sin(pb) * math.sin(pl), -math.cos(pb)))
    y = np.array((-math.sin(pl), math.cos(pl), 0.0))
    z = np.array((math.cos(pb) * math.cos(pl), math.cos(pb) * math.sin(pl), math.sin(pb)))
    sun = math.pi * (1.0 - 2.0 * (mjd - math.floor(mjd)))
    ray = np.array((math.cos(sun), math.sin(sun), 0.0))
    # The ICD's sun: on the equator, but by its longitude from the pole alone.
    towards = math.atan2(math.sin(sun - pl), math.sin(pb) * math.cos(sun - pl))
    assert math.atan2(float(y @ ray), float(x @ ray)) == pytest.approx(towards)
    magnetic_lat = math.asin(float(z @ point))
    magnetic_lon = math.atan2(float(y @ point), float(x @ point)) - towards
    hours = math.floor((mjd - math.floor(mjd)) * 12.0) * 2 + 1
    middle = math.floor(mjd) + hours / 24.0
    total = 0.0
    for a, (n, m) in zip(alpha, model._BROADCAST, strict=True):
        total += a * harmonic(n, m, magnetic_lat, magnetic_lon)
    for row, (n, m) in zip(model._REST_TECU, model._REST, strict=True):
        b = float(row[0])
        for k, days in enumerate(model._PERIODS_D):
            w = 2.0 * math.pi / days * middle
            b += row[1 + 2 * k] * math.cos(w) + row[2 + 2 * k] * math.sin(w)
        total += b * harmonic(n, m, magnetic_lat, magnetic_lon)
    return total, total / math.sin(beta) * 40.28e16 / 1_575_420_000.0**2


def ours(alpha: tuple[float, ...], bdt: datetime, sat: Any, sta: Any) -> float:
    week, tow = gps_time(bdt)
    lat, lon, _ = to_geodetic(*sta)
    line = (sat - sta) / np.linalg.norm(sat - sta)
    north, east, down = (ned_axes(lat, lon).T @ line).tolist()
    level = math.hypot(north, east)
    q = bdgim_terms(replace(EXAMPLE, alpha=alpha), week, tow)
    return float(bdgim(q, tow - 14.0, lat, lon, -down, north / level, east / level))


def test_the_authors_example() -> None:
    """Their steps, with a layer 137 m higher, a mapping by 0.9782 z and 40.3, give 5.818 TECU and
    1.441 m."""
    vtec, delay = evaluated(EXAMPLE.alpha, WHEN, SATELLITE, STATION)
    assert vtec == pytest.approx(5.818, abs=0.02)
    assert delay == pytest.approx(1.441, abs=0.04)
    assert ours(EXAMPLE.alpha, WHEN, SATELLITE, STATION) == pytest.approx(delay, rel=1e-9)


@given(
    st.integers(0, 4000 * 24 * 60),
    st.floats(-1.45, 1.45),
    st.floats(-math.pi, math.pi),
    st.floats(math.radians(5.0), math.radians(88.0)),
    st.floats(-math.pi, math.pi),
    st.lists(st.floats(-2.0, 2.0), min_size=8, max_size=8),
)
@settings(max_examples=200, deadline=None)
def test_it_is_what_vectors_and_scipy_give(
    minutes: int, lat: float, lon: float, elevation: float, azimuth: float, rest: list[float]
) -> None:
    start = datetime(2019, 1, 1, tzinfo=UTC)
    bdt = datetime.fromtimestamp(start.timestamp() + 60 * minutes + 1, UTC)
    up = np.array((math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)))
    axes = ned_axes(lat, lon)
    level = math.cos(azimuth) * axes[:, 0] + math.sin(azimuth) * axes[:, 1]
    station = 6_371_000.0 * up
    lat_sta, lon_sta, _ = to_geodetic(*station)
    axes = ned_axes(lat_sta, lon_sta)
    level = math.cos(azimuth) * axes[:, 0] + math.sin(azimuth) * axes[:, 1]
    line = math.cos(elevation) * level - math.sin(elevation) * axes[:, 2]
    satellite = station + 2.5e7 * line
    alpha = (30.0, *rest)
    vtec, delay = evaluated(alpha, bdt, satellite, station)
    least = 30.0 / 8.0
    expected = delay if vtec > least else delay / vtec * least
    assert ours(alpha, bdt, satellite, station) == pytest.approx(expected, rel=1e-6)


# --------------------------------------------------------------------------- the walk


def _broadcast(found: list[RawEvent]) -> tuple[list[NavigationMessage], list[RawGnssEpoch]]:
    return (
        [e for e in found if isinstance(e, NavigationMessage)],
        [e for e in found if isinstance(e, RawGnssEpoch)],
    )


def test_the_walk_hears_it_of_both_messages(events: list[RawEvent]) -> None:
    models = [e for e in _broadcast(events)[0] if isinstance(e, Bdgim)]
    assert models
    for each in models:
        mean, *rest = each.alpha
        assert 5.0 < mean < 127.0
        assert rest[3] < 0.0
        assert all(abs(a) < 16.0 for a in rest)


def _modelled(found: list[RawEvent], *, without: type) -> dict[str, float]:
    """Ionosphere (m) at B1C by satellite above 20 degrees, at the walk's end."""
    messages, epochs = _broadcast(found)
    store = EphemerisStore()
    for message in messages:
        if not isinstance(message, without):
            store.add(message)
    options = RangeOptions(
        systems=("C",), preferred={"C": ("1P",)}, elevation_mask_rad=math.radians(20.0)
    )
    rows_of = RangeModel(store, options)
    solved = single_point(rows_of, epochs[-1])
    assert not isinstance(solved, str)
    rows = rows_of.rows(epochs[-1], solved.position)
    return dict(zip(rows.satellites, rows.ionosphere_m.tolist(), strict=True))


def _measured(found: list[RawEvent]) -> dict[str, float]:
    """The same of two carriers: medians of B2a less B1C over the last 100 s."""
    messages, epochs = _broadcast(found)
    store, apart = EphemerisStore(), dict[str, list[float]]()
    for message in messages:
        store.add(message)
    share = (CARRIER_HZ["C", "1"] / CARRIER_HZ["C", "5"]) ** 2 - 1.0
    for epoch in epochs[-400:]:
        ranges = {(s.satellite, s.signal): s.pseudorange_m for s in epoch.signals}
        for s in epoch.signals:
            one, five = (ranges.get((s.satellite, name)) for name in ("1P", "5P"))
            e = store.select(s.system, s.prn, epoch.week, epoch.tow_s, "1")
            if s.signal != "1P" or one is None or five is None or isinstance(e, str):
                continue
            delays = [group_delay(e, name) for name in ("1P", "5P")]
            if delays[0] is not None and delays[1] is not None:
                between = SPEED_OF_LIGHT_M_S * (delays[1].delay_s - delays[0].delay_s)
                apart.setdefault(s.satellite, []).append((five - one - between) / share)
    return {name: float(np.median(values)) for name, values in apart.items()}


def test_it_is_nearer_to_what_two_carriers_measure(events: list[RawEvent]) -> None:
    """In Colorado, where BeiDou-2's Klobuchar, made for Asia, has twice the delay."""
    measured = _measured(events)
    new, old = _modelled(events, without=Klobuchar), _modelled(events, without=Bdgim)
    names = sorted(measured.keys() & new.keys() & old.keys())
    assert len(names) >= 6
    truth = np.array([measured[n] for n in names])
    left = [np.sqrt(np.mean((np.array([m[n] for n in names]) - truth) ** 2)) for m in (new, old)]
    assert left[0] < 2.5
    assert left[0] < 0.35 * left[1]


def test_it_serves_other_systems_where_gps_sends_none(events: list[RawEvent]) -> None:
    messages, epochs = _broadcast(events)
    store = EphemerisStore()
    for message in messages:
        if isinstance(message, Bdgim | Ephemeris):
            store.add(message)
    rows_of = RangeModel(store, RangeOptions(systems=("E",)))
    solved = single_point(rows_of, epochs[-1])
    assert not isinstance(solved, str)
    assert rows_of.rows(epochs[-1], solved.position).ionosphere_m.min() > 0.5
    version = store.version
    store.add(next(m for m in reversed(messages) if isinstance(m, Bdgim)))
    assert store.version == version


def test_klobuchar_and_it_agree_on_day_and_night() -> None:
    """A calm day at middle latitudes: more at noon than at midnight, by both."""
    alpha, beta = (1.1e-8, 1.5e-8, -6e-8, -6e-8), (9e4, 6e4, -2e5, -1e5)
    gps = np.array((*alpha, *beta))
    by_hour = []
    for hour in (2, 13):
        week, tow = gps_time(datetime(2020, 11, 5, (hour - 8) % 24, 30, tzinfo=UTC))
        q = bdgim_terms(EXAMPLE, week, tow)
        lat, lon = math.radians(39.9), math.radians(116.4)
        new = bdgim(q, tow - 14.0, lat, lon, 1.0, 1.0, 0.0)
        old = klobuchar_gps(gps, tow, lat, lon, math.pi / 2, 1.0, 0.0)
        by_hour.append((new, old))
    assert by_hour[1][0] > 1.5 * by_hour[0][0]
    assert by_hour[1][1] > 1.5 * by_hour[0][1]
