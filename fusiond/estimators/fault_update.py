"""Compiled kernels: measurement rows under each hypothesis of a bank, and the update by them.

For fusiond.estimators.fault_bank, with the path by dead reckoning that a delay needs.
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
    FED_BACK,
    FOLLOWED,
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
    SHOWN,
    SHOWN_KEPT,
    SIGNATURE,
    SIZE,
    SPEED,
    THREES,
    VELOCITY,
    VELOCITY_RAMP,
    column_of,
    group_at,
)
from fusiond.estimators.sensitivity_sums import (
    add_rows,
    fold_in_sensitivities,
    take_off_before,
)
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import DV
from fusiond.navigation.strapdown import VN

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Indices = NDArray[np.int64]


@compiled("void(f8[::1], f8[::1], f8, f8)")
def walk_path(bank: Array, nav: Array, now_s: float, step_s: float) -> None:
    """Extend the path by `step_s` at the velocity of `nav` (10,) and store its point.

    The velocity excludes all feedback so far.
    """
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
        bank[at + 1 + i] = bank[PATH + i]
        bank[at + 4 + i] = nav[VN + i] + bank[FED_BACK + i]
    bank[ENTRIES] = entries + 1.0


@compiled("void(f8[::1], f8[::1])", forceinline=True)
def keep_fed_back(bank: Array, dx: Array) -> None:
    """Subtract an error (n,), removed from the state, from past velocities as well."""
    for i in range(3):
        bank[FED_BACK + i] += dx[DV + i]


@compiled("i8(f8[::1], f8)")
def _past(bank: Array, t_s: float) -> int:
    """Number of points back to the path's last one up to `t_s`; -1 beyond the stored ones."""
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
    """Component (position 0 to 2, velocity 3 to 5) of the path at `t_s`, interpolated from the
    point `back` steps ago to the next."""
    entries = int(bank[ENTRIES])
    at = HEAD + (entries - back) % RING * POINT
    before = HEAD + (entries - 1 - back) % RING * POINT
    share = (t_s - bank[before]) / (bank[at] - bank[before])
    a, b = bank[before + 1 + component], bank[at + 1 + component]
    found: float = a + share * (b - a)
    return found


@compiled("b1(i8[:, ::1], i8, i8, i8)", forceinline=True)
def concerns(ints: Indices, kind: int, measures: int, device: int) -> bool:
    """True if a kind concerns these rows: of its device, or of any device that locates or moves."""
    if ints[kind, SIGNATURE] <= FOLLOWED:
        return False
    if measures == PLACES and not ints[kind, LOCATES]:
        return False
    if measures == MOVES and not ints[kind, MOVES_TOO]:
        return False
    if ints[kind, DEVICE] == ANY:
        return bool(measures <= MOVES)
    of_this: bool = ints[kind, DEVICE] == device
    return of_this


@compiled("UniTuple(f8, 2)(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, f8, f8[::1], i8, i8)")
def _of_row(
    bank: Array,
    ints: Indices,
    numbers: Array,
    kind: int,
    measures: int,
    t_s: float,
    nav: Array,
    back: int,
    row: int,
) -> tuple[float, float]:
    """Row of D for a component of a kind: an offset, and a slope over the time since its onset.
    `back`: index of the path at the start of the delay, from `_past`."""
    of, offset, slope = ints[kind, SIGNATURE], 0.0, 0.0
    if of == DELAY:
        if measures <= MOVES and back >= 0:
            then = t_s - numbers[kind, LAG]
            if measures == PLACES:
                offset = bank[PATH + row] + (t_s - bank[PATH_S]) * nav[VN + row]
                offset -= _at_past(bank, back, then, row)
            else:
                offset = nav[VN + row] + bank[FED_BACK + row]
                offset -= _at_past(bank, back, then, 3 + row)
    elif of == SPEED:
        if measures == ROLLS:
            offset = -math.hypot(nav[VN], nav[VN + 1])
    elif measures == PLACES:
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
    return offset if math.isfinite(offset) else 0.0, slope


@compiled(
    "void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, f8, f8, f8[::1], f8[::1], f8[::1])",
)
def rows_of_fault(
    bank: Array,
    ints: Indices,
    numbers: Array,
    kind: int,
    measures: int,
    device: int,
    t_s: float,
    age_s: float,
    nav: Array,
    b: Array,
    out: Array,
) -> None:
    """Write D b (3,) of a fault of a kind, of age `age_s` and size b (p,)."""
    out[:] = 0.0
    if not concerns(ints, kind, measures, device):
        return
    of, size = ints[kind, SIGNATURE], ints[kind, SIZE]
    back = _past(bank, t_s - numbers[kind, LAG]) if of == DELAY else -1
    for a in range(3):
        offset, slope = _of_row(bank, ints, numbers, kind, measures, t_s, nav, back, a)
        out[a] = (offset + slope * age_s) * b[0 if size == 1 else a]


