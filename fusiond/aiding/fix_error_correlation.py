r"""Division of a receiver's error into a white part, one of seconds, and a longer one.

A receiver states one sigma, s, of all errors of a fix. White errors average out; errors shared for
half a minute (multipath, changing satellites) or for half an hour (orbits, ionosphere) do not, and
no receiver states the division. But the path between two fixes is measured twice. With delta the
delay of a fix relative to a velocity:

    u(t) = p_fix - int v dt = e(t) + delta v(t) + constant + what the velocities' noise walks
    d    = u(t) - u(t - h) - delta (v(t) - v(t - h))
    D(h) = E[d^2 / s^2] - var(walk) / s^2                               (Allan's structure function)

From one fix to the next, and between means of k fixes that lie `LAG_S` apart, with W + w + L = 1
the shares of s^2 that are white, of `LASTS_S`, and of what lasts longer:

    D(h)     = 2 W     + 2 w (1 - exp(-h / LASTS_S))
    D(LAG_S) = 2 W / k + 2 w (1 - exp(-LAG_S / LASTS_S))
    L        = 1 - W - w

averaged over both axes and the last minutes. None of this depends on the filter, which follows its
fixes and so hides their errors. delta is a least-squares slope with the prior of the time offsets.
Correlation times are not estimated: errors of other lengths get the w that is right over a lag, and
L for the rest.

An estimate x of a share, of scatter sigma, is weighted by its likelihood; the prior is none (with
probability `NONE`), or uniform from 0 to 1. The posterior mean is used,

    E = (1 - NONE) int_0^1 y N(x; y, sigma) dy / (NONE N(x; 0, sigma) + (1 - NONE) int_0^1 N dy)

which is nearly 0 after a minute of white errors. This applies to the part that is not white, 1 - W,
and to the share of seconds in it, w / (1 - W); L is the rest.

Source: Allan, Statistics of atomic frequency standards, Proc. IEEE 54 (1966); Gelb, Applied
Optimal Estimation (1974), section 4.5 (Markov processes of a shaping filter); Mitchell, Beauchamp,
Bayesian variable selection in linear regression, J. Am. Stat. Assoc. 83 (1988), 1023 (a spike at
nothing beside a uniform slab).
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import meridian_radius, transverse_radius

Array = NDArray[np.float64]

LASTS_S = 30.0
"""Correlation time of the state. Fixes were simulated with 10 to 20 s; it is what their lag shows
that counts."""
LAG_S, STEP_S = 20.0, 2.0
"""Means of fixes that are compared lie so far apart; each is of so much time."""
NONE = 0.5
"""Prior probability that a receiver lacks a kind of error; no data exist."""
AT_FIRST, FIRST_STEPS = 0.75, 4.0
"""Initial share of the variance that is shared, and its weight in steps of one axis. A filter that
was too sure of its position stays so; one that was too cautious recovers with the next white fix.
"""
FOR_SECONDS = 0.5
"""Part of the shared error that lasts for seconds, with the weight of one lag: a choice."""
LEAST_WHITE = 0.01
"""Share of the variance that is white at least: a tenth of sigma. A receiver that smooths its fixes
repeats its error; how it follows a turn is in no share."""
GAP_S = 2.5
"""Longest interval of fixes: beyond it two velocities do not determine the displacement."""
SETTLES_NS = 10_000_000_000
"""Age beyond which no fix can still arrive, by the timeline's shortest buffer; the order of arrival
then has no effect."""
FORGETS_S = 600.0
"""Streets change."""
LEAST_SCATTER = 1e-3
"""Least scatter of a share's estimate."""
FAR_SIGMAS = 4.0
"""Distance of an estimate outside of 0 to 1, in sigmas, at which it is cut off."""

