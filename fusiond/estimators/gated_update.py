"""Compiled kernel: gate, update, feedback, and the update of the fault bank."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    CLASS,
    FOLLOWED,
    LEAST_WEIGHT,
    RESTARTS,
    SIGNATURE,
    SIZE,
    UNJUDGED,
    UNWEIGHED,
    WEIGHT,
    column_of,
    dispersion,
    group_at,
)
from fusiond.estimators.fault_odds import judge, solve
from fusiond.estimators.fault_onsets import restart_due
from fusiond.estimators.fault_prescreen import judge_what_waits, restarts
from fusiond.estimators.fault_update import account, keep_fed_back, sensitivity_rows
from fusiond.estimators.update import feed_back, fold_in, whiten
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Indices = NDArray[np.int64]


@compiled("f8(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, f4[::1])", allocates=True)
def nis_if_sensors_fail(
    bank: Array, ints: Indices, numbers: Array, y: Array, columns: int, work: Single
) -> float:
    """Normalised innovation squared if the inertial unit is at fault.

    nu^T S^-1 nu of a whitened innovation y (m,), with S widened by the weighted faults of the
    inertial unit (class 0) and by ended faults of sources. Infinite unless these are likelier than
    all else together. `work` from `sensitivity_rows`."""
    rows = y.shape[0]
    c, m, likely = np.eye(rows), np.empty(12), 0.0
    for number in range(int(bank[ALL])):
        kind, at = number // RESTARTS, group_at(bank, number)
        weight = bank[at + WEIGHT]
        ours = ints[kind, CLASS] == 0 or ints[kind, SIGNATURE] == FOLLOWED
        if not ours or weight < LEAST_WEIGHT:
            continue
        likely += weight
        size = ints[kind, SIZE]
        share = dispersion(bank, np.uint64(at), size)
        solve(bank, at, size, numbers[kind], share, m)
        for a in range(rows):
            for b in range(rows):
                for i in range(size):
                    s_a = np.float64(work[a * columns + column_of(bank, number, i)])
                    for j in range(size):
                        x = weight * (share * m[3 * i + j] + m[9 + i] * m[9 + j])
                        s_b = work[b * columns + column_of(bank, number, j)]
                        c[a, b] += s_a * s_b * x
    if likely < 0.5:
        return np.inf
    # y^T C^-1 y by elimination.
    left, nis = y.copy(), 0.0
    for k in range(rows):
        nis += left[k] * left[k] / c[k, k]
        for i in range(k + 1, rows):
            share = c[i, k] / c[k, k]
            left[i] -= share * left[k]
            for j in range(k + 1, rows):
                c[i, j] -= share * c[k, j]
    return nis


@compiled(
    "f8(f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, f8[::1],"
    "f8[:, ::1], f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, i8, i8, f4[::1], f8[::1])"
)
def fold_and_account(
    nav: Array,
    xi: Array,
    step: Array,
    cov: Array,
    dx: Array,
    z: Array,
    h: Array,
    r: Array,
    threshold: float,
    y: Array,
    g: Array,
    bank: Array,
    ints: Indices,
    numbers: Array,
    lanes: Array,
    t_ns: int,
    measures: int,
    device: int,
    work: Single,
    found: Array,
) -> float:
    """Gate and update as `fusiond.estimators.update.fuse` with feedback, and update the bank if
    present; `measures` and `device` as in `sensitivity_rows`.

    A failed row is evidence, too: otherwise a fault of the inertial unit that fails every gate
    would never be found. If such a fault, at its present probability, explains the row, the row is
    used; rows of the same instant that have not been judged are judged before, to `found` (5,).
    """
    nis = whiten(cov, z, h, r, y, g)
    if not nis < np.inf:
        return nis
    if bank.size:
        n, fails = dx.shape[0], nis > threshold
        if fails or restarts(bank, t_ns):
            judge_what_waits(bank, ints, numbers, lanes, found)
        bank[UNWEIGHED] = np.inf  # what comes now is evidence, too
        if fails and bank[UNJUDGED] < np.inf:
            judge(bank, ints, numbers, lanes, bank[UNJUDGED], found)
        restart_due(bank, ints, numbers, n, t_ns, nav, step)
        rows = bank, ints, numbers, n, t_ns, measures, device, nav, h, r, g, work
        columns = sensitivity_rows(*rows)
        if fails:
            nis = min(nis, nis_if_sensors_fail(bank, ints, numbers, y, columns, work))
        account(bank, n, measures, y, g, nis <= threshold, y.shape[0], 0.0, work)
    if nis <= threshold:
        dx[:] = 0.0
        fold_in(cov, dx, y, g)
        if bank.size:
            keep_fed_back(bank, dx)
        feed_back(nav, xi, dx)
        dx[:] = 0.0
    return nis
