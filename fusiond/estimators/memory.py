"""All that a filter keeps of its state in one array, and what its model is for the kernels.

A call of a compiled kernel costs 25 ns an argument, so `fusiond.estimators.propagation` takes this
array and the IMU buffer's, and what differs from call to call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance import KEPT, work_size
from fusiond.estimators.crossing import SUMS
from fusiond.estimators.reading import WIDER, Published
from fusiond.estimators.turned_axes import TURN_SIZE
from fusiond.models.model import Model
from fusiond.navigation.error_model import COEFFICIENTS
from fusiond.navigation.strapdown import NAV_SIZE, STEP_SIZE

Array = NDArray[np.float64]

LINE_BYTES, LINE = 64, 8
"""A line of the cache, in bytes and in doubles."""

SIZE, ROOM, USED, RECORDED, TRANSITION, GAP, AHEAD = range(7)
"""What the array begins with, a line of int64: states; covariances, and error estimates, that there
is room for; how many covariances are propagated, from the first on; of which one sigmas are
recorded; 1 if there is a transition matrix; ns beyond which no sample may stand; 1 if covariances
are ahead of those that are held, by what has been added up."""
NAV_AT, STEP_AT = LINE, LINE + NAV_SIZE
WIDER_AT, PUBLISHED_AT = STEP_AT + STEP_SIZE, STEP_AT + STEP_SIZE + WIDER
SUMS_AT = PUBLISHED_AT + len(Published._fields)
SCRATCH_AT = SUMS_AT + SUMS
SCRATCH_AT += -SCRATCH_AT % LINE
"""What lies where behind it, in doubles; the scratch begins a line."""


def scratch_size(width: int) -> int:
    """Doubles of scratch for a row width, whole lines: what covariances need, then `propagate`."""
    size = work_size(width) + COEFFICIENTS + 24 + TURN_SIZE + KEPT + 2 * width
    return size + -size % LINE


class Memory(NamedTuple):
    """`array` and the parts of it that are written from Python: `head` (8,) as above, nav (10,),
    the last step (28,), the variances (9,) that what is published is `wider` by, `Published` (3,),
    the `sums` (25,) of fusiond.estimators.crossing, `work` for kernels that propagate a covariance,
    `covs` (k, width, width) and how they were before what has been added up, `held`, `phi` (width,
    width) or (0, 0), `xi` (n,), `dxs` (k, n), `shares` (k,)."""

    array: Array
    head: NDArray[np.int64]
    nav: Array
    step: Array
    wider: Array
    published: Array
    sums: Array
    work: Array
    covs: Array
    held: Array
    phi: Array
    xi: Array
    dxs: Array
    shares: Array


def memory(model: Model, gap_ns: int, shares: tuple[float, ...], transition: bool) -> Memory:
    """For filters of these shares of the noise, k of them; `phi` where a `transition` is asked
    for. Rows of matrices begin lines where they are as long as some: they are then read and written
    by whole ones."""
    n, width, k = model.size, model.width, len(shares)
    side = width if transition else 0
    sizes = (k * width * width, k * width * width, side * side, n, k * n, k, model.packed.size)
    first = SCRATCH_AT + scratch_size(width)
    total = first + sum(sizes)
    lines = np.zeros(total + LINE)
    begin = -lines.ctypes.data % LINE_BYTES // 8
    array = lines[begin : begin + total]
    covs, held, phi, xi, dxs, factors, of_model = np.split(array[first:], np.cumsum(sizes)[:-1])
    factors[:], of_model[:] = shares, model.packed
    head = array[:LINE].view(np.int64)
    head[[SIZE, ROOM, USED, TRANSITION, GAP]] = n, k, k, transition, gap_ns
    return Memory(
        array,
        head,
        array[NAV_AT:STEP_AT],
        array[STEP_AT:WIDER_AT],
        array[WIDER_AT:PUBLISHED_AT],
        array[PUBLISHED_AT : PUBLISHED_AT + len(Published._fields)],
        array[SUMS_AT : SUMS_AT + SUMS],
        array[SCRATCH_AT : SCRATCH_AT + work_size(width)],
        covs.reshape(k, width, width),
        held.reshape(k, width, width),
        phi.reshape(side, side),
        xi,
        dxs.reshape(k, n),
        factors,
    )
