r"""Reference epoch of carrier phases, with a clone of the antenna's position.

A carrier L, corrected for the satellite's clock and the atmosphere, is a range plus a constant
while it is tracked. Against an anchor epoch a, with s the satellite (ECEF, m), p the antenna, c the
receiver's clock and n the noise of a phase (m),

    L(t) - L(a) = |s(t) - p(t)| - |s(a) - p(a)| + c(t) - c(a) + n(t) - n(a)

The noise of each epoch enters once, and n(a) is common to all: the path since the anchor is known
to the phases' own noise over any number of epochs. As rates from epoch to epoch, of noise 2 s^2 /
dt^2 each, it would be a random walk, as n(t) enters with both signs (a moving average with its root
on the unit circle).

p(a) is a state of its own (block `carrier_anchor`, ECEF, m), C = c(t) - c(a) another one (block
`carrier_clock`, whose rate is the clock's drift). At the anchor C = 0, and the error of the clone
is that of the position there, to which it stays correlated,

    B = p(a) - p^(a) = -E (dr + a x phi),      C = 0                       (stochastic cloning)

E the north, east and down axes in ECEF, a the lever arm in them, dr and phi computed minus true, B
true minus estimated. With u the unit vector to the satellite,

    z = (|s - p^| - |s_a - p^_a|) + C^ - (L - L_a) = -u . dr + (a x u) . phi - u . B - C + noise

which depends on the path alone. With the u of the anchor for B, which changes by a milliradian in
10 s, millimetres would show the position, as a float ambiguity does; but each satellite's constant
is uncertain by as much (on a walk sigma fell from 0.54 to 0.31 m, and the position moved by 0.5 m).

n(a) is common to all later epochs: the part of the n_i(a) that acts as a displacement and a clock
is added to B and C once, at the cloning,

    (B, C) += G n(a),   G = (H^T W H + I)^-1 H^T W,   H = [-u_a, -1],   W = diag(1 / s_i^2)

(I, (1 m)^-2, bounds directions that too few satellites measure.) B and C also walk by the
corresponding part of the satellites' drift, G cov(d) G^T a second, and the position walks with B
(fusiond.aiding.carrier_anchor_noise): orbits and clocks drift for minutes, three or four satellites
amplify that in the position, and the inertial unit bridges noise that is added at the anchor alone.
The rest of n(a) is a constant b_i of each satellite, of variance s_i^2 (1 - h_i), h_i its leverage.
It shows in the residuals v of z, and is subtracted,

    z <- z - b,   V <- V + (q thin)^2 dt,   K = V / (f V + s^2),   b <- b + K v,   V <- (1 - K f) V

with f = 1 - h; the part of b that least squares would see is removed: as gains differ, it would
displace the position for ever, unseen. So the noise of a row is that of its own epoch and V. q is
the walk of atmosphere, orbit and clock beside their models, thin 1 at the zenith. Residuals d of
the change of z since the epoch before show the noise of this receiver's phases,

    scale = (20 + sum d^2 / 2 s^2) / (20 + sum (n - 4)),       s^2 <- scale s^2

A satellite is anchored while it is tracked at each epoch with the same ephemeris and its row fits.
Others wait for a new anchor: when the last is `LONGEST_S` old, `WAITS_S` if a satellite waits, or
at once if fewer than `ENOUGH` are left. The epoch's rows use the old anchor, the clone is made
after them: so carriers cover the whole path, and each anchor adds a phase's noise.

The receiver's clock gives the true spacing of epochs. If the assumed instants t' differ, e = t' -
t, the filter's path is longer by v e - v(a) e(a). The change of e is known, mainly when a report
has come with less delay than any before: e(a) was too late, and e is not,

    z <- z + u . v(a) (e - e(a))

The filter's own values, p^(a) and C^, are among its parameters, so that a rewind or another filter
has its own; the output of an epoch for the next one, (SLOTS, 9), holds the receiver's facts.

Source: Roumeliotis and Burdick, Stochastic cloning, ICRA 2002; van Graas and Soloviev, Navigation
51 (2004), 277-292; Groves, 2nd edition, 9.2.7.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0

Array = NDArray[np.float64]

# Rows of an epoch's values (n columns, one a satellite).
BASIC, VALUES = 10, 19
X, VX, RANGE, RATE, RANGE_VARIANCE, RATE_VARIANCE, SHARED = 0, 3, 6, 7, 8, 9, 10
SPAN, CARRIER, CARRIER_VARIANCE, WALK, SLOT, ISSUE = 13, 14, 15, 16, 17, 18

SLOTS, COLUMNS = 3 * 64, 9
"""Shape of an epoch's output: one row for each satellite, by its slot."""
_ALIVE, _CARRIER, _X, _ISSUE, _OFFSET, _V, _LAST = 0, 1, 2, 5, 6, 7, 8
# Slot 0 is no satellite's: 1 if there is an anchor; when it was (s); sums of d^2 / 2 s^2 and of
# their degrees of freedom; until when it has walked (s); how far its instant was ahead of the
# receiver's clock (s), and the velocity there (north, east, down).
_THERE, _T, _SUM, _COUNT, _WALKED, AHEAD, V_NED = range(7)

