"""Without an inertial unit: ranges, wheels, headings, bearings, an operator's position."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import (
    Attitude,
    Bearing,
    Heading,
    Measurement,
    MonotonicStamp,
    PositionFix,
    WheelSpeed,
)
from drivers.raw.messages import RawGnssEpoch
from fusiond.aiding.landmark_bearing import line_of_sight
from fusiond.configuration.schema import Config
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.raw import GnssRaw, GnssRawOptions
from fusiond.simulation.imu_truth import Truth
from tests import runs
from tests.navigator.vehicle import START_NS, drive

Array = NDArray[np.float64]
Arrivals = Iterable[tuple[int, Measurement | RawGnssEpoch]]

TICK_NS = 100_000_000
WHEELED: dict[str, Any] = {"constraints": {"non_holonomic": {"enabled": True}}}
FIXES = {"kind": "gnss", "bias_sd_m": 0.0, "time_offset_sd_s": 0.0, "lever_arm_sd_m": 0.0}


def driven(navigator: Navigator, arrivals: Arrivals) -> list[Solution]:
    """What is said at each tick of the drive."""
    said, waiting = [], sorted(arrivals, key=lambda arrival: arrival[0])
    for now in range(START_NS + TICK_NS, int(drive().times[-1]) + 1, TICK_NS):
        while waiting and waiting[0][0] <= now:
            t_ns, m = waiting.pop(0)
            assert navigator.add(m, t_ns, 0.0, t_ns) == "accepted"
        navigator.tick(now)
        said.append(navigator.solution(now))
    return said


def errors(said: Iterable[Solution], truth: Truth) -> tuple[Array, Array]:
    """Horizontal errors of position and velocity (m, 4), and their sigmas."""
    off, sds = [], []
    for s in said:
        true = truth.at(np.array([(s.t_ns - START_NS) * 1e-9]))
        metres = runs.metres_per_unit(true.position[0, 0], true.position[0, 2])
        way = (np.array([s.lat_rad, s.lon_rad]) - true.position[0, :2]) * metres[:2]
        off.append([*way, *(np.array(s.v_ned_m_s[:2]) - true.v_ned[0, :2])])
        sds.append([*s.sd_ned_m[:2], *s.sd_v_ned_m_s[:2]])
    return np.array(off), np.array(sds)


def test_raw_ranges_alone_navigate() -> None:
    truth = drive().truth
    sim = GnssRaw(truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(4))
    section = {"kind": "raw", "systems": ["G", "C"], "lever_arm_m": [1.0, 0.0, 0.0]}
    navigator = Navigator(Config.model_validate({"aiding": {"roof": section}}))
    seen = {(s.system, s.prn) for k in range(len(sim)) for s in sim.epoch(k).signals}
    for message in (*sim.broadcast(0.0, seen), *sim.ionosphere):
        navigator.raw["roof"].learn(message)
    sim = GnssRaw(truth, GnssRawOptions(rate_hz=1.0), np.random.default_rng(4))
    said = driven(navigator, [(START_NS + k * runs.SECOND, _epoch(sim, k)) for k in range(1, 43)])
    assert said[40].mode is Mode.NAVIGATING
    assert said[40].reason.endswith("no inertial unit: constant velocity, no attitude")
    off, sd = errors(said[60:], truth)
    assert np.sqrt(np.mean(off[:, :2] ** 2)) < 1.5
    assert np.abs(off / sd).max() < 4.0
    # A fix holds the velocity, too, by rates: without them it would be off by metres a second.
    assert np.sqrt(np.mean(off[:, 2:] ** 2)) < 0.8
    assert navigator.outcomes()["roof"]["fused"] > 35
    sky = navigator.raw["roof"].sky()
    assert len(sky.used) > 8
    assert sky.innovation_rms is not None


def _epoch(sim: GnssRaw, k: int) -> RawGnssEpoch:
    """Epoch k, which is true at k + 1 s, as if it came from the roof a second earlier."""
    epoch = sim.epoch(k - 1)
    return RawGnssEpoch(
        *("roof", START_NS + k * runs.SECOND, MonotonicStamp(START_NS + k * runs.SECOND)),
        *(epoch.week, epoch.tow_s, epoch.signals, epoch.clock_reset),
    )


def _town(until_s: float) -> list[tuple[int, Measurement]]:
    """Fixes until then; wheel and heading ten times a second all the time."""
    d, rng = drive(), np.random.default_rng(8)
    found: list[tuple[int, Measurement]] = [
        (m.t_seen_ns, m)
        for m in d.measurements
        if isinstance(m, PositionFix) and m.t_seen_ns < START_NS + until_s * runs.SECOND
    ]
    times = np.arange(9.05, 43.0, 0.1)
    states = d.truth.at(times)
    for t_s, v, rpy in zip(times, states.v_ned, states.rpy, strict=True):
        at = START_NS + round(t_s * 1e9)
        speed = math.hypot(*v[:2]) + 0.05 * float(rng.standard_normal())
        yaw = float(rpy[2]) + 0.02 * float(rng.standard_normal())
        found.append((at, WheelSpeed("wheel", at, MonotonicStamp(at), speed)))
        found.append((at, Heading("heading", at, MonotonicStamp(at), yaw, 0.02)))
    return found


def test_wheel_and_heading_carry_on_where_fixes_end() -> None:
    wheel = {"kind": "wheel", "latency_sd_s": 0.0, "scale_sd": 0.01}
    aiding = {"gnss": FIXES, "wheel": wheel, "heading": {"kind": "heading"}}
    both = Navigator(Config.model_validate({**WHEELED, "aiding": aiding}))
    alone = Navigator(Config.model_validate({**WHEELED, "aiding": {"gnss": FIXES}}))
    truth, arrivals = drive().truth, _town(20.0)
    said = driven(both, arrivals)
    without = driven(alone, [(t, m) for t, m in arrivals if isinstance(m, PositionFix)])
    # Two bends and a stop, 20 s without a fix.
    off, sd = errors(said[200:400], truth)
    assert np.abs(off / sd).max() < 4.0
    assert 0.15 < np.mean((off / sd) ** 2) < 1.4
    lost, wide = errors(without[399:400], truth)
    assert np.hypot(*off[-1, :2]) < 5.0 < 0.1 * np.hypot(*lost[0, :2])
    assert np.hypot(*sd[-1, :2]) < 0.05 * np.hypot(*wide[0, :2])
    counts = both.outcomes()
    assert counts["wheel"]["fused"] > 250
    assert counts["heading"]["fused"] > 250
    assert said[395].mode is Mode.COASTING  # nothing but fixes locates


def test_a_heading_of_a_vehicle_that_may_slide_is_left_out() -> None:
    aiding = {"gnss": FIXES, "heading": {"kind": "heading"}}
    navigator = Navigator(Config.model_validate({"aiding": aiding}))
    driven(navigator, [(t, m) for t, m in _town(44.0) if not isinstance(m, WheelSpeed)])
    assert navigator.without_imu.active
    assert set(navigator.without_imu.counted()["heading"]) == {"no_attitude"}


def test_the_order_in_which_headings_and_speeds_come_leaves_no_trace() -> None:
    aiding = {"gnss": FIXES, "wheel": {"kind": "wheel"}, "heading": {"kind": "heading"}}
    ends = []
    for delay_s in (0.0, 0.7):
        navigator = Navigator(Config.model_validate({**WHEELED, "aiding": aiding}))
        arrivals = [
            (t + (round(delay_s * 1e9) if isinstance(m, Heading) else 0), m) for t, m in _town(20.0)
        ]
        said, waiting = [], sorted(arrivals, key=lambda arrival: arrival[0])
        for now in range(START_NS + TICK_NS, START_NS + 30 * runs.SECOND, TICK_NS):
            while waiting and waiting[0][0] <= now:
                seen, m = waiting.pop(0)
                navigator.add(m, m.t_seen_ns, 0.0, seen)
            navigator.tick(now)
            said.append(navigator.solution(now))
        for _, m in waiting:  # what is still under way
            if m.t_seen_ns <= said[-1].t_ns:
                navigator.add(m, m.t_seen_ns, 0.0, said[-1].t_ns)
        navigator.tick(said[-1].t_ns)
        active_filter = navigator.active_filter
        ends.append((active_filter.nav.copy(), active_filter.covariance.copy()))
    # But for the Coriolis force of samples that were made before a heading came.
    assert np.abs(runs.nav_error(ends[0][0], ends[1][0])[3:]).max() < 5e-3
    assert np.allclose(ends[0][1], ends[1][1], rtol=1e-4, atol=1e-9)


def test_an_operator_says_where_it_is_and_a_wheel_goes_on() -> None:
    aiding = {"wheel": {"kind": "wheel"}, "heading": {"kind": "heading"}}
    navigator = Navigator(Config.model_validate({**WHEELED, "aiding": aiding}))
    truth = drive().truth
    lat, lon, height = (float(x) for x in truth.at(np.array([9.0])).position[0])
    begin = START_NS + 9 * runs.SECOND
    assert navigator.set_position(lat, lon, height, 3.0, begin) == "beginning"
    moved = [(t, m) for t, m in _town(0.0)]
    said = driven(navigator, moved)
    off, sd = errors(said[150:400], truth)
    assert np.abs(off / sd).max() < 4.0
    assert np.hypot(*off[-1, :2]) < 12.0
    # Later it is a fix like any other, and one that is far off is refused.
    now = said[-1].t_ns
    lat, lon, height = (float(x) for x in truth.at(np.array([43.9])).position[0])
    assert navigator.set_position(lat + 0.01, lon, height, 3.0, now) == "gated"
    assert navigator.set_position(lat, lon, height, 3.0, now + TICK_NS) == "fused"


SQUARE: dict[str, Any] = {"misalignment_sd_arcsec": 0.0}
"""Of a sensor whose axes are the body's."""
POINTS = {"1": (30.53, 114.33, 20.0), "2": (30.47, 114.34, 30.0)}


