"""State of a filter in one array, and the model's description for the kernels.

A call of a compiled kernel costs 25 ns an argument, so `fusiond.estimators.propagation` takes this
array, the IMU buffer's, and only the values that differ from call to call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance_propagation import KEPT, work_size
from fusiond.estimators.fault_bank import FaultTable, bank_size, begin_bank
from fusiond.estimators.multi_sample_covariance import SUMS
from fusiond.estimators.published_state import WIDER, Published
from fusiond.estimators.sigmas_between_covariance_steps import SIZE as BETWEEN
from fusiond.estimators.tilt_axes_propagation import TURN_SIZE
from fusiond.models.model import Model
from fusiond.navigation.error_model import COEFFICIENTS
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE

Array = NDArray[np.float64]

LINE_BYTES, LINE = 64, 8
"""A line of the cache, in bytes and in doubles."""


def line_after(doubles: int) -> int:
    """Offset of the next line."""
    return doubles + -doubles % LINE


SIZE, ROOM, USED, RECORDED, TRANSITION, GAP, AHEAD, BANK = range(8)
"""Header of the array, a line of int64: states; covariances, and error estimates, that there is
room for; how many covariances are propagated, from the first on; of which one sigmas are recorded;
1 if there is a transition matrix; ns beyond which no sample may stand; 1 if covariances are ahead
of those that are held, by what has been added up; doubles of the bank of hypotheses."""
PUBLISHED_AT = LINE
WIDER_AT = PUBLISHED_AT + len(Published._fields)
NAV_AT = line_after(WIDER_AT + WIDER)
STEP_AT, SUMS_AT = NAV_AT + NAV_SIZE, NAV_AT + NAV_SIZE + STEP_SIZE
XI_AT = SUMS_AT + SUMS
"""Layout of the following array, in doubles: then parameters and error estimates, and from the next
cache line covariances and the bank. A snapshot copies all from `WIDER_AT` on."""


def scratch_size(width: int) -> int:
    """Doubles of scratch for a row width, whole lines: what covariances need, then `propagate`."""
    own = COEFFICIENTS + 24 + TURN_SIZE + BETWEEN + KEPT + 2 * width
    return line_after(work_size(width) + own)


class Memory(NamedTuple):
    """State array with its parts for Python: `head` (8,) as above; variances (9,) by which the
    published solution is `wider`, `Published` (3,); the part `kept` by a snapshot: `wider`, nav
    (10,), the last step (28,), the `sums` (25,) of fusiond.estimators.multi_sample_covariance, `xi`
    (n,), `dxs` (k, n), `covs` (k, width, width), the `bank` of fusiond.estimators.fault_bank;
    covariances before the accumulated interval, flat, `held`; `phi` (width, width) or (0, 0);
    `work` for kernels that propagate a covariance; `shares` (k,)."""

    array: Array
    head: NDArray[np.int64]
    wider: Array
    published: Array
    kept: Array
    nav: Array
    step: Array
    sums: Array
    xi: Array
    dxs: Array
    covs: Array
    bank: Array
    held: Array
    phi: Array
    work: Array
    shares: Array


def memory(
    model: Model, gap_ns: int, shares: tuple[float, ...], transition: bool, faults: FaultTable
) -> Memory:
    """Memory for filters with these k shares of the noise; `phi` if a `transition` is requested.
    Long rows of matrices are aligned to cache lines."""
    n, width, k = model.size, model.width, len(shares)
    side = width if transition else 0
    square, scratch = k * width * width, scratch_size(width)
    hypotheses = bank_size(faults, n, width)
    first = line_after(XI_AT + n + k * n)
    total = first + 2 * square + hypotheses + side * side + scratch + k + model.packed.size
    lines = np.zeros(total + LINE)
    begin = -lines.ctypes.data % LINE_BYTES // 8
    array = lines[begin : begin + total]
    sizes = (square, hypotheses, square, side * side, scratch, k)
    covs, bank, held, phi, work, factors, of_model = np.split(array[first:], np.cumsum(sizes))
    factors[:], of_model[:] = shares, model.packed
    head = array[:LINE].view(np.int64)
    head[[SIZE, ROOM, USED, TRANSITION, GAP, BANK]] = n, k, k, transition, gap_ns, hypotheses
    begin_bank(bank, faults, n, width)
    return Memory(
        array,
        head,
        array[WIDER_AT : WIDER_AT + WIDER],
        array[PUBLISHED_AT:WIDER_AT],
        array[WIDER_AT : first + square + hypotheses],
        array[NAV_AT:STEP_AT],
        array[STEP_AT:SUMS_AT],
        array[SUMS_AT:XI_AT],
        array[XI_AT : XI_AT + n],
        array[XI_AT + n : XI_AT + n + k * n].reshape(k, n),
        covs.reshape(k, width, width),
        bank,
        held,
        phi.reshape(side, side),
        work[: work_size(width)],
        factors,
    )