LONGEST_S = 30.0
"""Longest age (s): a line of sight turns by 4 mrad within it, 2 mm for a position error of 0.5 m.
"""
WAITS_S = 1.0
ENOUGH = 4
"""Fewest carriers that determine position and clock."""
ON_EARTH_M = 1e6
"""Least distance (m) of a position from the earth's centre; without a clone the state is 0."""
PRIOR_COUNT, MOST_COUNT = 20.0, 1000.0
"""Weight of the modelled phase noise in independent phases, and the number after which old ones are
forgotten by halves: a minute of a sky at 1 Hz."""
SCALE = (0.1, 10.0)
"""Scale of the phase variance, from a tenth: 1 mm at the zenith."""
CLIPPED = 9.0
"""No change counts as more than three sigma: a slip is no noise."""


@compiled("f8(f8[:, ::1])", forceinline=True)
def phase_scale(before: Array) -> float:
    """Factor on the model's variances of phases."""
    found: float = (PRIOR_COUNT + before[0, _SUM]) / (PRIOR_COUNT + before[0, _COUNT])
    return min(max(found, SCALE[0]), SCALE[1])


@compiled("b1(f8[:, ::1], i8, f8[:, ::1])", forceinline=True)
def anchored(values: Array, k: int, before: Array) -> bool:
    """True if the carrier of satellite `k` has been followed since the anchor."""
    if before[0, _THERE] == 0.0 or not values[SPAN, k] > 0.0:
        return False
    if not math.isfinite(values[CARRIER, k]):
        return False
    row = before[int(values[SLOT, k])]
    there: bool = row[_ALIVE] > 0.0 and row[_ISSUE] == values[ISSUE, k]
    return there


@compiled("UniTuple(f8, 3)(f8[:, ::1], i8, f8[:, ::1], f8, f8, f8, f8)", forceinline=True)
def since_anchor(
    values: Array, k: int, before: Array, px: float, py: float, pz: float, scale: float
) -> tuple[float, float, float]:
    """Distance of a satellite from a position (ECEF, m) at the anchor, growth of its carrier since
    (m), and its variance (m^2)."""
    row = before[int(values[SLOT, k])]
    x, y, z = row[_X] - px, row[_X + 1] - py, row[_X + 2] - pz
    distance = math.sqrt(x * x + y * y + z * z)
    grown = values[CARRIER, k] - row[_CARRIER] + row[_OFFSET]
    walked = values[WALK, k] * values[WALK, k] * values[SPAN, k]
    variance = scale * values[CARRIER_VARIANCE, k] + row[_V] + walked
    return distance, grown, variance


@compiled("void(f8[:, ::1], f8[:, ::1], f8)")
def invert(a: Array, out: Array, more: float) -> None:
    """Write the inverse of A + `more` I (4, 4), which is positive definite, by Gauss-Jordan
    elimination."""
    for i in range(4):
        for j in range(4):
            out[i, j] = a[i, j]
        out[i, i] += more
    for p in range(4):
        pivot = 1.0 / out[p, p]
        out[p, p] = 1.0
        for j in range(4):
            out[p, j] *= pivot
        for i in range(4):
            if i != p:
                f = out[i, p]
                out[i, p] = 0.0
                for j in range(4):
                    out[i, j] -= f * out[p, j]


