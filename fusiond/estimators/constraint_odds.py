r"""Compiled kernel: odds while nothing is measured, and constraints alone tell.

That a vehicle does not slip is known of it, ten times a second, and its innovations are not
independent: what slides or leans does so for a second or longer. Ten of them say as much as one,

    w_f ~ exp((l_f - max l) / CONSTRAINTS)        of those that are likelier than nothing wrong

so that what an outage leaves open is not told apart by one story of ten: a gyro from an
accelerometer that would feel the same.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    ANY_FAULT,
    LOG_ODDS,
    UNEXPLAINED,
    WEIGHT,
    group_at,
)
from fusiond.estimators.fault_odds import judge
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CONSTRAINTS = 10.0
"""Rows of one kind that say as much as one that is independent: those of a second."""
UNMEASURED_S = 2.0
"""So long after the last measurement constraints are judged by themselves: two fixes of a receiver
of one a second."""


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], f8, f8[::1])")
def judge_by_constraints(
    bank: Array, ints: Indices, numbers: Array, lanes: Array, epoch_s: float, found: Array
) -> None:
    """`judge` at the epoch of a constraint, with such weights."""
    judge(bank, ints, numbers, lanes, epoch_s, found)
    largest = 0.0
    for number in range(int(bank[ALL])):
        at = group_at(bank, number)
        if bank[at + UNEXPLAINED] <= 0.0:
            largest = max(largest, bank[at + LOG_ODDS])
    if largest == 0.0:
        return
    nothing = math.exp(-largest)
    total = nothing
    for number in range(int(bank[ALL])):
        at = group_at(bank, number)
        odds = bank[at + LOG_ODDS]
        if bank[at + UNEXPLAINED] <= 0.0 and odds > -np.inf:
            less = odds - largest
            bank[at + WEIGHT] = math.exp(less / CONSTRAINTS if odds > 0.0 else less)
            total += bank[at + WEIGHT]
    for number in range(int(bank[ALL])):
        bank[group_at(bank, number) + WEIGHT] /= total
    bank[ANY_FAULT] = 1.0 - nothing / total
