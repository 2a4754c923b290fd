"""Faults of the sensors other than the IMU: fixes of receiver and RDSS terminal, wheel speeds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from drivers.measurements import DelayedFix, Measurement, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.simulation.imu_truth import metres_to_geodetic
from fusiond.studies.faults.sensor_data import Alter, Received, Recording

STEP_M = 500.0
DRIFT_M_S = 0.5
BURST_M = 450.0
BURST_EVERY_NS = 1_000_000
MULTIPATH_M = 80.0
MULTIPATH_S, TUNNEL_S = 0.6, 60.0
TINY_SD_M = 1e-9
VELOCITY_RAMP_M_S2 = 0.1
DELAY_S = 0.8
HUGE = 1e300
FAST_M_S = 2000.0 * 1852.0 / 3600.0
"""2,000 knots."""
AHEAD_NS = 5_000_000_000
WHEEL_SCALE = 1.2

M = TypeVar("M", bound=Measurement)
Velocity = tuple[float, float, float | None]


def _changed(
    r: Recording, begin_s: float, length_s: float, kind: type[M], change: Callable[[M, float], M]
) -> Recording:
    """Apply `change(measurement, seconds since start)` to the measurements of a kind that are valid
    in the window."""
    received = []
    for item in r.received:
        m, since_s = item.measurement, item.t_ns * 1e-9 - begin_s
        if isinstance(m, kind) and 0.0 <= since_s < length_s:
            received.append(replace(item, measurement=change(m, since_s)))
        else:
            received.append(item)
    return r.with_received(received)


def _fixes(r: Recording, begin_s: float, end_s: float) -> list[Received]:
    """The receiver's fixes that are valid from `begin_s` to before `end_s`."""
    return [
        item
        for item in r.received
        if isinstance(item.measurement, PositionFix) and begin_s * 1e9 <= item.t_ns < end_s * 1e9
    ]


def except_source(alter: Alter, source: str) -> Alter:
    """Restrict a change of a recording to the other sources."""

    def altered(r: Recording, begin_s: float, length_s: float) -> Recording:
        turns = list(dict.fromkeys(item.measurement.source for item in r.received))
        spared = [item for item in r.received if item.measurement.source == source]
        others = [item for item in r.received if item.measurement.source != source]
        part = alter(replace(r, received=tuple(others)), begin_s, length_s)
        # Of what comes at the same time the order is as before.
        received = [*part.received, *spared]
        return part.with_received(sorted(received, key=lambda i: turns.index(i.measurement.source)))

    return altered


def _north_of(lat_rad: float, height_m: float | None, north_m: float) -> float:
    place, height, away = [lat_rad], [height_m or 0.0], [[north_m, 0.0, 0.0]]
    moved = metres_to_geodetic(np.array(place), np.array(height), np.array(away))
    return lat_rad + float(moved[0, 0])


def _north(fix: PositionFix, north_m: float) -> PositionFix:
    return replace(fix, lat_rad=_north_of(fix.lat_rad, fix.height_m, north_m))


def position_step(
    r: Recording, begin_s: float, length_s: float, north_m: float = STEP_M
) -> Recording:
    """Offset positions to the north."""
    return _changed(r, begin_s, length_s, PositionFix, lambda fix, _: _north(fix, north_m))


