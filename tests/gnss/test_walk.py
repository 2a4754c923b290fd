"""Least-squares solutions of the real walk, causally, against its RTK track.

The track hangs on a base station of unstated datum. GPS, Galileo and BeiDou, each alone, are off it
by 3 to 5 m north, 6 to 7 m east and 24 to 27 m down. Of the latter 21.4 m are the geoid: the file's
heights are those above the sea of the receiver's own UBX-NAV-PVT, not the ellipsoid's. Ionosphere-
free pairs of Galileo give 4 north, 4 east, 17 down (one epoch scatters by 2, 3 and 10 m): the
horizontal part is not the ionosphere's model, some of the vertical part is: that is with Klobuchar,
and BDGIM, which B-CNAV brings too, gives 17 to 19 down. The range model agrees with RTKLIB's to
1 cm, so the rest is put down to the track, which nothing here can prove. The solutions are judged
about their mean and against each other; RMS to the track is not asserted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.raw.messages import (
    Bdgim,
    Ephemeris,
    Klobuchar,
    NavigationMessage,
    RawEvent,
    RawGnssEpoch,
    System,
)
from fusiond.files.measurement_csv import read_gnss
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.ranges import RangeModel, RangeOptions
from fusiond.gnss.single_point import SinglePoint, single_point
from fusiond.gnss.store import EphemerisStore
from tests.gnss.conftest import WALK


def _errors(
    events: list[RawEvent], systems: tuple[System, ...]
) -> tuple[np.ndarray, np.ndarray, list[SinglePoint]]:
    """Errors north, east, down (n, 3) in m, and of velocity (n, 3) in m/s, epoch by epoch."""
    track = read_gnss(WALK / "gnss.csv")
    places = zip(track.lat_rad, track.lon_rad, track.height_m, strict=True)
    truth = np.array([to_ecef(*map(float, p)) for p in places])
    axes = ned_axes(float(track.lat_rad[0]), float(track.lon_rad[0]))
    store = EphemerisStore()
    model = RangeModel(store, RangeOptions(systems=systems))

    def at(t: float) -> np.ndarray:
        return np.array([np.interp(t, track.t_s, truth[:, i]) for i in range(3)])

    errors, rates, found = [], [], []
    for event in events:
        if isinstance(event, NavigationMessage):
            store.add(event)
            continue
        assert isinstance(event, RawGnssEpoch)
        t = event.tow_s
        solved = single_point(model, event)
        if isinstance(solved, str) or not track.t_s[0] < t < track.t_s[-1]:
            continue
        errors.append((solved.position - at(t)) @ axes)
        found.append(solved)
        if solved.velocity is not None:
            rates.append((solved.velocity - (at(t + 0.125) - at(t - 0.125)) / 0.25) @ axes)
    return np.array(errors), np.array(rates), found


OF_ONE_FREQUENCY = pytest.mark.xfail(strict=True, reason="satellites go over to other signals")
"""Bounds that held with one frequency."""


@pytest.mark.parametrize(
    ("systems", "epochs", "scatter_m"),
    [
        (("G", "E", "C"), 400, 1.5),
        (("C",), 350, 3.2),
        pytest.param(("C",), 350, 1.5, marks=OF_ONE_FREQUENCY),
        (("E",), 300, 1.8),
        (("G",), 60, 1.0),
    ],
)
def test_scatter_about_the_mean(
    events: list[RawEvent], systems: tuple[System, ...], epochs: int, scatter_m: float
) -> None:
    """How many epochs there are is when the ephemerides came: GPS's fourth 18 s before the end.
    BeiDou's is of its level, as satellites go over from B3I to B1C and B2a when B-CNAV comes."""
    errors, _, _ = _errors(events, systems)
    late = errors[-epochs:]
    assert len(errors) >= epochs
    assert np.hypot(*late.std(axis=0)[:2]) < scatter_m


@pytest.mark.parametrize(
    ("left_out", "level_m", "height_m"),
    [
        (Bdgim, 5.0, 4.0),
        (Klobuchar, 5.0, 4.0),
        pytest.param(Bdgim, 3.0, 4.0, marks=OF_ONE_FREQUENCY),
        pytest.param(Klobuchar, 3.6, 2.0, marks=OF_ONE_FREQUENCY),
    ],
)
def test_systems_agree_with_each_other(
    events: list[RawEvent], left_out: type, level_m: float, height_m: float
) -> None:
    """With one ionosphere for all, and with what two carriers measure so far: within a minute or so
    that is little, and noisy (north by 4.3 m, east by 3.1 with Klobuchar's)."""
    of_one = [e for e in events if not isinstance(e, left_out)]
    means = [_errors(of_one, (s,))[0][-250:].mean(axis=0) for s in ("G", "E", "C")]
    apart = np.ptp(means, axis=0)
    assert apart[:2].max() < level_m
    assert apart[2] < height_m


def _alone(events: list[RawEvent], signal: str, messages: tuple[str, ...]) -> dict[float, Any]:
    """Positions by epoch of one BeiDou signal, with what the satellites' `messages` say."""
    store, found = EphemerisStore(), {}
    for event in events:
        if isinstance(event, Ephemeris) and event.message in messages:
            store.add(event)
    model = RangeModel(store, RangeOptions(systems=("C",), preferred={"C": (signal,)}))
    for event in events:
        if isinstance(event, RawGnssEpoch):
            mine = tuple(s for s in event.signals if s.signal == signal)
            solved = single_point(model, replace(event, signals=mine))
            if not isinstance(solved, str):
                found[event.tow_s] = solved.position
    return found


@pytest.mark.parametrize(
    ("signal", "messages"), [("1P", ("bcnav1",)), ("5P", ("bcnav2",)), ("5P", ("bcnav1",))]
)
def test_b1c_and_b2a_agree_with_b3i(
    events: list[RawEvent], signal: str, messages: tuple[str, ...]
) -> None:
    """Each signal by its own message alone. Delays of up to 85 ns (26 m) that were left out, or had
    the other sign, would part them by ten metres; the ionosphere's model is of none of them, so
    that its delay, 1.5 to 1.8 times as large on the lower carriers, is what is left in height."""
    b3i, other = _alone(events, "6I", ("d1",)), _alone(events, signal, messages)
    common = sorted(b3i.keys() & other.keys())
    assert len(common) > 500
    axes = ned_axes(*np.radians((40.0967, -105.1470)))
    apart = np.array([(other[t] - b3i[t]) @ axes for t in common]).mean(axis=0)
    assert np.hypot(*apart[:2]) < 2.0
    assert abs(apart[2]) < 6.0
    assert _alone(events, signal, ("d1",)) == {}


def test_velocity_of_a_walker(events: list[RawEvent]) -> None:
    _, rates, _ = _errors(events, ("G", "E", "C"))
    assert np.sqrt((rates[-400:, :2] ** 2).sum(axis=1).mean()) < 0.3


def test_what_is_refused_is_named(events: list[RawEvent]) -> None:
    refused = {r for s in _errors(events, ("G", "E", "C"))[2] for r in s.refused}
    assert ("C50", "unhealthy") in refused
    assert ("E14", "unhealthy") in refused
    assert {"no_ephemeris", "weak_signal"} <= {reason for _, reason in refused}
