"""Compiled kernels: sums of rows of sensitivities V, several in one pass.

For fusiond.estimators.fault_bank, in single precision. One pass adds in the order of the rows, so
that the sums equal those row by row, bit for bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Indices = NDArray[np.int64]


@compiled("void(f4[::1], i8, i8, i8[::1], i8, f8[::1], f4[::1])")
def add_rows(
    v: Single, columns: int, first: int, of: Indices, count: int, c: Array, out: Single
) -> None:
    """Add c (n,) times V to `out`, from column `first` on: the `count` rows with c not zero, listed
    in `of`, four in one pass."""
    at = 0
    while at < count:
        more = at + 4 <= count
        i_0 = of[at]
        v_0, c_0 = v[i_0 * columns + first :], np.float32(c[i_0])
        if more:
            i_1, i_2, i_3 = of[at + 1], of[at + 2], of[at + 3]
            v_1, c_1 = v[i_1 * columns + first :], np.float32(c[i_1])
            v_2, c_2 = v[i_2 * columns + first :], np.float32(c[i_2])
            v_3, c_3 = v[i_3 * columns + first :], np.float32(c[i_3])
            for j in range(out.shape[0]):
                out[j] += c_0 * v_0[j] + c_1 * v_1[j] + c_2 * v_2[j] + c_3 * v_3[j]
            at += 4
        else:
            for j in range(out.shape[0]):
                out[j] += c_0 * v_0[j]
            at += 1


@compiled("void(f8[:, ::1], f8[:, ::1], i8, i8, f4[::1])")
def take_off_before(h: Array, g: Array, a: int, columns: int, work: Single) -> None:
    """Subtract from row `a` of `work` its part in common with the rows before, as `whiten` does;
    four rows in one pass."""
    s, n, b = work[a * columns : (a + 1) * columns], h.shape[1], 0
    while b < a:
        s_0, c_0 = work[b * columns : (b + 1) * columns], 0.0
        if b + 4 <= a:
            s_1 = work[(b + 1) * columns : (b + 2) * columns]
            s_2 = work[(b + 2) * columns : (b + 3) * columns]
            s_3 = work[(b + 3) * columns : (b + 4) * columns]
            c_1 = c_2 = c_3 = 0.0
            for i in range(n):
                c = h[a, i]
                if c != 0.0:
                    c_0 += c * g[b, i]
                    c_1 += c * g[b + 1, i]
                    c_2 += c * g[b + 2, i]
                    c_3 += c * g[b + 3, i]
            l_0, l_1, l_2, l_3 = np.float32(c_0), np.float32(c_1), np.float32(c_2), np.float32(c_3)
            for j in range(s.shape[0]):
                s[j] = s[j] - l_0 * s_0[j] - l_1 * s_1[j] - l_2 * s_2[j] - l_3 * s_3[j]
            b += 4
        else:
            for i in range(n):
                if h[a, i] != 0.0:
                    c_0 += h[a, i] * g[b, i]
            l_0 = np.float32(c_0)
            for j in range(s.shape[0]):
                s[j] -= l_0 * s_0[j]
            b += 1


@compiled("void(f4[::1], i8, f8[:, ::1], i8, f4[::1])")
def fold_in_sensitivities(v: Single, n: int, g: Array, columns: int, work: Single) -> None:
    """Update V <- V - g^T s, by three rows at a time or one, six in one pass."""
    at, m = 0, g.shape[0]
    while at < m:
        s_0 = work[at * columns : (at + 1) * columns]
        if at + 6 <= m:
            s_1 = work[(at + 1) * columns : (at + 2) * columns]
            s_2 = work[(at + 2) * columns : (at + 3) * columns]
            s_3 = work[(at + 3) * columns : (at + 4) * columns]
            s_4 = work[(at + 4) * columns : (at + 5) * columns]
            s_5 = work[(at + 5) * columns : (at + 6) * columns]
            for i in range(n):
                c_0, c_1 = np.float32(g[at, i]), np.float32(g[at + 1, i])
                c_2, c_3 = np.float32(g[at + 2, i]), np.float32(g[at + 3, i])
                c_4, c_5 = np.float32(g[at + 4, i]), np.float32(g[at + 5, i])
                if c_0 == c_1 == c_2 == c_3 == c_4 == c_5 == 0.0:
                    continue
                row = v[i * columns : (i + 1) * columns]
                for j in range(row.shape[0]):
                    x = row[j] - (c_0 * s_0[j] + c_1 * s_1[j] + c_2 * s_2[j])
                    row[j] = x - (c_3 * s_3[j] + c_4 * s_4[j] + c_5 * s_5[j])
            at += 6
        elif at + 3 <= m:
            s_1 = work[(at + 1) * columns : (at + 2) * columns]
            s_2 = work[(at + 2) * columns : (at + 3) * columns]
            for i in range(n):
                c_0, c_1 = np.float32(g[at, i]), np.float32(g[at + 1, i])
                c_2 = np.float32(g[at + 2, i])
                if c_0 == 0.0 and c_1 == 0.0 and c_2 == 0.0:
                    continue
                row = v[i * columns : (i + 1) * columns]
                for j in range(row.shape[0]):
                    row[j] -= c_0 * s_0[j] + c_1 * s_1[j] + c_2 * s_2[j]
            at += 3
        else:
            for i in range(n):
                c_0 = np.float32(g[at, i])
                if c_0 != 0.0:
                    row = v[i * columns : (i + 1) * columns]
                    for j in range(row.shape[0]):
                        row[j] -= c_0 * s_0[j]
            at += 1