# Of the array that the kernels read: the last fix (ns, an integer; rad, rad; m/s; its sigma; its
# variance), u north and east and the variance that the velocities' noise has walked. Sums over both
# axes of what is over the stated variance: from mean to mean over a lag d^2 less what was walked,
# d dv and dv^2, what there is of white variance, and their number; from fix to fix the same, with
# what was walked, and exp(-h / LASTS_S). How many points there are. Sums of the mean that is being
# taken: t (s), u, v, what was walked, the stated variance, their number. Points: those means.
(
    _AT, _LAT, _LON, _VN, _VE, _SD_V, _VARIANCE, _UN, _UE, _WALKED,
    _FAR, _FAR_ACROSS, _FAR_SPEEDS, _WHITE, _COUNT,
    _NEAR, _NEAR_ACROSS, _NEAR_SPEEDS, _WALKS, _ALIKE, _STEPS, _KEPT, _SINCE, _MEAN,
) = range(24)  # fmt: skip
SHOWN = _KEPT - _FAR
"""Numbers that describe observed fixes: sums, with less weight for a share."""
MOST_SHOWN = 1e9
"""Largest error in the sums: a receiver that is off by a kilometre shows nothing of its noise."""
_POINT = 8
_POINTS = _MEAN + _POINT
_T, _U, _V, _OF_WALK, _OF_VARIANCE, _OF = 0, 1, 3, 5, 6, 7
# Points within a lag, the one before them, the one that comes, and some for rounding.
_MOST = round(LAG_S / STEP_S) + 5
_SIZE = _POINTS + _POINT * _MOST


_BEFORE_ALL_NS = -(1 << 62)


class Fix(NamedTuple):
    """Fix: instant (ns), latitude and longitude (rad), stated variance (m^2) of a horizontal axis,
    horizontal velocity (m/s) and its sigma."""

    t_ns: int
    lat_rad: float
    lon_rad: float
    variance: float
    v: tuple[float, float]
    sd_v: float


class Shares(NamedTuple):
    """Shares of the stated variance: white, lasting for `LASTS_S`, and longer; one together."""

    white: float
    wanders: float
    lasts: float


@compiled("void(f8[::1])")
def _keep(packed: Array) -> None:
    """The mean that has been taken is one point more; those go that a whole lag lies before it, but
    for the last of them."""
    number = int(packed[_KEPT])
    points, mean = packed[_POINTS:], packed[_MEAN:_POINTS]
    t_s = mean[_T] / mean[_OF]
    gone = 0
    while gone + 1 < number and (
        t_s - points[_POINT * (gone + 1)] >= LAG_S or number - gone >= _MOST
    ):
        gone += 1
    number -= gone
    for k in range(_POINT * number):
        points[k] = points[k + _POINT * gone]
    last = points[_POINT * number :]
    for k in range(_OF):
        last[k] = mean[k] / mean[_OF]
    last[_OF] = mean[_OF]
    mean[:] = 0.0
    packed[_KEPT] = number + 1.0


@compiled("void(f8[::1])")
def _compare(packed: Array) -> None:
    """Compare the last point with the first, if a lag lies between them."""
    before = packed[_POINTS : _POINTS + _POINT]
    at = _POINTS + _POINT * (int(packed[_KEPT]) - 1)
    now = packed[at : at + _POINT]
    if now[_T] - before[_T] < LAG_S:
        return
    kept = math.exp(-STEP_S / FORGETS_S)
    for k in range(_FAR, _COUNT + 1):
        packed[k] *= kept
    variance = math.sqrt(now[_OF_VARIANCE] * before[_OF_VARIANCE])
    white = now[_OF_VARIANCE] / now[_OF] + before[_OF_VARIANCE] / before[_OF]
    packed[_COUNT] += 2.0
    packed[_WHITE] += 2.0 * white / variance
    for axis in range(2):
        d = now[_U + axis] - before[_U + axis]
        faster = now[_V + axis] - before[_V + axis]
        packed[_FAR] += (d * d - (now[_OF_WALK] - before[_OF_WALK])) / variance
        packed[_FAR_ACROSS] += d * faster / variance
        packed[_FAR_SPEEDS] += faster * faster / variance


