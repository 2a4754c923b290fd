"""Compiled kernels: what the hypotheses of a bank say of an aid's rows, and what these say of them.

As fusiond.estimators.fault_bank says, with the path by dead reckoning that a delay needs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    CARRIED,
    DELAY,
    E_AT,
    ENTRIES,
    FIRST,
    FOLLOWED,
    GROUP,
    GROUPS,
    HEAD,
    J_AT,
    L_AT,
    LAG,
    MOVES,
    N_AT,
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
    SIGNATURE,
    SIZE,
    SPEED,
    VELOCITY,
    VELOCITY_RAMP,
)
from fusiond.estimators.fault_onsets import concerns
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


@compiled("f8(f8[::1], f8, i8)")
def _past(bank: Array, t_s: float, component: int) -> float:
    """Component (place 0 to 2, velocity 3 to 5) of the path at `t_s`, linear between two points;
    not a number where it is not kept."""
    entries = int(bank[ENTRIES])
    for back in range(min(entries, RING) - 1):
        at = HEAD + (entries - 1 - back) % RING * POINT
        before = HEAD + (entries - 2 - back) % RING * POINT
        if bank[before] <= t_s:
            share = (t_s - bank[before]) / (bank[at] - bank[before])
            a, b = bank[before + 1 + component], bank[at + 1 + component]
            found: float = a + share * (b - a)
            return found
    return math.nan


@compiled("f8(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, f8, f8, f8[::1], i8, i8)")
def signature(
    bank: Array,
    ints: Indices,
    numbers: Array,
    kind: int,
    measures: int,
    device: int,
    t_s: float,
    age_s: float,
    nav: Array,
    row: int,
    component: int,
) -> float:
    """D of a row for a component of a kind that has run for `age_s`."""
    of, d = ints[kind, SIGNATURE], 0.0
    if of <= FOLLOWED or not concerns(ints, kind, measures, device):
        return 0.0
    if of == DELAY:
        lag = numbers[kind, LAG]
        if measures == PLACES:
            d = bank[PATH + row] + (t_s - bank[PATH_S]) * nav[VN + row]
            d -= _past(bank, t_s - lag, row)
        elif measures == MOVES:
            d = nav[VN + row] - _past(bank, t_s - lag, 3 + row)
        return d if math.isfinite(d) else 0.0
    if of == SPEED:
        return -math.hypot(nav[VN], nav[VN + 1]) if measures == ROLLS else 0.0
    if row != component:
        return 0.0
    if measures == PLACES:
        if of == POSITION:
            d = -1.0
        elif of in (POSITION_RAMP, CARRIED):
            d = -age_s
    elif measures == MOVES:
        if of in (VELOCITY, CARRIED):
            d = -1.0
        elif of == VELOCITY_RAMP:
            d = -age_s
    elif measures == OTHER and of == ROWS:
        d = -1.0
    return d


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
    t_s = t_ns * 1e-9
    for a in range(m):
        s = work[a * columns : (a + 1) * columns]
        along = 0.0
        for i in range(n):
            along += h[a, i] * g[a, i]
        # Of S = (h g) root + r, which is root^2.
        root = 0.5 * (along + math.sqrt(along * along + 4.0 * r[a]))
        for b in range(blocks):
            part = s[b * width : (b + 1) * width]
            for j in range(width):
                part[j] = 0.0
            for i in range(n):
                c = h[a, i]
                if c != 0.0:
                    first = (b * n + i) * width
                    rows = v[first : first + width]
                    for j in range(width):
                        part[j] += c * rows[j]
        for kind in range(kinds):
            if ints[kind, SIGNATURE] <= FOLLOWED or not concerns(ints, kind, measures, device):
                continue
            size = ints[kind, SIZE]
            for restart in range(RESTARTS):
                age_s = t_s - bank[GROUPS + (RESTARTS * kind + restart) * GROUP + ONSET]
                for c in range(size):
                    s[ints[kind, FIRST] + restart * size + c] += signature(
                        bank, ints, numbers, kind, measures, device, t_s, age_s, nav, a, c
                    )
        for b in range(a):
            common, before = 0.0, work[b * columns : (b + 1) * columns]
            for i in range(n):
                common += h[a, i] * g[b, i]
            for j in range(columns):
                s[j] -= common * before[j]
        for j in range(columns):
            s[j] /= root
    return columns


@compiled("void(f8[::1], i8[:, ::1], i8, i8, f8[::1], f8[:, ::1], b1, f8[::1])")
def account(
    bank: Array,
    ints: Indices,
    n: int,
    width: int,
    y: Array,
    g: Array,
    fused: bool,
    work: Array,
) -> None:
    """Take in what `sensitivity_rows` has left in `work` with the whitened innovation y (m,);
    `fused` where the filter folds the rows in, with g (m, w) as `whiten` leaves it."""
    m, kinds = y.shape[0], ints.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    blocks = v.shape[0] // (n * width)
    columns = blocks * width
    square = 0.0
    for a in range(m):
        square += y[a] * y[a]
    for kind in range(kinds):
        size = ints[kind, SIZE]
        for restart in range(RESTARTS):
            group = bank[GROUPS + (RESTARTS * kind + restart) * GROUP :]
            first = ints[kind, FIRST] + restart * size
            for a in range(m):
                s = work[a * columns + first :]
                for c in range(size):
                    group[E_AT + c] += s[c] * y[a]
                    for d in range(size):
                        group[L_AT + 3 * c + d] += s[c] * s[d]
            group[J_AT] += square
            group[N_AT] += m
    if fused:
        for b in range(blocks):
            for i in range(n):
                first = (b * n + i) * width
                rows = v[first : first + width]
                for a in range(m):
                    c = g[a, i]
                    if c != 0.0:
                        s = work[a * columns + b * width :]
                        for j in range(width):
                            rows[j] -= c * s[j]
