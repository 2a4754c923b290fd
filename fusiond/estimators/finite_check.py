"""Check after every tick that a filter is finite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]


@compiled("i8(f8[::1], f8[::1], f8[:, :])")
def first_not_finite(nav: Array, xi: Array, p: Array) -> int:
    """Index of the first part that is not finite: 0 nav (10,), 1 xi (n,), 2 the diagonal of P (n,
    n); -1 for none."""
    for i in range(nav.shape[0]):
        if not np.isfinite(nav[i]):
            return 0
    for i in range(xi.shape[0]):
        if not np.isfinite(xi[i]):
            return 1
    for i in range(p.shape[0]):
        if not np.isfinite(p[i, i]):
            return 2
    return -1
