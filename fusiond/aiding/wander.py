r"""How much the error of a receiver's fixes wanders within half a minute, as its velocities show.

Beside what fixes share for half an hour (orbits, ionosphere) and noise of their own, a receiver in
a street has errors that last for ten seconds or a minute (multipath, satellites that come and go):
of ten fixes a second a hundred are one, and a filter that takes them for noise is too sure of
position and velocity. A state b for it, of sigma one and `LASTS_S`, counts with w metres, and a
receiver does not say its w. But the way between two fixes is measured twice. With n the noise,
delta by how much later than a velocity's a fix's stamp lies before its instant:

    u(t) = p_fix - int v dt = e(t) + delta v(t) + constant + what the velocities' noise walks
    d    = u(t) - u(t - LAG_S) - delta (v(t) - v(t - LAG_S))

    E[d^2] = 2 var(n) + 2 w^2 (1 - exp(-LAG_S / LASTS_S)) + var(walk)

(Allan's structure function). From one fix to the next, h apart, it is the same with h: the noise,
whatever it is, falls out of the difference

    w^2 = (D(LAG_S) - D(h)) / (2 (exp(-h / LASTS_S) - exp(-LAG_S / LASTS_S)))
    D   = E[d^2] - var(walk)

averaged over both axes and the last minutes. Nothing of it depends on the filter, which follows its
fixes and so hides what they do. delta is a least squares slope, with what the offsets in time may
be for a prior; w begins as half of the variance that the fix states, with the weight of one lag,
and is no more than that sigma. How long the errors last is not asked: errors of other lengths get
the w that is right over a lag.

Source: Allan, Statistics of atomic frequency standards, Proc. IEEE 54 (1966); Gelb, Applied
Optimal Estimation (1974), section 4.5 (Markov processes of a shaping filter).
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from fusiond.navigation.earth import meridian_radius, transverse_radius

LASTS_S = 30.0
"""Correlation time of the state. Fixes were simulated with 10 to 20 s; it is what their lag shows
that counts."""
LAG_S, STEP_S = 20.0, 2.0
"""What is compared lies so far apart; and so often."""
ASSUMED = 0.5
"""What part of the stated variance it is before fixes have shown it: a choice, as of those by
phase."""
GAP_S = 2.5
"""Fixes farther apart than this leave too much of the way between them to two velocities."""
FORGETS_S = 600.0
"""Streets change."""


class _Point(NamedTuple):
    """At `t_s`: u and v north and east, and the variance that the velocities' noise has walked."""

    t_s: float
    u: tuple[float, float]
    v: tuple[float, float]
    walked: float


class Fix(NamedTuple):
    """Instant (ns), latitude and longitude (rad), horizontal velocity (m/s) and its sigma."""

    t_ns: int
    lat_rad: float
    lon_rad: float
    v: tuple[float, float]
    sd_v: float


class Wander:
    """Of one receiver; `offset_sd_s` is one sigma of delta."""

    __slots__ = (
        "_across",
        "_count",
        "_far",
        "_last",
        "_near",
        "_offset_sd_s",
        "_points",
        "_speeds",
        "_steps",
        "_u",
        "_walked",
    )

    def __init__(self, offset_sd_s: float) -> None:
        self._offset_sd_s = offset_sd_s
        self._last: Fix | None = None
        self._u, self._walked = (0.0, 0.0), 0.0
        self._points: deque[_Point] = deque()
        # Sums over both axes: of d^2 over a lag less what was walked, d dv and dv^2, and their
        # number; of d^2 from fix to fix less what was walked, exp(-h / LASTS_S), their number.
        self._far = self._across = self._speeds = self._count = 0.0
        self._near, self._steps = [0.0, 0.0], 0.0

    def take(self, fix: Fix) -> None:
        """The receiver's next fix, with its velocity."""
        last, self._last = self._last, fix
        step_s = math.inf if last is None else (fix.t_ns - last.t_ns) * 1e-9
        if last is None or not 0.0 < step_s <= GAP_S:
            self._u, self._walked = (0.0, 0.0), 0.0
            self._points.clear()
            self._points.append(_Point(fix.t_ns * 1e-9, self._u, fix.v, 0.0))
            return
        east = fix.lon_rad - last.lon_rad
        east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
        lat = fix.lat_rad
        moved = (
            (lat - last.lat_rad) * meridian_radius(lat) - 0.5 * (fix.v[0] + last.v[0]) * step_s,
            east * transverse_radius(lat) * math.cos(lat) - 0.5 * (fix.v[1] + last.v[1]) * step_s,
        )
        walked = 0.5 * (fix.sd_v**2 + last.sd_v**2) * step_s * step_s
        self._u = self._u[0] + moved[0], self._u[1] + moved[1]
        self._walked += walked
        kept = math.exp(-step_s / FORGETS_S)
        near, alike = self._near
        self._near = [
            kept * near + moved[0] ** 2 + moved[1] ** 2 - 2.0 * walked,
            kept * alike + 2.0 * math.exp(-step_s / LASTS_S),
        ]
        self._steps = kept * self._steps + 2.0
        if fix.t_ns * 1e-9 - self._points[-1].t_s >= STEP_S:
            self._compare(_Point(fix.t_ns * 1e-9, self._u, fix.v, self._walked))

    def _compare(self, now: _Point) -> None:
        points = self._points
        points.append(now)
        while now.t_s - points[1].t_s >= LAG_S:
            points.popleft()
        before = points[0]
        if now.t_s - before.t_s < LAG_S:
            return
        kept = math.exp(-STEP_S / FORGETS_S)
        self._far, self._count = kept * self._far, kept * self._count + 2.0
        self._across, self._speeds = kept * self._across, kept * self._speeds
        for axis in range(2):
            d = now.u[axis] - before.u[axis]
            faster = now.v[axis] - before.v[axis]
            self._far += d * d - (now.walked - before.walked)
            self._across += d * faster
            self._speeds += faster * faster

    def sd_m(self, stated_m: float) -> float:
        """w (m), no more than `stated_m`; 0 of a receiver that has shown no velocity."""
        if self._last is None:
            return 0.0
        assumed = ASSUMED * stated_m * stated_m
        if not self._count:
            return math.sqrt(assumed)
        # As many comparisons as a lag has share its errors, and are one.
        alike = 2.0 * LAG_S / STEP_S
        far = self._far
        if self._offset_sd_s and self._speeds:
            noise = max(far, 0.0) / self._count * alike / 2.0
            delta = self._across / (self._speeds + noise / self._offset_sd_s**2)
            far -= delta * (2.0 * self._across - delta * self._speeds)
        near, held = (each / self._steps for each in self._near)
        square = far / self._count - near
        square /= 2.0 * (held - math.exp(-LAG_S / LASTS_S))
        square += (assumed - square) * alike / (self._count + alike)
        return min(math.sqrt(max(square, 0.0)), stated_m)