@compiled(
    "i8(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, i8, f8[::1], f8[:, ::1], f8[::1],"
    "f8[:, ::1], f4[::1])",
    allocates=True,
)
def sensitivity_rows(
    bank: Array,
    ints: Indices,
    numbers: Array,
    n: int,
    t_ns: int,
    measures: int,
    device: int,
    nav: Array,
    h: Array,
    r: Array,
    g: Array,
    work: Single,
) -> int:
    """Write L^-1 (H V + D) of a measurement's rows at `t_ns` to `work`, one row for each column of
    V; their number. H (m, n), variances r (m,), g (m, w) = L^-1 H P as `whiten` leaves it; nav
    (10,)."""
    m, kinds, t_s = h.shape[0], ints.shape[0], t_ns * 1e-9
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns: int = v.shape[0] // n
    of = np.empty(n, dtype=np.int64)
    for a in range(m):
        s, count = work[a * columns : (a + 1) * columns], 0
        for i in range(n):
            if h[a, i] != 0.0:
                of[count] = i
                count += 1
        for j in range(s.shape[0]):
            s[j] = 0.0
        add_rows(v, columns, 0, of, count, h[a], s)
    for kind in range(kinds):
        if not concerns(ints, kind, measures, device):
            continue
        size = ints[kind, SIZE]
        back = _past(bank, t_s - numbers[kind, LAG]) if ints[kind, SIGNATURE] == DELAY else -1
        for a in range(m if size == 1 else min(m, size)):
            offset, slope = _of_row(bank, ints, numbers, kind, measures, t_s, nav, back, a)
            if offset == 0.0 and slope == 0.0:
                continue
            # For each restart the offset, and the growth since its onset.
            number, behind = RESTARTS * kind, RESTARTS * (kind + 1)
            while number < behind:  # those of eight at once
                at = group_at(bank, number)
                fits = min(behind - number, LANES - (at - GROUPS) % LANES)
                onsets = bank[at + ONSET : at + ONSET + fits]
                first = a * columns + column_of(bank, number, 0 if size == 1 else a)
                s = work[first : first + fits]
                for j in range(s.shape[0]):
                    s[j] += offset + slope * (t_s - onsets[j])
                number += fits
    for a in range(m):
        s, along = work[a * columns : (a + 1) * columns], 0.0
        for i in range(n):
            along += h[a, i] * g[a, i]
        # Of S = (h g) root + r, which is root^2.
        over = np.float32(1.0 / (0.5 * (along + math.sqrt(along * along + 4.0 * r[a]))))
        take_off_before(h, g, a, columns, work)
        for j in range(s.shape[0]):
            s[j] *= over
    return columns


@compiled("void(f8[::1], i8, i8, f8[::1], f8[:, ::1], b1, i8, f8, f4[::1])")
def account(
    bank: Array,
    n: int,
    measures: int,
    y: Array,
    g: Array,
    fused: bool,
    rows: int,
    noise: float,
    work: Single,
) -> None:
    """Update the bank from `work` of `sensitivity_rows` and the whitened innovation y (m,); `fused`
    rows have g (m, w) of `whiten`. They stand for `rows` rows; no hypothesis explains `noise`."""
    m = y.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    square = 0.0
    for a in range(m):
        square += y[a] * y[a]
    square += noise
    left = square
    if measures > ROLLS:
        left += rows * (1.0 - min(bank[SHOWN], 1.0))
        if fused:
            bank[SHOWN] += (square - rows * bank[SHOWN]) / SHOWN_KEPT
    length = int(bank[LENGTH])
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
            bank[j + unsigned(J_AT)] += left
            bank[j + unsigned(N_AT)] += rows
        for a in range(m):
            y_a = y[a]
            at_0 = unsigned(a * columns + first * LANES)
            for k in range(length):
                j, s_0 = own + unsigned(k), np.float64(work[at_0 + unsigned(k)])
                bank[j + unsigned(L_AT)] += s_0 * s_0
                bank[j + unsigned(E_AT)] += s_0 * y_a
            if three:
                at_1, at_2 = at_0 + unsigned(LANES), at_0 + unsigned(2 * LANES)
                for k in range(length):
                    j, lane = own + unsigned(k), unsigned(k)
                    s_0, s_1 = np.float64(work[at_0 + lane]), np.float64(work[at_1 + lane])
                    s_2 = np.float64(work[at_2 + lane])
                    bank[j + unsigned(L10)] += s_1 * s_0
                    bank[j + unsigned(L11)] += s_1 * s_1
                    bank[j + unsigned(L20)] += s_2 * s_0
                    bank[j + unsigned(L21)] += s_2 * s_1
                    bank[j + unsigned(L22)] += s_2 * s_2
                    bank[j + unsigned(E1)] += s_1 * y_a
                    bank[j + unsigned(E2)] += s_2 * y_a
    if fused:
        fold_in_sensitivities(v, n, g, columns, work)
