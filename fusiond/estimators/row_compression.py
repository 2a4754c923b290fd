r"""Compiled kernel: many measurement rows as no more than they measure states.

Rows z = H x + v (m,) with variances r that measure q < m of the states x. With the weights
W = diag(1 / sqrt(r)) and W H = Q [U; 0] by Householder reflections, Q orthogonal and U (q, q),

    Q^T W z = [z'; z'']     z' = U x + v',  z'' = v''     v', v'' white, of unit variance

so that z' tells all that z does of x, and z'' is noise alone: nu^T S^-1 nu of z is that of z' and
z''^T z''.

Source: Bierman, Factorization Methods (1977), section IV.2; Golub, Van Loan, Matrix Computations,
4th ed., section 5.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled("i8(f8[:, ::1], b1[::1], i8[::1])")
def states_seen(h: Array, kept: NDArray[np.bool_], seen: Indices) -> int:
    """Write the states that rows `kept` (m,) of h (m, n) measure to `seen` (n,); their number."""
    m, n = h.shape
    for i in range(n):
        seen[i] = 0
    for a in range(m):
        if kept[a]:
            for i in range(n):
                seen[i] |= h[a, i] != 0.0
    count = 0
    for i in range(n):
        if seen[i]:
            seen[count] = i
            count += 1
    return count


@compiled("f8(f8[:, ::1], i8)", allocates=True)
def triangular(a: Array, q: int) -> float:
    """Reflect the first q columns of a (m, p) to zeros below the diagonal, in place; the sum of
    squares of the last column below row q."""
    m, p = a.shape
    along = np.empty(p)
    for k in range(q):
        square = 0.0
        for i in range(k, m):
            square += a[i, k] * a[i, k]
        if square == 0.0:
            continue
        root = -math.copysign(math.sqrt(square), a[k, k])
        scale = 1.0 / (square - root * a[k, k])
        a[k, k] -= root
        sums = along[k + 1 :]
        for j in range(sums.shape[0]):
            sums[j] = 0.0
        for i in range(k, m):
            v = a[i, k]
            if v != 0.0:
                row = a[i, k + 1 :]
                for j in range(row.shape[0]):
                    sums[j] += v * row[j]
        for j in range(sums.shape[0]):
            sums[j] *= scale
        for i in range(k, m):
            v = a[i, k]
            if v != 0.0:
                row = a[i, k + 1 :]
                for j in range(row.shape[0]):
                    row[j] -= v * sums[j]
                a[i, k] = 0.0
        a[k, k] = root
    left = 0.0
    for i in range(q, m):
        left += a[i, p - 1] * a[i, p - 1]
    return left


@compiled(
    "f8(f8[::1], f8[:, ::1], f8[::1], b1[::1], f8[::1], i8[::1], f8[::1], f8[:, ::1])",
    allocates=True,
)
def compress(
    z: Array,
    h: Array,
    r: Array,
    kept: NDArray[np.bool_],
    dx: Array,
    seen: Indices,
    z_out: Array,
    h_out: Array,
) -> float:
    """Write z' (q,) and U as rows of all states (q, n); z''^T z''.

    Of rows `kept` (m,) of z - H dx, at least q of them, that measure the states `seen` (q,)."""
    m, n, count, at = h.shape[0], h.shape[1], seen.shape[0], 0
    a = np.empty((m, count + 1))
    for b in range(m):
        if not kept[b]:
            continue
        left, over = z[b], 1.0 / math.sqrt(r[b])
        for i in range(count):
            left -= h[b, seen[i]] * dx[seen[i]]
            a[at, i] = h[b, seen[i]] * over
        a[at, count] = left * over
        at += 1
    noise: float = triangular(a[:at], count)
    for k in range(count):
        z_out[k] = a[k, count]
        for i in range(n):
            h_out[k, i] = 0.0
        for i in range(count):
            h_out[k, seen[i]] = a[k, i]
    return noise