@compiled("void(f8[::1], i8, f8, f8, f8, f8, f8, f8)")
def _take(
    packed: Array,
    t_ns: int,
    lat: float,
    lon: float,
    variance: float,
    v_n: float,
    v_e: float,
    sd_v: float,
) -> None:
    """Add the next fix: instant (ns), position (rad, rad), stated variance (m^2), velocity (m/s)
    and its sigma."""
    at = packed[:1].view(np.int64)
    mean = packed[_MEAN:_POINTS]
    begins, step_s = packed[_VARIANCE] == 0.0, (t_ns - at[0]) * 1e-9
    if begins or not 0.0 < step_s <= GAP_S:
        packed[_UN] = packed[_UE] = packed[_WALKED] = packed[_KEPT] = 0.0
        mean[:] = 0.0
        packed[_SINCE] = t_ns * 1e-9
    else:
        east = lon - packed[_LON]
        east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
        north = (lat - packed[_LAT]) * meridian_radius(lat)
        north -= 0.5 * (v_n + packed[_VN]) * step_s
        east = east * transverse_radius(lat) * math.cos(lat) - 0.5 * (v_e + packed[_VE]) * step_s
        walked = 0.5 * (sd_v * sd_v + packed[_SD_V] * packed[_SD_V]) * step_s * step_s
        packed[_UN] += north
        packed[_UE] += east
        packed[_WALKED] += walked
        kept, stated = math.exp(-step_s / FORGETS_S), math.sqrt(variance * packed[_VARIANCE])
        for k in range(_NEAR, _STEPS + 1):
            packed[k] *= kept
        faster_n, faster_e = v_n - packed[_VN], v_e - packed[_VE]
        packed[_NEAR] += (north * north + east * east - 2.0 * walked) / stated
        packed[_NEAR_ACROSS] += (north * faster_n + east * faster_e) / stated
        packed[_NEAR_SPEEDS] += (faster_n * faster_n + faster_e * faster_e) / stated
        packed[_WALKS] += 2.0 * walked / stated
        packed[_ALIKE] += 2.0 * math.exp(-step_s / LASTS_S)
        packed[_STEPS] += 2.0
        if t_ns * 1e-9 - packed[_SINCE] >= STEP_S - 1e-6:
            _keep(packed)
            _compare(packed)
            packed[_SINCE] = t_ns * 1e-9
    at[0], packed[_LAT], packed[_LON], packed[_VARIANCE] = t_ns, lat, lon, variance
    packed[_VN], packed[_VE], packed[_SD_V] = v_n, v_e, sd_v
    mean[_T] += t_ns * 1e-9
    mean[_U] += packed[_UN]
    mean[_U + 1] += packed[_UE]
    mean[_V] += v_n
    mean[_V + 1] += v_e
    mean[_OF_WALK] += packed[_WALKED]
    mean[_OF_VARIANCE] += variance
    mean[_OF] += 1.0


@compiled("f8(f8, f8)")
def share_of(x: float, sigma: float) -> float:
    """Expectation of a share with estimate `x` and scatter `sigma`."""
    x = min(max(x, -FAR_SIGMAS * sigma), 1.0 + FAR_SIGMAS * sigma)
    a, b, root = -x / sigma, (1.0 - x) / sigma, math.sqrt(0.5)
    at_a = math.exp(-0.5 * a * a) / math.sqrt(2.0 * math.pi)
    at_b = math.exp(-0.5 * b * b) / math.sqrt(2.0 * math.pi)
    if a > 0.0:  # of two numbers near nothing: they differ where those near one do not
        within = 0.5 * (math.erfc(a * root) - math.erfc(b * root))
    else:
        within = 0.5 * (math.erf(b * root) - math.erf(a * root))
    some = (1.0 - NONE) * within
    mean = (1.0 - NONE) * (x * within + sigma * (at_a - at_b))
    return min(max(mean / (NONE * at_a / sigma + some), 0.0), 1.0)


@compiled("f8(f8, f8, f8, f8)")
def _by_speed(total: float, across: float, speeds: float, offset_variance: float) -> float:
    """Part of a sum of d^2 that is due to the offset between fix and velocity. `across` is the sum
    of d dv, `speeds` that of dv^2; `offset_variance` is the variance of delta over that of one d.
    """
    if not (offset_variance > 0.0 and speeds > 0.0 and total > 0.0):
        return 0.0
    delta = across / (speeds + 1.0 / offset_variance)
    return delta * (2.0 * across - delta * speeds)