def null_island(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set positions to 0 N 0 E."""
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, _: replace(fix, lat_rad=0.0, lon_rad=0.0)
    )


def frozen_fix(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Repeat each receiver's first position and velocity of the window at new instants."""
    first: dict[str, PositionFix] = {}

    def repeat(fix: PositionFix, _: float) -> PositionFix:
        frozen = first.setdefault(fix.source, fix)
        return replace(frozen, t_seen_ns=fix.t_seen_ns, stamp=fix.stamp)

    return _changed(r, begin_s, length_s, PositionFix, repeat)


def velocity_reversed(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Reverse horizontal velocities; positions unchanged."""

    def turned(fix: PositionFix, _: float) -> PositionFix:
        assert fix.v_ned_m_s is not None
        north, east, down = fix.v_ned_m_s
        return replace(fix, v_ned_m_s=(-north, -east, down))

    return _changed(r, begin_s, length_s, PositionFix, turned)


def drift(r: Recording, begin_s: float, length_s: float, north_m_s: float = DRIFT_M_S) -> Recording:
    """Let positions drift to the north; velocities unchanged."""
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, since_s: _north(fix, north_m_s * since_s)
    )


def spoofed_drift(
    r: Recording, begin_s: float, length_s: float, north_m_s: float = DRIFT_M_S
) -> Recording:
    """Drift positions to the north with matching velocities, as a spoofed receiver's."""
    drifting = drift(r, begin_s, length_s, north_m_s)
    return velocity_bias(drifting, begin_s, length_s, north_m_s)


def velocity_bias(r: Recording, begin_s: float, length_s: float, north_m_s: float) -> Recording:
    """Offset velocities to the north; positions unchanged."""

    def faster(fix: PositionFix, _: float) -> PositionFix:
        assert fix.v_ned_m_s is not None
        north, east, down = fix.v_ned_m_s
        return replace(fix, v_ned_m_s=(north + north_m_s, east, down))

    return _changed(r, begin_s, length_s, PositionFix, faster)


def velocity_old(r: Recording, begin_s: float, length_s: float, age_s: float = 1.0) -> Recording:
    """Replace velocities by those of an epoch `age_s` before, or of the first; positions
    unchanged."""
    said: dict[str, deque[tuple[float, Velocity]]] = {}

    def older(fix: PositionFix, since_s: float) -> PositionFix:
        assert fix.v_ned_m_s is not None
        kept = said.setdefault(fix.source, deque())
        kept.append((since_s, fix.v_ned_m_s))
        while len(kept) > 1 and kept[1][0] <= since_s - age_s:
            kept.popleft()
        return replace(fix, v_ned_m_s=kept[0][1])

    return _changed(r, begin_s, length_s, PositionFix, older)


def velocity_ramp(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Add a velocity to the north that grows by 0.1 m/s^2; positions unchanged."""

    def grown(fix: PositionFix, since_s: float) -> PositionFix:
        assert fix.v_ned_m_s is not None
        north, east, down = fix.v_ned_m_s
        return replace(fix, v_ned_m_s=(north + VELOCITY_RAMP_M_S2 * since_s, east, down))

    return _changed(r, begin_s, length_s, PositionFix, grown)


def stamped_too_new(
    r: Recording, begin_s: float, length_s: float, delay_s: float = DELAY_S
) -> Recording:
    """Stamp fixes later than they are valid.

    A slow line delays fixes so, for a receiver without a known time."""
    moved = set(_fixes(r, begin_s, begin_s + length_s))
    ns = round(delay_s * 1e9)
    return r.with_received(
        [
            replace(item, t_ns=item.t_ns + ns, seen_ns=item.seen_ns + ns) if item in moved else item
            for item in r.received
        ]
    )


def false_burst(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Insert a thousand positions a second, 450 m off, each at its own instant."""
    like = _fixes(r, begin_s, math.inf)[0].measurement
    assert isinstance(like, PositionFix)
    false = []
    for t in range(round(begin_s * 1e9), round((begin_s + length_s) * 1e9), BURST_EVERY_NS):
        fix = replace(_north(like, BURST_M), t_seen_ns=t, stamp=MonotonicStamp(t))
        false.append(Received(t, t, fix))
    return r.with_received([*r.received, *false])


def tiny_sigma(r: Recording, begin_s: float, length_s: float, sd_m: float = TINY_SD_M) -> Recording:
    """State a sigma of 1e-9 m; errors unchanged."""
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, _: replace(fix, sd_ned_m=(sd_m,) * 3)
    )


def small_sigma(r: Recording, begin_s: float, length_s: float, factor: float) -> Recording:
    """Divide stated sigmas of position and velocity by a factor; errors unchanged."""

    def smaller(fix: PositionFix, _: float) -> PositionFix:
        assert fix.sd_ned_m is not None
        assert fix.sd_v_ned_m_s is not None
        n, e, d = fix.sd_ned_m
        vn, ve, vd = fix.sd_v_ned_m_s
        assert vd is not None
        return replace(
            fix,
            sd_ned_m=(n / factor, e / factor, d / factor),
            sd_v_ned_m_s=(vn / factor, ve / factor, vd / factor),
        )

    return _changed(r, begin_s, length_s, PositionFix, smaller)


def infinite_sigma(r: Recording, begin_s: float, length_s: float) -> Recording:
    """State an infinite sigma."""
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, _: replace(fix, sd_ned_m=(math.inf,) * 3)
    )


def nan_latitude(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the latitude to NaN."""
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, _: replace(fix, lat_rad=math.nan)
    )


def huge_height(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the height to 1e300 m."""
    return _changed(r, begin_s, length_s, PositionFix, lambda fix, _: replace(fix, height_m=HUGE))


def _at_speed(r: Recording, begin_s: float, length_s: float, north_m_s: float) -> Recording:
    return _changed(
        r,
        begin_s,
        length_s,
        PositionFix,
        lambda fix, _: replace(fix, v_ned_m_s=(north_m_s, 0.0, 0.0)),
    )


def huge_speed(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the velocity to 1e300 m/s to the north."""
    return _at_speed(r, begin_s, length_s, HUGE)


def impossible_speed(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the velocity to 2,000 knots to the north."""
    return _at_speed(r, begin_s, length_s, FAST_M_S)


def repeated(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Repeat every fix once."""
    return r.with_received([*r.received, *_fixes(r, begin_s, begin_s + length_s)])


def from_future(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Stamp fixes 5 s ahead."""
    moved = set(_fixes(r, begin_s, begin_s + length_s))
    return r.with_received(
        [replace(item, t_ns=item.t_ns + AHEAD_NS) if item in moved else item for item in r.received]
    )


def multipath_tunnel_jump(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Offset fixes by 80 m for 0.6 s, remove those in a tunnel, and offset the first fix after it
    by 80 m."""
    burst = _changed(r, begin_s, MULTIPATH_S, PositionFix, lambda fix, _: _north(fix, MULTIPATH_M))
    out_s = begin_s + length_s
    tunnel = burst.withheld(begin_s + MULTIPATH_S, out_s)
    behind = _fixes(tunnel, out_s, math.inf)
    if not behind:  # a recording that ends in it
        return tunnel
    first_s = behind[0].t_ns * 1e-9
    return _changed(
        tunnel, first_s - 1e-6, 2e-6, PositionFix, lambda fix, _: _north(fix, MULTIPATH_M)
    )


def no_fix_yet(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Remove all fixes of receiver and terminal in the window."""
    return r.withheld(begin_s, begin_s + length_s)


def rdss_step(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Offset RDSS fixes by 500 m to the north."""

    def moved(fix: DelayedFix, _: float) -> DelayedFix:
        return replace(fix, lat_rad=_north_of(fix.lat_rad, fix.height_m, STEP_M))

    return _changed(r, begin_s, length_s, DelayedFix, moved)


def rdss_nan(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set the latitude of RDSS fixes to NaN."""
    return _changed(r, begin_s, length_s, DelayedFix, lambda fix, _: replace(fix, lat_rad=math.nan))


def wheels_frozen(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Repeat the first speed of the window."""
    first: list[float] = []

    def repeat(m: WheelSpeed, _: float) -> WheelSpeed:
        first.append(m.speed_m_s)
        return replace(m, speed_m_s=first[0])

    return _changed(r, begin_s, length_s, WheelSpeed, repeat)


def _wheels_times(r: Recording, begin_s: float, length_s: float, factor: float) -> Recording:
    return _changed(
        r, begin_s, length_s, WheelSpeed, lambda m, _: replace(m, speed_m_s=factor * m.speed_m_s)
    )


def wheels_scaled(
    r: Recording, begin_s: float, length_s: float, factor: float = WHEEL_SCALE
) -> Recording:
    """Multiply wheel speeds by a factor, default 1.2."""
    return _wheels_times(r, begin_s, length_s, factor)


def wheels_locked(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Set wheel speeds to zero."""
    return _wheels_times(r, begin_s, length_s, 0.0)


def wheels_delayed(r: Recording, begin_s: float, length_s: float, delay_s: float) -> Recording:
    """Stamp wheel speeds later than they are valid."""
    ns = round(delay_s * 1e9)
    begin, end = begin_s * 1e9, (begin_s + length_s) * 1e9
    received = []
    for item in r.received:
        m = item.measurement
        if isinstance(m, WheelSpeed) and begin <= item.t_ns < end:
            t = item.t_ns + ns
            m = replace(m, stamp=MonotonicStamp(t), t_seen_ns=item.seen_ns + ns)
            received.append(Received(t, item.seen_ns + ns, m))
        else:
            received.append(item)
    return r.with_received(received)


def removed(r: Recording, begin_s: float, length_s: float, *kinds: type[Measurement]) -> Recording:
    """Remove the measurements of these kinds, or of all."""
    begin, end = begin_s * 1e9, (begin_s + length_s) * 1e9
    return r.with_received(
        [
            item
            for item in r.received
            if not begin <= item.t_ns < end or (kinds and not isinstance(item.measurement, kinds))
        ]
    )


def intermittent(
    r: Recording, begin_s: float, length_s: float, *kinds: type[Measurement]
) -> Recording:
    """Remove these kinds for three seconds of each five."""
    for start_s in np.arange(begin_s, begin_s + length_s, 5.0).tolist():
        r = removed(r, start_s, 3.0, *kinds)
    return r


def scattered_positions(r: Recording, begin_s: float, length_s: float, sd_m: float) -> Recording:
    """Scatter positions by `sd_m` to the north beyond their stated sigma."""
    rng = np.random.default_rng(0)
    return _changed(
        r, begin_s, length_s, PositionFix, lambda fix, _: _north(fix, sd_m * rng.standard_normal())
    )


def too_high(r: Recording, begin_s: float, length_s: float, up_m: float) -> Recording:
    """Offset heights upwards."""
    return _changed(
        r,
        begin_s,
        length_s,
        PositionFix,
        lambda fix, _: replace(fix, height_m=(fix.height_m or 0.0) + up_m),
    )


def wheels_reversed(r: Recording, begin_s: float, length_s: float) -> Recording:
    """Reverse the sign of wheel speeds."""
    return _wheels_times(r, begin_s, length_s, -1.0)
