r"""Compiled kernels: when the hypotheses of a bank begin, and with which step of states.

As fusiond.estimators.fault_bank says. One of them is that a source's fault is over, which the
filter has followed: its error is then what the likeliest of those faults has done to it, V_f b_f
with b_f ~ N(b, M), and as likely to begin as all of them together. Its three numbers c are of unit
variance,

    V = V_f B,   B B^T = b b^T + M,   B = [b sqrt(1 + 1 / x), R],   x = b^T M^-1 b
    R R^T = M - b b^T / x                                                           of rank two

so that the first is the share of what the fault is estimated to have done, and the others are what
the estimate leaves open beside it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    ANY_FAULT,
    BEGINS_AT,
    COUNTS_BY,
    E1,
    E2,
    E_AT,
    EXPLAINED,
    FOLLOWED,
    LANES,
    LEVEL_OF,
    LIKELY,
    LOG_ODDS,
    OF_ONE,
    OF_THREE,
    ONSET,
    PERIODS_NS,
    PROMOTED,
    RESTARTED,
    RESTARTS,
    SENSITIVITIES,
    SHIFTED,
    SIGNATURE,
    SIZE,
    SLOTS,
    SLOTS_OF,
    STATES,
    SUSPECTS,
    THREES,
    TURNED,
    UNJUDGED,
    UNWEIGHED,
    WEIGHT,
    column_of,
    group_at,
)
from fusiond.estimators.fault_carried import begin_transition
from fusiond.estimators.fault_odds import solve
from fusiond.estimators.fault_rows import concerns
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.strapdown import HEIGHT, LAT, STEP_DCM, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


UNLIKELY = 1e-12
"""Of what is followed by no fault that counts."""
COUNTS = 1e-3
"""Weight of a fault below which what it has done is not looked at."""


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, f8[::1])", allocates=True)
def _followed(bank: Array, ints: Indices, numbers: Array, n: int, followed: Array) -> None:
    """Write what a source's fault has done to the filter, V (3, n) row by row, and behind it the
    weight of all of them."""
    followed[:] = 0.0
    if not bank[ANY_FAULT] > COUNTS:
        return
    likeliest, most = -1, 0.0
    for number in range(int(bank[ALL])):
        weight = bank[group_at(bank, number) + WEIGHT]
        if ints[number // RESTARTS, SIGNATURE] <= FOLLOWED or weight < COUNTS:
            continue
        followed[3 * n] += weight
        explains = weight * bank[group_at(bank, number) + EXPLAINED]
        if explains > most:
            likeliest, most = number, explains
    if likeliest < 0:
        return
    at, size = group_at(bank, likeliest), 3 if likeliest < int(bank[THREES]) else 1
    m, of = np.empty(12), np.zeros((3, 3))
    solve(bank, at, size, numbers[likeliest // RESTARTS], 1.0, m)
    # M^-1 b is e where no mean is expected, as of three numbers.
    x = m[9] * m[9] / m[0]
    if size == 3:
        x = m[9] * bank[at + E_AT] + m[10] * bank[at + E1] + m[11] * bank[at + E2]
    x = max(x, 1e-9)
    for i in range(size):
        of[i, 0] = m[9 + i] * math.sqrt(1.0 + 1.0 / x)
        for j in range(size):
            m[3 * i + j] -= m[9 + i] * m[9 + j] / x
    for c in range(1, size):  # what is left, by its largest variance first
        k = 0
        for i in range(1, size):
            if m[4 * i] > m[4 * k]:
                k = i
        if m[4 * k] <= 0.0:
            break
        for i in range(size):
            of[i, c] = m[3 * i + k] / math.sqrt(m[4 * k])
        for i in range(size):
            for j in range(size):
                m[3 * i + j] -= of[i, c] * of[j, c]
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    for d in range(size):
        first = column_of(bank, likeliest, d)
        for c in range(size):
            for i in range(n):
                followed[c * n + i] += of[d, c] * v[first + i * columns]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8, f8[::1], f8[::1], f8[::1])")
def _begin_group(
    bank: Array,
    ints: Indices,
    n: int,
    kind: int,
    restart: int,
    t_s: float,
    nav: Array,
    step: Array,
    followed: Array,
) -> None:
    """Begin one kind's restart anew, with its onset now, at a state nav (10,) after `step`;
    `followed` (3 n + 1,) as `_followed` leaves it."""
    number, size = RESTARTS * kind + restart, ints[kind, SIZE]
    at = group_at(bank, number)
    for j in range(0, OF_ONE if size == 1 else OF_THREE, LANES):
        bank[at + j] = 0.0
    bank[at + ONSET] = t_s
    bank[at + LOG_ODDS], bank[at + LIKELY] = -np.inf, np.inf
    if ints[kind, SIGNATURE] == FOLLOWED:
        bank[at + COUNTS_BY] = math.log(max(followed[3 * n], UNLIKELY))
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    for c in range(size):
        first = column_of(bank, number, c)
        for i in range(n):
            v[first + i * columns] = 0.0
        of, slots = ints[kind, SIGNATURE], ints[kind, SLOTS : SLOTS + 3]
        if of == STATES:
            for j in range(3):
                if (j == c or size == 1) and slots[j] >= 0:
                    v[first + slots[j] * columns] = 1.0
        elif of == TURNED:
            for i in range(3):
                v[first + i * columns] = step[STEP_DCM + 3 * i + c]
            if slots[c] >= 0:
                v[first + slots[c] * columns] = 1.0
        elif of == SHIFTED:
            # It began at fixes that were stamped by tau too late: p - v tau, v - a tau.
            for i in range(3):
                force = step[STEP_SMOOTH_N + i]
                if i == 2:
                    force += gravity(nav[LAT], nav[HEIGHT])
                v[first + (3 + i) * columns] = -force
                v[first + (6 + i) * columns] = -nav[VN + i]
            for j in range(3):
                if slots[j] >= 0:
                    v[first + slots[j] * columns] = -1.0
        elif of == FOLLOWED:
            for i in range(n):
                v[first + i * columns] = followed[c * n + i]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8[::1], f8[::1])", allocates=True)
def begin_all(
    bank: Array, ints: Indices, n: int, width: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Begin all hypotheses anew; what the path was remains."""
    begin_transition(bank, n, width)
    bank[ANY_FAULT], bank[SUSPECTS], bank[UNJUDGED], bank[UNWEIGHED] = 0.0, 0.0, np.inf, np.inf
    followed = np.zeros(3 * n + 1)
    for kind in range(ints.shape[0]):
        for restart in range(RESTARTS):
            _begin_group(bank, ints, n, kind, restart, t_ns * 1e-9, nav, step, followed)
    for level in range(len(PERIODS_NS)):
        bank[RESTARTED + level] = t_ns // PERIODS_NS[level]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8)")
