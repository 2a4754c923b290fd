"""Compiled kernels: what the hypotheses of a bank say of an aid's rows, and what these say of them.

As fusiond.estimators.fault_bank says, with the path by dead reckoning that a delay needs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    ANY,
    CARRIED,
    DELAY,
    DEVICE,
    E1,
    E2,
    E_AT,
    ENTRIES,
    GROUPS,
    HEAD,
    J_AT,
    L10,
    L11,
    L20,
    L21,
    L22,
    L_AT,
    LAG,
    LANES,
    LENGTH,
    LOCATES,
    MOVES,
    MOVES_TOO,
    N_AT,
    OF_ONE,
    OF_THREE,
    ONSET,
    OTHER,
    PATH,
    PATH_S,
    PLACES,
    POINT,
    POSITION,
    POSITION_RAMP,
    RESTARTS,
    RING,
    RING_S,
    ROLLS,
    ROWS,
    SENSITIVITIES,
    SHIFTED,
    SIGNATURE,
    SIZE,
    SPEED,
    THREES,
    VELOCITY,
    VELOCITY_RAMP,
    column_of,
    group_at,
)
from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled("void(f8[::1], f8[::1], f8, f8)")
def walk_path(bank: Array, nav: Array, now_s: float, step_s: float) -> None:
    """Carry the path on by `step_s` at the velocity of `nav` (10,), and keep where it is."""
    for i in range(3):
        bank[PATH + i] += step_s * nav[VN + i]
    bank[PATH_S] = now_s
    entries = int(bank[ENTRIES])
    if entries > 0:
        last = HEAD + (entries - 1) % RING * POINT
        if now_s - bank[last] < RING_S - 1e-6:
            return
    at = HEAD + entries % RING * POINT
    bank[at] = now_s
    for i in range(3):
        bank[at + 1 + i], bank[at + 4 + i] = bank[PATH + i], nav[VN + i]
    bank[ENTRIES] = entries + 1.0


@compiled("i8(f8[::1], f8)")
def _past(bank: Array, t_s: float) -> int:
    """How many points ago the path was last before `t_s`, or at it; -1 where it is not kept."""
    entries = int(bank[ENTRIES])
    first, end = 1, min(entries, RING)  # of two points the first is looked for
    while first < end:
        middle = (first + end) // 2
        if bank[HEAD + (entries - 1 - middle) % RING * POINT] <= t_s:
            end = middle
        else:
            first = middle + 1
    return first if first < min(entries, RING) else -1


@compiled("f8(f8[::1], i8, f8, i8)")
def _at_past(bank: Array, back: int, t_s: float, component: int) -> float:
    """Component (place 0 to 2, velocity 3 to 5) of the path at `t_s`, linear from the point so many
    ago to the next."""
    entries = int(bank[ENTRIES])
    at = HEAD + (entries - back) % RING * POINT
    before = HEAD + (entries - 1 - back) % RING * POINT
    share = (t_s - bank[before]) / (bank[at] - bank[before])
    a, b = bank[before + 1 + component], bank[at + 1 + component]
    found: float = a + share * (b - a)
    return found


@compiled("b1(i8[:, ::1], i8, i8, i8)", forceinline=True)
def _concerns(ints: Indices, kind: int, measures: int, device: int) -> bool:
    """Whether a kind is one of rows, of a device, or of any and this one locates or moves."""
    if ints[kind, SIGNATURE] <= SHIFTED:
        return False
    if measures == PLACES and not ints[kind, LOCATES]:
        return False
    if measures == MOVES and not ints[kind, MOVES_TOO]:
        return False
    if ints[kind, DEVICE] == ANY:
        return bool(measures <= MOVES)
    of_this: bool = ints[kind, DEVICE] == device
    return of_this


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8, f8, f8, f8[::1])")
def _offset_rows(
    bank: Array,
    ints: Indices,
    width: int,
    kind: int,
    component: int,
    offset: float,
    slope: float,
    t_s: float,
    s: Array,
) -> None:
    """Add to s (columns,) what a kind's component makes of a row: an offset, and what has grown
    with a slope since the onset of each restart until `t_s`."""
    for restart in range(RESTARTS):
        number = RESTARTS * kind + restart
        d = offset
        if slope != 0.0:
            d += slope * (t_s - bank[group_at(bank, number) + ONSET])
        s[column_of(bank, width, number, component)] += d


@compiled(
    "void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, f8, f8[::1], i8, i8, f8[::1])",
)
def _sign(
    bank: Array,
    ints: Indices,
    numbers: Array,
    width: int,
    kind: int,
    measures: int,
    t_s: float,
    nav: Array,
    m: int,
    columns: int,
    work: Array,
) -> None:
    """Add D of the m rows of an aid that a kind concerns."""
    of = ints[kind, SIGNATURE]
    if of == DELAY and measures <= MOVES:
        then = t_s - numbers[kind, LAG]
        back = _past(bank, then)
        if back < 0:
            return
        for a in range(m):
            s = work[a * columns : (a + 1) * columns]
            if measures == PLACES:
                d = bank[PATH + a] + (t_s - bank[PATH_S]) * nav[VN + a]
                d -= _at_past(bank, back, then, a)
            else:
                d = nav[VN + a] - _at_past(bank, back, then, 3 + a)
            if math.isfinite(d):
                _offset_rows(bank, ints, width, kind, 0, d, 0.0, t_s, s)
    elif of == SPEED and measures == ROLLS:
        d = -math.hypot(nav[VN], nav[VN + 1])
        for a in range(m):
            s = work[a * columns : (a + 1) * columns]
            _offset_rows(bank, ints, width, kind, 0, d, 0.0, t_s, s)
    else:
        offset = slope = 0.0
        if measures == PLACES:
            if of == POSITION:
                offset = -1.0
            elif of in (POSITION_RAMP, CARRIED):
                slope = -1.0
        elif measures == MOVES:
            if of in (VELOCITY, CARRIED):
                offset = -1.0
            elif of == VELOCITY_RAMP:
                slope = -1.0
        elif measures == OTHER and of == ROWS:
            offset = -1.0
        if offset != 0.0 or slope != 0.0:
            for a in range(min(m, ints[kind, SIZE])):
                s = work[a * columns : (a + 1) * columns]
                _offset_rows(bank, ints, width, kind, a, offset, slope, t_s, s)


@compiled(
    "i8(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, i8, i8, f8[::1], f8[:, ::1], f8[::1],"
    "f8[:, ::1], f8[::1])"
)
def sensitivity_rows(
    bank: Array,
    ints: Indices,
    numbers: Array,
    n: int,
    width: int,
    t_ns: int,
    measures: int,
    device: int,
    nav: Array,
    h: Array,
    r: Array,
    g: Array,
    work: Array,
) -> int:
    """Write L^-1 (H V + D) of an aid's rows at `t_ns` to `work`, a row of columns each; how many
    columns. H (m, n), variances r (m,), g (m, w) = L^-1 H P as `whiten` leaves it; nav (10,)."""
    m, kinds = h.shape[0], ints.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    blocks = v.shape[0] // (n * width)
    columns: int = blocks * width
    for j in range(m * columns):
        work[j] = 0.0
    for a in range(m):
        for i in range(n):
            c = h[a, i]
            if c != 0.0:
                for b in range(blocks):
                    first, at = (b * n + i) * width, a * columns + b * width
                    rows, part = v[first : first + width], work[at : at + width]
                    for j in range(part.shape[0]):
                        part[j] += c * rows[j]
    for kind in range(kinds):
        if _concerns(ints, kind, measures, device):
            _sign(bank, ints, numbers, width, kind, measures, t_ns * 1e-9, nav, m, columns, work)
    for a in range(m):
        s, along = work[a * columns : (a + 1) * columns], 0.0
        for i in range(n):
            along += h[a, i] * g[a, i]
        # Of S = (h g) root + r, which is root^2.
        over = 1.0 / (0.5 * (along + math.sqrt(along * along + 4.0 * r[a])))
        for b in range(a):
            common, before = 0.0, work[b * columns : (b + 1) * columns]
            for i in range(n):
                common += h[a, i] * g[b, i]
            for j in range(s.shape[0]):
                s[j] -= common * before[j]
        for j in range(s.shape[0]):
            s[j] *= over
    return columns


@compiled("void(f8[::1], i8, i8, f8[:, ::1], i8, i8, f8[::1])")
def _fold_in(v: Array, n: int, width: int, g: Array, m: int, columns: int, work: Array) -> None:
    """V <- V - g^T s, three rows in one pass."""
    blocks = columns // width
    for first in range(0, m, 3):
        second, third = min(first + 1, m - 1), min(first + 2, m - 1)
        for b in range(blocks):
            at = b * width
            s_0 = work[first * columns + at : first * columns + at + width]
            s_1 = work[second * columns + at : second * columns + at + width]
            s_2 = work[third * columns + at : third * columns + at + width]
            for i in range(n):
                c_0 = g[first, i]
                c_1 = g[second, i] if second > first else 0.0
                c_2 = g[third, i] if third > second else 0.0
                row = (b * n + i) * width
                rows = v[row : row + width]
                if c_0 == 0.0 and c_1 == 0.0 and c_2 == 0.0:
                    continue
                if m - first == 1:
                    for j in range(rows.shape[0]):
                        rows[j] -= c_0 * s_0[j]
                else:
                    for j in range(rows.shape[0]):
                        rows[j] = rows[j] - c_0 * s_0[j] - c_1 * s_1[j] - c_2 * s_2[j]


@compiled("void(f8[::1], i8, i8, f8[::1], f8[:, ::1], b1, f8[::1])")
def account(bank: Array, n: int, width: int, y: Array, g: Array, fused: bool, work: Array) -> None:
    """Take in what `sensitivity_rows` has left in `work` with the whitened innovation y (m,);
    `fused` where the filter folds the rows in, with g (m, w) as `whiten` leaves it."""
    m = y.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    blocks = v.shape[0] // (n * width)
    columns = blocks * width
    square = 0.0
    for a in range(m):
        square += y[a] * y[a]
    length, fit = int(bank[LENGTH]), width // LANES
    threes = (int(bank[THREES]) + LANES - 1) // LANES
    eights = threes + (int(bank[ALL]) - int(bank[THREES]) + LANES - 1) // LANES
    unsigned = np.uint64
    for row in range(eights):
        three = row < threes
        at = GROUPS + min(row, threes) * OF_THREE + max(row - threes, 0) * OF_ONE
        first = 3 * row if three else 2 * threes + row
        own = unsigned(at)
        for k in range(length):
            j = own + unsigned(k)
            bank[j + unsigned(J_AT)] += square
            bank[j + unsigned(N_AT)] += m
        for a in range(m):
            y_a = y[a]
            at_0 = unsigned(a * columns + first // fit * width + first % fit * LANES)
            for k in range(length):
                j, s_0 = own + unsigned(k), work[at_0 + unsigned(k)]
                bank[j + unsigned(L_AT)] += s_0 * s_0
                bank[j + unsigned(E_AT)] += s_0 * y_a
            if three:
                second, third = first + 1, first + 2
                at_1 = unsigned(a * columns + second // fit * width + second % fit * LANES)
                at_2 = unsigned(a * columns + third // fit * width + third % fit * LANES)
                for k in range(length):
                    j, lane = own + unsigned(k), unsigned(k)
                    s_0, s_1, s_2 = work[at_0 + lane], work[at_1 + lane], work[at_2 + lane]
                    bank[j + unsigned(L10)] += s_1 * s_0
                    bank[j + unsigned(L11)] += s_1 * s_1
                    bank[j + unsigned(L20)] += s_2 * s_0
                    bank[j + unsigned(L21)] += s_2 * s_1
                    bank[j + unsigned(L22)] += s_2 * s_2
                    bank[j + unsigned(E1)] += s_1 * y_a
                    bank[j + unsigned(E2)] += s_2 * y_a
    if fused:
        _fold_in(v, n, width, g, m, columns, work)