@compiled("void(f8[::1], f8, f8, f8, f8[::1], f8[:, ::1])", allocates=True)
def antenna(nav: Array, l0: float, l1: float, l2: float, place: Array, of_error: Array) -> None:
    """Write an antenna's position (3,), ECEF, and its derivatives by the navigation errors.

    That (3, 9) is true minus computed; l the lever arm (m, body axes).
    """
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = dcm_elements(nav[Q0:])
    a0 = c00 * l0 + c01 * l1 + c02 * l2
    a1 = c10 * l0 + c11 * l1 + c12 * l2
    a2 = c20 * l0 + c21 * l1 + c22 * l2
    sl, cl = math.sin(nav[LAT]), math.cos(nav[LAT])
    so, co = math.sin(nav[LON]), math.cos(nav[LON])
    normal = SEMI_MAJOR_M / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sl * sl)
    level = (normal + nav[HEIGHT]) * cl
    place[0], place[1] = level * co, level * so
    place[2] = (normal * (1.0 - ECCENTRICITY_SQUARED) + nav[HEIGHT]) * sl
    axes = np.empty((3, 3))
    axes[0, 0], axes[0, 1], axes[0, 2] = -sl * co, -so, -cl * co
    axes[1, 0], axes[1, 1], axes[1, 2] = -sl * so, co, -cl * so
    axes[2, 0], axes[2, 1], axes[2, 2] = cl, 0.0, -sl
    for i in range(3):
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        place[i] += x * a0 + y * a1 + z * a2
        # -E [a x], by its columns, and -E
        of_error[i, 0] = a1 * z - a2 * y
        of_error[i, 1] = a2 * x - a0 * z
        of_error[i, 2] = a0 * y - a1 * x
        of_error[i, 3] = of_error[i, 4] = of_error[i, 5] = 0.0
        of_error[i, 6], of_error[i, 7], of_error[i, 8] = -x, -y, -z


@compiled("f8(f8[:, ::1], i8, f8[::1], f8[::1])", forceinline=True)
def sight(values: Array, k: int, place: Array, row: Array) -> float:
    """Write H of a satellite from a place (4,); its distance."""
    x, y, z = values[X, k] - place[0], values[X + 1, k] - place[1], values[X + 2, k] - place[2]
    distance = math.sqrt(x * x + y * y + z * z)
    row[0], row[1], row[2], row[3] = -x / distance, -y / distance, -z / distance, -1.0
    return distance


