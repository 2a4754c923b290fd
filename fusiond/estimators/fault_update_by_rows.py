"""Compiled kernel: the update of a fault bank by rows that its filter takes in by itself.

Of many rows, as satellites bring them, the bank needs no more than they measure states
(fusiond.estimators.row_compression): what they say of a fault is what they say of those states.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import DEVICE, ROWS, SENSITIVITIES, SIGNATURE, UNWEIGHED
from fusiond.estimators.fault_onsets import restart_due
from fusiond.estimators.fault_prescreen import judge_what_waits, restarts
from fusiond.estimators.fault_update import account, sensitivity_rows
from fusiond.estimators.row_compression import compress, states_seen
from fusiond.estimators.update import take_off, whiten
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled("b1(i8[:, ::1], i8)")
def _have_own(ints: Indices, device: int) -> bool:
    """True if a kind is an offset of each row of a device's measurements."""
    for kind in range(ints.shape[0]):
        if ints[kind, SIGNATURE] == ROWS and ints[kind, DEVICE] == device:
            return True
    return False


@compiled(
    "void(f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], b1[::1], b1,"
    "f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, i8, i8, f8[::1])",
    allocates=True,
)
def account_for(
    nav: Array,
    step: Array,
    cov: Array,
    dx: Array,
    z: Array,
    h: Array,
    r: Array,
    kept: NDArray[np.bool_],
    fused: bool,
    bank: Array,
    ints: Indices,
    numbers: Array,
    lanes: Array,
    t_ns: int,
    measures: int,
    device: int,
    found: Array,
) -> None:
    """Update the bank by rows `kept` (m,) of z (m,), h (m, n), r (m,), `fused` or not.

    `cov` (w, w) and `dx` (n,) are those before the rows. More rows than states that they measure
    are compressed, unless a kind is an offset of each of them.
    """
    rows, n = int(np.count_nonzero(kept)), dx.shape[0]
    seen = np.empty(n, dtype=np.int64)
    count, noise = states_seen(h, kept, seen), 0.0
    if count < rows and not _have_own(ints, device):
        nu, of, variance = np.empty(count), np.empty((count, n)), np.ones(count)
        noise = compress(z, h, r, kept, dx, seen[:count], nu, of)
    else:
        nu, of, variance = z[kept], h[kept], r[kept]
        take_off(nu.copy(), of, dx, nu)
    m = nu.shape[0]
    y, g = np.empty(m), np.empty((m, cov.shape[0]))
    if not whiten(cov, nu, of, variance, y, g) < np.inf:
        return
    if restarts(bank, t_ns):
        judge_what_waits(bank, ints, numbers, lanes, found)
    bank[UNWEIGHED] = np.inf
    restart_due(bank, ints, numbers, n, t_ns, nav, step)
    columns = bank[int(bank[SENSITIVITIES]) :].view(np.float32).shape[0] // n
    work = np.empty(m * columns, dtype=np.float32)
    sensitivity_rows(bank, ints, numbers, n, t_ns, measures, device, nav, of, variance, g, work)
    account(bank, n, measures, y, g, fused, rows, noise, work)
