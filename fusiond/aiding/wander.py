r"""Size of the Gauss-Markov error of fixes within half a minute, as its velocities show.

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
"""Spacing of the fixes compared, and of comparisons."""
ASSUMED = 0.5
"""Share of the stated variance before fixes have shown it: a choice, as of those by phase."""
GAP_S = 2.5
"""Fixes farther apart than this leave too much of the way between them to two velocities."""
FORGETS_S = 600.0
"""Streets change."""

# Of the array that the kernels read: the last fix (ns, an integer; rad, rad; m/s; its sigma), u
# north and east and the variance that the velocities' noise has walked. Sums over both axes: of d^2
# over a lag less what was walked, d dv and dv^2, and their number; of d^2 from fix to fix less what
# was walked, exp(-h / LASTS_S), their number. How many points there are, and those: of each t (s),
# u and v north and east, what was walked.
(
    _AT, _LAT, _LON, _VN, _VE, _SD_V, _UN, _UE, _WALKED, _FAR, _ACROSS, _SPEEDS, _COUNT, _NEAR,
    _ALIKE, _STEPS, _KEPT, _POINTS,
) = range(18)  # fmt: skip
_POINT = 6
# Points within a lag, the one before them, the one that comes, and one for rounding.
_MOST = round(LAG_S / STEP_S) + 3
_SIZE = _POINTS + _POINT * _MOST


class Fix(NamedTuple):
    """Instant (ns), latitude and longitude (rad), horizontal velocity (m/s) and its sigma."""

    t_ns: int
    lat_rad: float
    lon_rad: float
    v: tuple[float, float]
    sd_v: float


@compiled("void(f8[::1], f8, f8, f8)")
def _keep(packed: Array, t_s: float, v_n: float, v_e: float) -> None:
    """One point more; those go that a whole lag lies before it, but for the last of them."""
    number = int(packed[_KEPT])
    points = packed[_POINTS:]
    gone = 0
    while gone + 1 < number and t_s - points[_POINT * (gone + 1)] >= LAG_S:
        gone += 1
    number -= gone
    for k in range(_POINT * number):
        points[k] = points[k + _POINT * gone]
    last = points[_POINT * number :]
    last[0], last[1], last[2], last[3], last[4] = t_s, packed[_UN], packed[_UE], v_n, v_e
    last[5] = packed[_WALKED]
    packed[_KEPT] = number + 1.0


@compiled("void(f8[::1])")
def _compare(packed: Array) -> None:
    """The last point with the first, where a lag lies between them."""
    before = packed[_POINTS : _POINTS + _POINT]
    at = _POINTS + _POINT * (int(packed[_KEPT]) - 1)
    now = packed[at : at + _POINT]
    if now[0] - before[0] < LAG_S:
        return
    kept = math.exp(-STEP_S / FORGETS_S)
    packed[_FAR] *= kept
    packed[_COUNT] = kept * packed[_COUNT] + 2.0
    packed[_ACROSS] *= kept
    packed[_SPEEDS] *= kept
    for axis in range(2):
        d = now[1 + axis] - before[1 + axis]
        faster = now[3 + axis] - before[3 + axis]
        packed[_FAR] += d * d - (now[5] - before[5])
        packed[_ACROSS] += d * faster
        packed[_SPEEDS] += faster * faster


@compiled("void(f8[::1], i8, f8, f8, f8, f8, f8)")
def _take(
    packed: Array, t_ns: int, lat: float, lon: float, v_n: float, v_e: float, sd_v: float
) -> None:
    """The next fix: its instant (ns), place (rad, rad), velocity (m/s) and that one's sigma."""
    at = packed[:1].view(np.int64)
    begins, step_s = packed[_KEPT] == 0.0, (t_ns - at[0]) * 1e-9
    if begins or not 0.0 < step_s <= GAP_S:
        packed[_UN] = packed[_UE] = packed[_WALKED] = packed[_KEPT] = 0.0
        _keep(packed, t_ns * 1e-9, v_n, v_e)
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
        kept = math.exp(-step_s / FORGETS_S)
        packed[_NEAR] = kept * packed[_NEAR] + north * north + east * east - 2.0 * walked
        packed[_ALIKE] = kept * packed[_ALIKE] + 2.0 * math.exp(-step_s / LASTS_S)
        packed[_STEPS] = kept * packed[_STEPS] + 2.0
        if t_ns * 1e-9 - packed[_POINTS + _POINT * (int(packed[_KEPT]) - 1)] >= STEP_S:
            _keep(packed, t_ns * 1e-9, v_n, v_e)
            _compare(packed)
    at[0], packed[_LAT], packed[_LON] = t_ns, lat, lon
    packed[_VN], packed[_VE], packed[_SD_V] = v_n, v_e, sd_v


@compiled("f8(f8[::1], f8, f8)")
def _sd_m(packed: Array, offset_sd_s: float, stated_m: float) -> float:
    """w (m), no more than `stated_m`; `offset_sd_s` is one sigma of delta."""
    if packed[_KEPT] == 0.0:
        return 0.0
    assumed, count = ASSUMED * stated_m * stated_m, packed[_COUNT]
    if count == 0.0:
        return math.sqrt(assumed)
    # As many comparisons as a lag has share its errors, and are one.
    alike = 2.0 * LAG_S / STEP_S
    far = packed[_FAR]
    if offset_sd_s > 0.0 and packed[_SPEEDS] > 0.0:
        noise = max(far, 0.0) / count * alike / 2.0
        delta = packed[_ACROSS] / (packed[_SPEEDS] + noise / (offset_sd_s * offset_sd_s))
        far -= delta * (2.0 * packed[_ACROSS] - delta * packed[_SPEEDS])
    near, held = packed[_NEAR] / packed[_STEPS], packed[_ALIKE] / packed[_STEPS]
    square = far / count - near
    square /= 2.0 * (held - math.exp(-LAG_S / LASTS_S))
    square += (assumed - square) * alike / (count + alike)
    return min(math.sqrt(max(square, 0.0)), stated_m)


class Wander:
    """Of one receiver; `offset_sd_s` is one sigma of delta."""

    __slots__ = ("_offset_sd_s", "_packed")

    def __init__(self, offset_sd_s: float) -> None:
        self._offset_sd_s = offset_sd_s
        self._packed = np.zeros(_SIZE)

    def take(self, fix: Fix) -> None:
        """The receiver's next fix, with its velocity."""
        _take(self._packed, fix.t_ns, fix.lat_rad, fix.lon_rad, *fix.v, fix.sd_v)

    def sd_m(self, stated_m: float) -> float:
        """w (m), no more than `stated_m`; 0 of a receiver that has shown no velocity."""
        return _sd_m(self._packed, self._offset_sd_s, stated_m)
