r"""Compiled kernel: update with many rows of which some may be wrong (pseudoranges).

Each row is judged twice, both times against a chi-square quantile with one degree of freedom:

    before   nu^2 / (h P h^T + r)                      its own gate, whatever the others say
    after    v^2 / (r - h P+ h^T),  v = z - h dx+      the residual test of the update

The residual's variance follows from v = (I - H K) nu; its square over that variance is the
statistic of leaving the row out (Teunissen, Testing Theory, 2006, section 4.4: the w-test). While
the largest fails, that row goes and the update is made anew from the rest. The order of the rows
does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

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

    cov and cov_out (w, w) symmetric, dx and dx_out (n,), z, r, y (m,), h (m, n). `codes` (m,) says
    what became of each row; rows not KEPT at the call are left out from the start. y[a] is left as
    the whitened innovation of a kept row, 0 otherwise. Returns the sum of their squares,
    nu^T S^-1 nu.
    """
    m, n = h.shape
    width = cov.shape[0]
    columns, values = np.empty((m, n), dtype=np.int64), np.empty((m, n))
    counts = np.zeros(m, dtype=np.int64)
    for a in range(m):
        for i in range(n):
            if h[a, i] != 0.0:
                columns[a, counts[a]] = i
                values[a, counts[a]] = h[a, i]
                counts[a] += 1
    for a in range(m):
        innovation, s = z[a], r[a]
        for p in range(counts[a]):
            i, c = columns[a, p], values[a, p]
            innovation -= c * dx[i]
            half = 0.5 * c * cov[i, i]
            for q in range(p):
                half += values[a, q] * cov[i, columns[a, q]]
            s += 2.0 * c * half
        if codes[a] == KEPT and not innovation * innovation <= threshold * s:
            codes[a] = GATED
    u = np.empty(width)
    while True:
        cov_out[:] = cov
        dx_out[:] = dx
        nis = 0.0
        for a in range(m):
            y[a] = 0.0
            if codes[a] != KEPT:
                continue
            u[:] = 0.0
            innovation = z[a]
            for p in range(counts[a]):
                i, c = columns[a, p], values[a, p]
                innovation -= c * dx_out[i]
                for j in range(width):
                    u[j] += c * cov_out[i, j]
            s, hk = r[a], 0.0
            for p in range(counts[a]):
                s += values[a, p] * u[columns[a, p]]
            for p in range(counts[a]):
                hk += values[a, p] * (u[columns[a, p]] / s)
            y[a] = innovation / math.sqrt(s)
            nis += y[a] * y[a]
            gain = innovation / s
            for i in range(n):
                dx_out[i] += u[i] * gain
            # Joseph form of one row, as in fusiond.estimators.update, with the gain u / s: what it
            # takes away is (1 + ((1 - h k) s - r) / s) u u^T / s, a square of its root.
            root = math.sqrt((1.0 + ((1.0 - hk) * s - r[a]) / s) / s)
            for i in range(width):
                u[i] *= root
            for i in range(n):
                for j in range(width):
                    cov_out[i, j] -= u[i] * u[j]
        worst, greatest = -1, threshold
        for a in range(m):
            if codes[a] != KEPT:
                continue
            residual, variance = z[a], r[a]
            for p in range(counts[a]):
                i, c = columns[a, p], values[a, p]
                residual -= c * dx_out[i]
                half = 0.5 * c * cov_out[i, i]
                for q in range(p):
                    half += values[a, q] * cov_out[i, columns[a, q]]
                variance -= 2.0 * c * half
            if variance > _DETERMINED * r[a] and residual * residual > greatest * variance:
                worst, greatest = a, residual * residual / variance
        if worst < 0:
            return nis
        codes[worst] = RESIDUAL


def jumped(codes: Codes, h: Array, offsets: Sequence[int]) -> bool:
    """Whether the better half of the ranges fails; of the rows, `codes` (m,) and `h` (m, n), with
    the slots of the clock's offsets."""
    if np.count_nonzero(codes) < FEWEST_JUMPING:  # KEPT is 0
        return False
    # One in a range, nothing in a rate: nothing up to the rounding of sigma points.
    ranges = (np.abs(h[:, offsets]) > 0.5).any(axis=1)
    lost = np.count_nonzero(codes[ranges])
    return bool(lost >= FEWEST_JUMPING and 2 * lost > np.count_nonzero(ranges))