def _seen(until_s: float, attitudes: bool) -> list[tuple[int, Measurement]]:
    """Fixes until then; bearings of two points in turn and attitudes, once a second."""
    d, rng = drive(), np.random.default_rng(9)
    found: list[tuple[int, Measurement]] = [
        (m.t_seen_ns, m)
        for m in d.measurements
        if isinstance(m, PositionFix) and m.t_seen_ns < START_NS + until_s * runs.SECOND
    ]
    for t_s in np.arange(9.0, 43.0, 1.0):
        at, true = START_NS + round(t_s * 1e9), d.truth.at(np.array([t_s]))
        stamp, noise = MonotonicStamp(at), rng.standard_normal(5) * 1e-3
        if attitudes:
            roll, pitch, yaw = (true.rpy[0] + noise[:3]).tolist()
            found.append((at, Attitude("star", at, stamp, (roll, pitch, yaw), (1e-3,) * 3)))
        name = str(1 + round(t_s) % 2)
        lat, lon, height = POINTS[name]
        point = math.radians(lat), math.radians(lon), height
        place = tuple(true.position[0].tolist())
        x, y, z = dcm_from_rpy(*true.rpy[0].tolist()).T @ line_of_sight(place, point)
        azimuth, elevation = (
            math.atan2(y, x) + noise[3],
            math.atan2(-z, math.hypot(x, y)) + noise[4],
        )
        of = Bearing("sar", at, stamp, azimuth, elevation, (1e-3, 1e-3), name)
        found.append((at + 1, of))  # after the attitude of the same instant
    return found


@pytest.mark.parametrize("attitudes", [True, False])
def test_bearings_carry_on_where_fixes_end_if_something_measures_the_attitude(
    attitudes: bool,
) -> None:
    sar = {"kind": "sar", "min_range_m": 100.0, "targets_deg_m": POINTS, **SQUARE}
    aiding = {"gnss": FIXES, "sar": sar, "star": {"kind": "star_tracker", **SQUARE}}
    navigator = Navigator(Config.model_validate({"aiding": aiding}))
    said = driven(navigator, _seen(20.0, attitudes))
    off, sd = errors(said[250:420], drive().truth)
    assert np.abs(off / sd).max() < 4.0
    counts = navigator.outcomes()["sar"]
    if attitudes:
        # Points 4 km away to 1.4 mrad are 6 m across the sight, the other one crosses it.
        assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) < 15.0
        assert 0.15 < np.mean((off / sd)[:, :2] ** 2) < 1.6
        assert np.hypot(*sd[-1, :2]) < 15.0
        assert counts["fused"] > 25
    else:
        assert np.hypot(*sd[-1, :2]) > 50.0, "one bearing has two angles, an attitude three"
        assert counts["fused"] == 0
        assert counts["no_attitude"] > 25
