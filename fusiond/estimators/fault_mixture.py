r"""Effect of a bank's hypotheses on the filter: of each by itself, and of all as they are weighed.

    of one              V b, V M V^T with its b and M
    left open           sum of w_f V_f (M_f + b_f b_f^T) V_f^T: the mixture's second moment about
                        the estimate of the filter, which is that of nothing wrong

with the weights of fusiond.estimators.fault_odds. What is published of it, at each measurement, is
in fusiond.estimators.fault_sizes.

Source: as of fusiond.estimators.fault_bank; Blom, Bar-Shalom, IEEE Trans. AC 33 (1988), 780, for
the moments of a mixture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    LEAST_WEIGHT,
    RESTARTS,
    SENSITIVITIES,
    THREES,
    WEIGHT,
    column_of,
    dispersion,
    group_at,
)
from fusiond.estimators.fault_odds import solve
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]


@compiled("void(f8[::1], f8[:, ::1], i8, f8[:, ::1])", allocates=True)
def mixture(bank: Array, numbers: Array, n: int, opened: Array) -> None:
    """Write the covariance that the weighted hypotheses add to the first rows of the error state
    (q, q)."""
    q = opened.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    opened[:] = 0.0
    m, x, rows = np.empty(12), np.empty((3, 3)), np.empty((3, q))
    for number in range(int(bank[ALL])):
        at, size = group_at(bank, number), 3 if number < int(bank[THREES]) else 1
        weight = bank[at + WEIGHT]
        if weight < LEAST_WEIGHT:
            continue
        share = dispersion(bank, np.uint64(at), size)
        solve(bank, at, size, numbers[number // RESTARTS], share, m)
        for c in range(size):
            for d in range(size):
                x[c, d] = weight * (share * m[3 * c + d] + m[9 + c] * m[9 + d])
            first = column_of(bank, number, c)
            for i in range(q):
                rows[c, i] = v[first + i * columns]
        for i in range(q):
            for c in range(size):
                along = 0.0
                for d in range(size):
                    along += x[c, d] * rows[d, i]
                for j in range(q):
                    opened[i, j] += rows[c, j] * along


@compiled("void(f8[::1], f8[:, ::1], i8, i8, f8[::1], f8[:, ::1])", allocates=True)
def estimate(
    bank: Array,
    numbers: Array,
    n: int,
    number: int,
    size_and_variance: Array,
    effect: Array,
) -> None:
    """Write b (3,) and M (9,) of a group, and its effect V b and V M V^T: `effect` (1 + n, n)."""
    at, size = group_at(bank, number), 3 if number < int(bank[THREES]) else 1
    v = bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    m = np.empty(12)
    solve(bank, at, size, numbers[number // RESTARTS], 1.0, m)
    size_and_variance[:] = 0.0
    effect[:] = 0.0
    rows = np.empty((3, n))
    for c in range(size):
        size_and_variance[c] = m[9 + c]
        first = column_of(bank, number, c)
        for i in range(n):
            rows[c, i] = v[first + i * columns]
            effect[0, i] += rows[c, i] * m[9 + c]
        for d in range(size):
            size_and_variance[3 + 3 * c + d] = m[3 * c + d]
    for i in range(n):
        for c in range(size):
            along = 0.0
            for d in range(size):
                along += m[3 * c + d] * rows[d, i]
            for j in range(n):
                effect[1 + i, j] += rows[c, j] * along
