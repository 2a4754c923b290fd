r"""Compiled kernels: onset of each hypothesis of a bank, and its initial step of states.

For fusiond.estimators.fault_bank. One hypothesis is the end of a source's fault that the filter has
followed. Its error is then the effect of those faults f, weighted,

    V = sum w_f V_f b_f / w,   w = sum w_f,   with w as its initial probability
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
    dispersion,
    group_at,
)
from fusiond.estimators.fault_carried import begin_transition
from fusiond.estimators.fault_odds import solve
from fusiond.estimators.fault_update import concerns
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.strapdown import HEIGHT, LAT, STEP_DCM, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


UNLIKELY = 1e-12
"""Probability of a followed fault that is ignored."""
COUNTS = 1e-3
"""Weight of a fault below which its effect is not computed."""


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, f8[::1])", allocates=True)
def _followed(bank: Array, ints: Indices, numbers: Array, n: int, followed: Array) -> None:
    """Write the weighted effect of sources' faults on the filter (n,), and their total weight."""
    followed[:] = 0.0
    if not bank[ANY_FAULT] > COUNTS:
        return
    v, m = bank[int(bank[SENSITIVITIES]) :].view(np.float32), np.empty(12)
    columns = v.shape[0] // n
    for number in range(int(bank[ALL])):
        kind, at = number // RESTARTS, group_at(bank, number)
        weight = bank[at + WEIGHT]
        if ints[kind, SIGNATURE] <= FOLLOWED or weight < COUNTS:
            continue
        size = 3 if number < int(bank[THREES]) else 1
        solve(bank, at, size, numbers[kind], dispersion(bank, np.uint64(at), size), m)
        followed[n] += weight
        for c in range(size):
            first = column_of(bank, number, c)
            for i in range(n):
                followed[i] += weight * m[9 + c] * v[first + i * columns]
    if followed[n] > 0.0:
        for i in range(n):
            followed[i] /= followed[n]


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
    """Restart one hypothesis of a kind with its onset now, at a state nav (10,) after `step`;
    `followed` (n + 1,) from `_followed`."""
    number, size = RESTARTS * kind + restart, ints[kind, SIZE]
    at = group_at(bank, number)
    for j in range(0, OF_ONE if size == 1 else OF_THREE, LANES):
        bank[at + j] = 0.0
    bank[at + ONSET] = t_s
    bank[at + LOG_ODDS], bank[at + LIKELY] = -np.inf, np.inf
    if ints[kind, SIGNATURE] == FOLLOWED:
        bank[at + COUNTS_BY] = math.log(max(followed[n], UNLIKELY))
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
                v[first + i * columns] = followed[i]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8[::1], f8[::1])", allocates=True)
def begin_all(
    bank: Array, ints: Indices, n: int, width: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Restart all hypotheses; the path is kept."""
    begin_transition(bank, n, width)
    bank[ANY_FAULT], bank[SUSPECTS], bank[UNJUDGED], bank[UNWEIGHED] = 0.0, 0.0, np.inf, np.inf
    followed = np.zeros(n + 1)
    for kind in range(ints.shape[0]):
        for restart in range(RESTARTS):
            _begin_group(bank, ints, n, kind, restart, t_ns * 1e-9, nav, step, followed)
    for level in range(len(PERIODS_NS)):
        bank[RESTARTED + level] = t_ns // PERIODS_NS[level]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8)")
def _promote(bank: Array, ints: Indices, n: int, kind: int, restart: int) -> None:
    """Replace the less likely onset of the level above, if much less likely.

    The replacement is the hypothesis that is due to restart."""
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
    """Restart the hypotheses on series that return to service."""
    followed = np.zeros(n + 1)
    for kind in range(ints.shape[0]):
        if concerns(ints, kind, measures, device):
            for restart in range(RESTARTS):
                _begin_group(bank, ints, n, kind, restart, t_ns * 1e-9, nav, step, followed)


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, f8[::1], f8[::1])", allocates=True)
def restart_due(
    bank: Array, ints: Indices, numbers: Array, n: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Restart the hypotheses that are due at `t_ns`, longest period first, so that a promoted one
    is not the next to restart."""
    followed = np.zeros(0)
    for back in range(len(PERIODS_NS)):
        level = len(PERIODS_NS) - 1 - back
        turn = t_ns // PERIODS_NS[level]
        if bank[RESTARTED + level] != turn:
            bank[RESTARTED + level] = turn
            if followed.shape[0] == 0:
                followed = np.zeros(n + 1)
                _followed(bank, ints, numbers, n, followed)
            slot = BEGINS_AT[level] + turn % SLOTS_OF[level]
            for kind in range(ints.shape[0]):
                if ints[kind, SIGNATURE] == SHIFTED:  # it is so from the start on
                    continue
                _promote(bank, ints, n, kind, slot)
                _begin_group(bank, ints, n, kind, slot, t_ns * 1e-9, nav, step, followed)
