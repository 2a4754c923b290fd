r"""Compiled kernel: update with many rows of which some may be wrong (pseudoranges).

Each row is judged twice, both times against a chi-square quantile with one degree of freedom:

    before   nu^2 / (h P h^T + r)                      its own gate, whatever the others say
    after    v^2 / (r - h P+ h^T),  v = z - h dx+      the residual test of the update

The residual's variance follows from v = (I - H K) nu; its square over that variance is the
statistic of leaving the row out (Teunissen, Testing Theory, 2006, section 4.4: the w-test). While
the largest fails, that row goes and the update is made anew from the rest. The order of the rows
does not matter. A judgement looks at no more of P than the states of its row: seven of some thirty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

# What became of a row.
KEPT, GATED, RESIDUAL = 0, 1, 2
# A residual whose variance is this small a part of r tells nothing: the row alone determines a
# state.
_DETERMINED = 1e-6
# Ranges that must fail together before the receiver's clock is to blame, not as many satellites.
FEWEST_JUMPING = 3


@compiled("UniTuple(f8, 2)(f8[:, ::1], f8[::1], f8, f8[:, ::1], i8, i8[:, ::1], i8)")
def _seen(
    cov: Array, dx: Array, z: float, h: Array, a: int, columns: Codes, count: int
) -> tuple[float, float]:
    """z - h dx and h P h^T of row `a` of h (m, n), whose `columns` (m, n) are the first `count`."""
    variance = 0.0
    for p in range(count):
        i = columns[a, p]
        c, along = h[a, i], 0.0
        for q in range(count):
            along += h[a, columns[a, q]] * cov[i, columns[a, q]]
        z -= c * dx[i]
        variance += c * along
    return z, variance


@compiled(
    "f8(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, i8[::1], f8[::1], f8[:, ::1],"
    "f8[::1])",
    allocates=True,
)
def screened_update(
    cov: Array,
    dx: Array,
    z: Array,
    h: Array,
    r: Array,
    threshold: float,
    codes: Codes,
    y: Array,
    cov_out: Array,
    dx_out: Array,
) -> float:
    """Fold the rows z = h dx + noise (variances r) that pass into `cov_out` and `dx_out`.

    cov and cov_out (w, w), dx and dx_out (n,), z, r, y (m,), h (m, n). `codes` (m,) says what
    became of each row; rows not KEPT at the call are left out from the start. y[a] is left as the
    whitened innovation of a kept row, 0 otherwise. Returns the sum of their squares, nu^T S^-1 nu.
    """
    m, n = h.shape
    width = cov.shape[1]
    columns = np.empty((m, n), dtype=np.int64)
    counts = np.zeros(m, dtype=np.int64)
    for a in range(m):
        for i in range(n):
            if h[a, i] != 0.0:
                columns[a, counts[a]] = i
                counts[a] += 1
    for a in range(m):
        innovation, s = _seen(cov, dx, z[a], h, a, columns, counts[a])
        if codes[a] == KEPT and not innovation * innovation <= threshold * (s + r[a]):
            codes[a] = GATED
    g = np.empty(width)
    while True:
        cov_out[:] = cov
        dx_out[:] = dx
        nis = 0.0
        for a in range(m):
            y[a] = 0.0
            if codes[a] != KEPT:
                continue
            g[:] = 0.0
            innovation, s = z[a], r[a]
            for p in range(counts[a]):
                i = columns[a, p]
                c = h[a, i]
                innovation -= c * dx_out[i]
                for j in range(width):
                    g[j] += c * cov_out[i, j]
            for p in range(counts[a]):
                s += h[a, columns[a, p]] * g[columns[a, p]]
            # As in fusiond.estimators.update, row after row.
            root = np.sqrt(s)
            y[a] = innovation / root
            nis += y[a] * y[a]
            for j in range(width):
                g[j] /= root
            for i in range(n):
                c = g[i]
                dx_out[i] += c * y[a]
                for j in range(width):
                    cov_out[i, j] -= c * g[j]
        worst, greatest = -1, threshold
        for a in range(m):
            if codes[a] != KEPT:
                continue
            residual, s = _seen(cov_out, dx_out, z[a], h, a, columns, counts[a])
            variance = r[a] - s
            if variance > _DETERMINED * r[a] and residual * residual > greatest * variance:
                worst, greatest = a, residual * residual / variance
        if worst < 0:
            return nis
        codes[worst] = RESIDUAL


def jumped(codes: Codes, of_clock: Array) -> bool:
    """Whether the better half of the ranges fails; of the rows, `codes` (m,) and what they have of
    the clock's offsets (m, k)."""
    if np.count_nonzero(codes != KEPT) < FEWEST_JUMPING:
        return False
    # One in a range, nothing in a rate: nothing up to the rounding of sigma points.
    ranges = (np.abs(of_clock) > 0.5).any(axis=1)
    lost = np.count_nonzero(codes[ranges] != KEPT)
    return bool(lost >= FEWEST_JUMPING and 2 * lost > np.count_nonzero(ranges))