@compiled(
    "i8(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def _fit(
    values: Array,
    place: Array,
    anchor: Array,
    left: Array,
    sights: Array,
    z: Array,
    inverse: Array,
) -> int:
    """Write H (n, 4), residuals z (2, n) of carriers and of their changes, and the inverse of H^T W
    H + I; the number of satellites. `left` is the reference of the next epoch's changes."""
    information, of_z, solved = np.zeros((4, 4)), np.zeros((2, 4)), np.empty(4)
    count = 0
    for k in range(values.shape[1]):
        state = left[int(values[SLOT, k])]
        if state[_ALIVE] == 0.0:
            continue
        count += 1
        distance = sight(values, k, place, sights[k])
        x, y, w = state[_X] - anchor[0], state[_X + 1] - anchor[1], state[_X + 2] - anchor[2]
        there = math.sqrt(x * x + y * y + w * w)
        whole = distance - there - (values[CARRIER, k] - state[_CARRIER])
        z[0, k], z[1, k] = whole - state[_OFFSET], whole - state[_LAST]
        state[_LAST] = whole
        state[_V] += values[WALK, k] * values[WALK, k] * values[SPAN, k]
        for i in range(4):
            weighted = sights[k, i] / values[CARRIER_VARIANCE, k]
            of_z[0, i] += weighted * z[0, k]
            of_z[1, i] += weighted * z[1, k]
            for j in range(4):
                information[i, j] += weighted * sights[k, j]
    invert(information, inverse, 1.0)
    for kind in range(2):
        for i in range(4):
            solved[i] = 0.0
            for j in range(4):
                solved[i] += inverse[i, j] * of_z[kind, j]
        for k in range(values.shape[1]):
            if left[int(values[SLOT, k]), _ALIVE] > 0.0:
                for i in range(4):
                    z[kind, k] -= sights[k, i] * solved[i]
    return count


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])", allocates=True)
def _learn(values: Array, place: Array, anchor: Array, left: Array) -> None:
    """Update the anchored rows of `left` by an epoch's carrier residuals: constants and phase
    noise, from the antenna's `place` at present and at the anchor."""
    n = values.shape[1]
    sights, z, inverse = np.empty((n, 4)), np.empty((2, n)), np.empty((4, 4))
    of_b = np.zeros(4)
    scale, squares = phase_scale(left), 0.0
    count = _fit(values, place, anchor, left, sights, z, inverse)
    if count <= ENOUGH:
        return
    for k in range(n):
        state = left[int(values[SLOT, k])]
        if state[_ALIVE] == 0.0:
            continue
        s, leverage = values[CARRIER_VARIANCE, k], 0.0
        for i in range(4):
            for j in range(4):
                leverage += sights[k, i] * inverse[i, j] * sights[k, j]
        f = max(1.0 - leverage / s, 0.0)
        squares += min(z[1, k] * z[1, k] / (2.0 * s), CLIPPED * scale)
        gain = state[_V] / (f * state[_V] + scale * s)
        state[_OFFSET] += gain * z[0, k]
        state[_V] *= 1.0 - gain * f
        for i in range(4):
            of_b[i] += sights[k, i] / s * state[_OFFSET]
    for k in range(n):
        state = left[int(values[SLOT, k])]
        if state[_ALIVE] > 0.0:
            for i in range(4):
                for j in range(4):
                    state[_OFFSET] -= sights[k, i] * inverse[i, j] * of_b[j]
    left[0, _SUM] += squares
    left[0, _COUNT] += count - 4.0
    if left[0, _COUNT] > MOST_COUNT:
        left[0, _SUM] *= 0.5
        left[0, _COUNT] *= 0.5


@compiled(
    "b1(f8[:, ::1], u1[::1], i8, f8, f8, b1, f8[::1], f8[::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def go_on(
    values: Array,
    codes: NDArray[np.uint8],
    first: int,
    t_s: float,
    ahead_s: float,
    cloned: bool,
    place: Array,
    anchor: Array,
    before: Array,
    left: Array,
) -> bool:
    """Write the output of an epoch at `t_s` after one with output `before`; True if it is an
    anchor, for a filter that has `cloned` the last one or not. `ahead_s` of the receiver's clock.

    `codes` (m,) of its rows, 0 if used, or none; `first`: that of rates and carriers; `place` (3,)
    of the antenna, and its estimate at the `anchor`.
    """
    left[:] = 0.0
    left[0] = before[0]
    known = cloned and before[0, _THERE] > 0.0
    alive = waiting = 0
    row = first
    for k in range(values.shape[1]):
        slot = int(values[SLOT, k])
        fits = row >= codes.shape[0] or codes[row] == 0
        if math.isfinite(values[RATE, k]) or values[SPAN, k] > 0.0:
            row += 1
        if known and fits and anchored(values, k, before):
            for i in range(left.shape[1]):
                left[slot, i] = before[slot, i]
            alive += 1
        elif math.isfinite(values[CARRIER, k]):
            waiting += 1
    if alive + waiting == 0:
        left[0, _THERE] = 0.0
        return False
    if alive > 0:
        _learn(values, place, anchor, left)
    age = t_s - before[0, _T]
    holds = waiting == 0 or (age < WAITS_S and alive >= ENOUGH)
    if known and holds and 0.0 <= age < LONGEST_S:
        return False
    left[0, _THERE], left[0, _T], left[0, _WALKED], left[0, AHEAD] = 1.0, t_s, t_s, ahead_s
    for k in range(values.shape[1]):
        if math.isfinite(values[CARRIER, k]):
            state = left[int(values[SLOT, k])]
            state[:] = 0.0
            state[_ALIVE] = 1.0
            state[_CARRIER], state[_ISSUE] = values[CARRIER, k], values[ISSUE, k]
            for i in range(3):
                state[_X + i] = values[X + i, k]
    return True
