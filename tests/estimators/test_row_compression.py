"""Many rows as no more than they measure states: the same information, the same bank."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import E_ROWS, J_AT, L_ROWS, N_AT, OTHER
from fusiond.estimators.fault_bank_interface import Hypotheses
from fusiond.estimators.fault_update import account, sensitivity_rows
from fusiond.estimators.fault_update_by_rows import account_for
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.row_compression import compress, states_seen
from fusiond.estimators.update import whiten, work
from tests.estimators.fault_bank_drive import LAST_NS, MODEL, run

Array = NDArray[np.float64]

SEEN = [0, 1, 2, 6, 7, 8, 12]
DX = np.linspace(-1.0, 1.0, MODEL.size)


def rows_of(count: int, rank: int) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Rows z, H, r of variances over seven decades that measure `SEEN` by `rank` combinations, half
    of them one state less; every fifth is left out."""
    rng = np.random.default_rng(3)
    h = np.zeros((count, MODEL.size))
    h[:, SEEN] = rng.standard_normal((count, rank)) @ rng.standard_normal((rank, len(SEEN)))
    h[: count // 2, SEEN[0]] = 0.0
    r = 10.0 ** rng.uniform(-4.0, 3.0, count)
    z = np.sqrt(r) * rng.standard_normal(count) + h @ rng.standard_normal(MODEL.size)
    return z, h, r, np.arange(count) % 5 != 4


@pytest.mark.parametrize("rank", [1, 4, 7])
def test_compressed_rows_tell_the_same(rank: int) -> None:
    """H^T R^-1 H, H^T R^-1 nu and nu^T R^-1 nu, also of rows that measure fewer combinations than
    states."""
    z, h, r, kept = rows_of(60, rank)
    seen = np.empty(MODEL.size, dtype=np.int64)
    count = states_seen(h, kept, seen)
    assert seen[:count].tolist() == SEEN
    short_z, short_h = np.empty(count), np.empty((count, MODEL.size))
    noise = compress(z, h, r, kept, DX, seen[:count].copy(), short_z, short_h)
    nu, h, r = (z - h @ DX)[kept], h[kept], r[kept]
    information, told = h.T @ (h / r[:, None]), h.T @ (nu / r)
    assert short_h.T @ short_h == pytest.approx(information, abs=1e-13 * information.max())
    assert short_h.T @ short_z == pytest.approx(told, abs=1e-13 * np.abs(told).max())
    assert noise + short_z @ short_z == pytest.approx(np.sum(nu * nu / r), rel=1e-13)


def filters() -> tuple[KalmanEstimator, Hypotheses]:
    made = run("velocity", np.array([0.4, -0.2, 0.0]))
    assert made.hypotheses is not None
    made.hypotheses.conclude()
    return made, made.hypotheses


def numbers_of(bank: Hypotheses) -> list[Array]:
    """J, N, L and e of all groups, and V."""
    which = J_AT, N_AT, *np.unique(L_ROWS).tolist(), *E_ROWS.tolist()
    return [*(bank.each(int(each)) for each in which), bank.sensitivities.astype(np.float64)]


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("count", [60, 8])
def test_a_bank_takes_many_rows_as_one_by_one(count: int, fused: bool) -> None:
    """To single precision, in which V is: more rows than states, and fewer."""
    z, h, r, kept = rows_of(count, 7)
    one_by_one, own = filters()
    before = numbers_of(own)
    some, h_some, r_some = (z - h @ DX)[kept], h[kept], r[kept]
    y, g = work(len(some), MODEL.width)
    assert whiten(one_by_one._cov, some, h_some, r_some, y, g) < np.inf
    space = np.empty(len(y) * own.columns, dtype=np.float32)
    of = own.bank, own.table.ints, own.table.numbers, MODEL.size
    sensitivity_rows(*of, LAST_NS, OTHER, -1, one_by_one.nav, h_some, r_some, g, space)
    account(own.bank, MODEL.size, OTHER, y, g, fused, len(y), 0.0, space)
    together, bank = filters()
    of_filter = together.nav, together.step, together._cov, DX, z, h, r, kept, fused
    table = bank.table
    of_bank = bank.bank, table.ints, table.numbers, table.lanes
    account_for(*of_filter, *of_bank, LAST_NS, OTHER, -1, bank.found)
    changed = 0
    for was, alone, found in zip(before, numbers_of(own), numbers_of(bank), strict=True):
        assert found == pytest.approx(alone, abs=2e-5 * float(np.abs(alone).max()))
        changed += not np.array_equal(was, alone)
    assert changed == len(before) - (not fused)
