"""Compiled kernel: cheap test for a likely hypothesis, before all odds are computed.

With the largest value of the prior's density, log odds are at most

    log(rate T) + l / 2        of any kind, as fusiond.estimators.fault_odds has them

so an epoch in which no group exceeds the threshold of a likely hypothesis needs no odds and no
weights, unless they are read before the next epoch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    CONSTANTS,
    COUNTS_BY,
    DECIDED,
    E_AT,
    GROUPS,
    L_AT,
    LANES,
    LENGTH,
    OF_ONE,
    OF_THREE,
    P_AT,
    PERIODS_NS,
    RATE_AT,
    RESTARTED,
    THREES,
    TINY,
    UNJUDGED,
    UNWEIGHED,
    explained_by_three,
)
from fusiond.estimators.fault_odds import judge
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROUNDING = 0.1
"""Log odds that no rounding makes."""


@compiled("b1(f8[::1], f8[::1])", allocates=True)
def any_likely(bank: Array, lanes: Array) -> bool:
    """True if the log odds of a group may be beyond `DECIDED`."""
    length, most = int(bank[LENGTH]), np.full(LANES, -np.inf)
    threes = (int(bank[THREES]) + LANES - 1) // LANES
    ones = (int(bank[ALL]) - int(bank[THREES]) + LANES - 1) // LANES
    unsigned = np.uint64
    for row in range(threes + ones):
        at = unsigned(GROUPS + min(row, threes) * OF_THREE + max(row - threes, 0) * OF_ONE)
        constants = unsigned(row * CONSTANTS)
        if row < threes:
            for k in range(length):
                j, c = at + unsigned(k), constants + unsigned(k)
                gained = explained_by_three(bank, lanes, j, c)
                odds = lanes[c + unsigned(RATE_AT)] + bank[j + unsigned(COUNTS_BY)] + 0.5 * gained
                most[unsigned(k)] = max(most[unsigned(k)], odds)
        else:
            for k in range(length):
                j, c = at + unsigned(k), constants + unsigned(k)
                e = bank[j + unsigned(E_AT)]
                gained = e * e / (bank[j + unsigned(L_AT)] + TINY * lanes[c + unsigned(P_AT)])
                odds = lanes[c + unsigned(RATE_AT)] + bank[j + unsigned(COUNTS_BY)] + 0.5 * gained
                most[unsigned(k)] = max(most[unsigned(k)], odds)
    largest = -np.inf
    for k in range(LANES):
        largest = max(largest, most[k])
    return largest > DECIDED - ROUNDING


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], f8[::1])")
def judge_what_waits(
    bank: Array, ints: Indices, numbers: Array, lanes: Array, found: Array
) -> None:
    """Compute the odds of a deferred epoch."""
    if bank[UNWEIGHED] < np.inf:
        epoch_s = bank[UNWEIGHED]
        bank[UNWEIGHED] = np.inf
        if bank[UNJUDGED] == np.inf:
            judge(bank, ints, numbers, lanes, epoch_s, found)


@compiled("b1(f8[::1], i8)", forceinline=True)
def restarts(bank: Array, t_ns: int) -> bool:
    """True if a restart is due at an instant."""
    due: bool = bank[RESTARTED] != t_ns // PERIODS_NS[0]
    return due