@compiled("void(f8[::1], f8, b1, f8[::1])")
def _shares(packed: Array, offset_sd_s: float, wanders: bool, out: Array) -> None:
    """Write the shares (3,); `offset_sd_s` is one sigma of delta, and without `wanders` nothing
    lasts for `LASTS_S`."""
    steps, count = packed[_STEPS], packed[_COUNT]
    near, held, walks = 1.0, 1.0, 0.0
    if steps > 0.0:
        near, walks, held = packed[_NEAR], packed[_WALKS] / steps, packed[_ALIKE] / steps
        of_one = max(near, 0.0) / steps + walks
        offset = offset_sd_s * offset_sd_s / max(of_one, 1e-12)
        near -= _by_speed(near, packed[_NEAR_ACROSS], packed[_NEAR_SPEEDS], offset)
        near = max(near, 0.0) / steps
    estimate = scatter = 0.0
    if wanders and count > 0.0:
        far, white = packed[_FAR], packed[_WHITE] / count
        # As many comparisons as a lag has share what lasts, and are one.
        alike = 2.0 * LAG_S / STEP_S
        of_one = max(far, 0.0) / count * alike / 2.0
        offset = offset_sd_s * offset_sd_s / max(of_one, 1e-12)
        far -= _by_speed(far, packed[_FAR_ACROSS], packed[_FAR_SPEEDS], offset)
        over = 2.0 * (1.0 - math.exp(-LAG_S / LASTS_S)) - white * (1.0 - held)
        estimate = max(far / count - 0.5 * white * near, 0.0)
        of_white = 0.5 * white * near
        scatter = 3.0 * of_white * of_white / count + estimate * estimate * alike / count
        estimate, scatter = estimate / over, math.sqrt(scatter) / over + LEAST_SCATTER
    own = max(0.5 * near - estimate * (1.0 - held), 0.0)
    # Few that were alike by chance have shown nothing: one more, as large as is stated, scatters.
    supposed = (own * steps + 2.0) / (steps + 2.0)
    of_own = (0.5 * walks) ** 2 + 3.0 * supposed * supposed / max(steps, 0.1)
    shared = share_of(1.0 - own, math.sqrt(of_own) + LEAST_SCATTER)
    shared = (shared * steps + AT_FIRST * FIRST_STEPS) / (steps + FIRST_STEPS)
    shared = min(shared, 1.0 - LEAST_WHITE)
    w = 0.0
    if wanders:
        w = FOR_SECONDS
        if count > 0.0:
            alike = 2.0 * LAG_S / STEP_S
            w = share_of(estimate / max(shared, 1e-3), scatter / max(shared, 1e-3))
            w = (w * count + FOR_SECONDS * alike) / (count + alike)
    out[0], out[1], out[2] = 1.0 - shared, w * shared, (1.0 - w) * shared


class FixErrors:
    """Errors of one receiver's fixes; `offset_sd_s` is one sigma of delta, and without `wanders` no
    error lasts for `LASTS_S`. Fixes may arrive in any order: a fix uses those valid `SETTLES_NS`
    before it."""

    __slots__ = ("_found", "_known", "_offset_sd_s", "_packed", "_wanders", "waiting")

    def __init__(self, offset_sd_s: float, wanders: bool = True) -> None:
        self._offset_sd_s, self._wanders = offset_sd_s, wanders
        self._packed, self._found = np.zeros(_SIZE), np.empty(3)
        self.waiting: list[Fix] = []
        """Fixes of the receiver with a velocity, to be added by the next `shares`."""
        self._known: deque[tuple[int, Shares]] = deque([(_BEFORE_ALL_NS, self._now())])

    def shares(self, t_ns: int) -> Shares:
        """Shares for a fix of `t_ns`."""
        settled, known = t_ns - SETTLES_NS, self._known
        self.waiting.sort()
        due = 0
        for fix in self.waiting:
            if fix.t_ns > settled:
                break
            due += 1
            if (
                fix.t_ns > known[-1][0]
            ):  # one that comes later than any may, or twice, tells nothing
                place = fix.lat_rad, fix.lon_rad, fix.variance
                _take(self._packed, fix.t_ns, *place, *fix.v, fix.sd_v)
                known.append((fix.t_ns, self._now()))
        del self.waiting[:due]
        while len(known) > 1 and known[1][0] <= known[-1][0] - 2 * SETTLES_NS:
            known.popleft()
        return next((shares for at, shares in reversed(known) if at <= settled), known[0][1])

    @property
    def shown(self) -> tuple[float, ...]:
        """Sums (`SHOWN`,) of all that has settled, for the next start."""
        return tuple(np.clip(self._packed[_FAR:_KEPT], -MOST_SHOWN, MOST_SHOWN).tolist())

    def take_up(self, shown: tuple[float, ...]) -> None:
        """Resume with another drive's result."""
        self._packed[_FAR:_KEPT] = shown
        self._known = deque([(_BEFORE_ALL_NS, self._now())])

    def _now(self) -> Shares:
        _shares(self._packed, self._offset_sd_s, self._wanders, self._found)
        return Shares(*self._found.tolist())