def _promote(bank: Array, ints: Indices, n: int, kind: int, restart: int) -> None:
    """A restart that is about to begin anew takes the place of the less likely one of the level
    above, if that is much less likely."""
    level = LEVEL_OF[restart] + 1
    if level >= len(SLOTS_OF):
        return
    number, size = RESTARTS * kind + restart, ints[kind, SIZE]
    at = group_at(bank, number)
    odds, least, found = bank[at + LOG_ODDS], np.inf, -1
    for slot in range(BEGINS_AT[level], BEGINS_AT[level] + SLOTS_OF[level]):
        above = bank[group_at(bank, RESTARTS * kind + slot) + LOG_ODDS]
        if above < least:
            least, found = above, slot
    if found < 0 or not odds > least + PROMOTED:
        return
    to = RESTARTS * kind + found
    there = group_at(bank, to)
    for j in range(0, OF_ONE if size == 1 else OF_THREE, LANES):
        bank[there + j] = bank[at + j]
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    for c in range(size):
        own, other = column_of(bank, number, c), column_of(bank, to, c)
        for i in range(n):
            v[other + i * columns] = v[own + i * columns]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, i8, f8[::1], f8[::1])", allocates=True)
def begin_again(
    bank: Array,
    ints: Indices,
    n: int,
    measures: int,
    device: int,
    t_ns: int,
    nav: Array,
    step: Array,
) -> None:
    """Begin those hypotheses anew that are of rows which return to service."""
    followed = np.zeros(3 * n + 1)
    for kind in range(ints.shape[0]):
        if concerns(ints, kind, measures, device):
            for restart in range(RESTARTS):
                _begin_group(bank, ints, n, kind, restart, t_ns * 1e-9, nav, step, followed)


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, f8[::1], f8[::1])", allocates=True)
def restart_due(
    bank: Array, ints: Indices, numbers: Array, n: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Begin anew those restarts whose turn has come at `t_ns`; of the longest period first, so that
    one that has just been handed on is not the next to begin."""
    followed = np.zeros(0)
    for back in range(len(PERIODS_NS)):
        level = len(PERIODS_NS) - 1 - back
        turn = t_ns // PERIODS_NS[level]
        if bank[RESTARTED + level] != turn:
            bank[RESTARTED + level] = turn
            if followed.shape[0] == 0:
                followed = np.zeros(3 * n + 1)
                _followed(bank, ints, numbers, n, followed)
            slot = BEGINS_AT[level] + turn % SLOTS_OF[level]
            for kind in range(ints.shape[0]):
                if ints[kind, SIGNATURE] == SHIFTED:  # it is so from the start on
                    continue
                _promote(bank, ints, n, kind, slot)
                _begin_group(bank, ints, n, kind, slot, t_ns * 1e-9, nav, step, followed)
