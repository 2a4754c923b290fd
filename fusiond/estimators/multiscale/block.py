r"""Blocks of M successive states: prediction from block to block, and update.

    x_(j+1) = Phi_j x_j + w_j,  var w_j = Q_j;      X = (x_1 ... x_M) the last block,
                                                    x_(M+1) ... x_(2M) the next

Each element of the next block follows from every element i of the last one. Their average,

    x_(M+l) = 1/M sum_i Phi(i -> M+l) x_i + sum_(j<M) j/M Phi(j+1 -> M+l) w_j
              + sum_(j>=M) Phi(j+1 -> M+l) w_j

is an identity (w_j enters from the elements 1 ... j). All rows pass through one mean at element M,

    m = G X,   G = 1/M [Phi(1 -> M) ... Phi(M-1 -> M)  I],
    C = G P G^T + sum_(j<M) (j/M)^2 Phi(j+1 -> M) Q_j Phi(j+1 -> M)^T

and from there on each element follows from the one before. C treats the w_j inside the last block
as independent of the errors of X. They are not: the error of x_(j+1) contains w_j as far as it has
not been measured. This is the paper's approximation, kept here: C is too small.

Mean and covariance are kept in the wavelet domain, W X and W P W^T (W for W kron I_n); a row h on
element l becomes [W_1l h ... W_Ml h].

Source: paper 001, eq. 6 to 10 and 19 to 27.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.update import update
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Window(NamedTuple):
    """Successive epochs (k): transition `phi` and noise `q` (k, n, n) from the epoch before, and
    `u` (k, n), the propagated sum of all feedback so far.

    Measurements of all epochs: z = h x + v (m,), (m, n), variances r (m,); those of epoch i are the
    rows up to ends[i]. The arrays are never changed.
    """

    phi: Array
    q: Array
    u: Array
    z: Array
    h: Array
    r: Array
    ends: Indices

    def followed_by(self, other: Window, dropped: int = 0) -> Window:
        """Epochs without the oldest, followed by those of `other`."""
        row = self.ends[dropped - 1] if dropped else 0
        join = np.concatenate
        return Window(
            join((self.phi[dropped:], other.phi)),
            join((self.q[dropped:], other.q)),
            join((self.u[dropped:], other.u)),
            join((self.z[row:], other.z)),
            join((self.h[row:], other.h)),
            join((self.r[row:], other.r)),
            join((self.ends[dropped:], other.ends + self.ends[-1])) - row,
        )

    def measured_again(self, u: Array, z: Array, h: Array, r: Array) -> Window:
        """Same epochs, the last one with further rows and a new `u` (n,)."""
        us, ends = self.u.copy(), self.ends.copy()
        us[-1] = u
        ends[-1] += len(z)
        rows = np.concatenate((self.z, z)), np.concatenate((self.h, h)), np.concatenate((self.r, r))
        return Window(self.phi, self.q, us, *rows, ends)


class Block(NamedTuple):
    """Mean (M n,) and covariance (M n, M n) of M successive states, in the wavelet domain."""

    mean: Array
    cov: Array


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", forceinline=True)
def _times(a: Array, b: Array, out: Array) -> None:
    """out = a b; zeros of a cost nothing, and half of a transition is zero."""
    out[:] = 0.0
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            c = a[i, k]
            if c != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += c * b[k, j]


@compiled("void(f8[:, ::1], f8[::1], f8[::1])", forceinline=True)
def _times_vector(a: Array, x: Array, out: Array) -> None:
    """out = a x."""
    for i in range(a.shape[0]):
        total = 0.0
        for k in range(a.shape[1]):
            total += a[i, k] * x[k]
        out[i] = total


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", allocates=True)
def _spread(phi: Array, cov: Array, q: Array) -> None:
    """cov <- phi cov phi^T + q, cov symmetric."""
    once, turned = np.empty_like(cov), np.empty_like(cov)
    _times(phi, cov, once)
    for i in range(len(cov)):
        for j in range(len(cov)):
            turned[j, i] = once[i, j]
    _times(phi, turned, once)
    for i in range(len(cov)):
        for j in range(i + 1):
            cov[i, j] = cov[j, i] = 0.5 * (once[i, j] + once[j, i] + q[i, j] + q[j, i])


@compiled("void(f8[:, ::1], f8[:, ::1])", allocates=True)
def _transform_rows(w: Array, rows: Array) -> None:
    """rows (M n, k) <- (W kron I) rows."""
    m = len(w)
    n = len(rows) // m
    old = rows.copy()
    rows[:] = 0.0
    for i in range(m):
        for k in range(m):
            c = w[i, k]
            if c != 0.0:
                for a in range(n):
                    for j in range(rows.shape[1]):
                        rows[i * n + a, j] += c * old[k * n + a, j]


@compiled(
    "void(f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1])",
    allocates=True,
)
def begin(
    w: Array, first: Array, first_cov: Array, phi: Array, q: Array, mean: Array, cov: Array
) -> None:
    """Write the block (`mean`, `cov`) whose first element has `first` (n,) and `first_cov` (n, n).

    `phi` and `q` (M - 1, n, n) lead from each element to the next. Paper 001, eq. 21 and 22.
    """
    m, n = len(w), len(first)
    here, across = first_cov.copy(), np.empty((n, n))
    mean[:n] = first
    cov[:n, :n] = here
    for e in range(1, m):
        at, before = e * n, (e - 1) * n
        _times_vector(phi[e - 1], mean[before:at], mean[at : at + n])
        # Covariance with each element before: phi times that of the last one.
        for c in range(e):
            _times(phi[e - 1], cov[before:at, c * n : (c + 1) * n].copy(), across)
            for i in range(n):
                for j in range(n):
                    cov[at + i, c * n + j] = across[i, j]
                    cov[c * n + j, at + i] = across[i, j]
        _spread(phi[e - 1], here, q[e - 1])
        cov[at : at + n, at : at + n] = here
    if m > 1:
        _transform_rows(w, mean.reshape(m * n, 1))
        _transform_rows(w, cov)
        turned = cov.T.copy()
        _transform_rows(w, turned)
        for i in range(m * n):
            for j in range(m * n):
                cov[i, j] = 0.5 * (turned[i, j] + turned[j, i])


@compiled(
    "void(f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1])",
    allocates=True,
)
def predict(
    w: Array, last: Array, last_cov: Array, phi: Array, q: Array, mean: Array, cov: Array
) -> None:
    """Write the block (`mean`, `cov`) after the block (`last`, `last_cov`).

    `phi` and `q` (2M - 1, n, n) lead from each of the 2M elements to the next. Paper 001, eq. 8, 9,
    24 and 25.
    """
    m = len(w)
    n = len(last) // m
    g = np.zeros((n, m * n))  # G, then G W^T
    part = np.zeros((n, n))
    for i in range(n):
        part[i, i] = 1.0 / m
    g[:, (m - 1) * n :] = part
    for e in range(m - 2, -1, -1):
        _times(part.copy(), phi[e], part)
        g[:, e * n : (e + 1) * n] = part
    if m > 1:
        turned = g.T.copy()
        _transform_rows(w, turned)
        g[:] = turned.T
    inner = np.zeros((n, n))
    for e in range(m - 1):
        _spread(phi[e], inner, ((e + 1) / m) ** 2 * q[e])
    middle = np.empty(n)
    _times_vector(g, last, middle)
    once, here = np.empty((n, m * n)), np.empty((n, n))
    _times(g, last_cov, once)
    _times(g, once.T.copy(), here)
    here += inner
    first = np.empty(n)
    _times_vector(phi[m - 1], middle, first)
    _spread(phi[m - 1], here, q[m - 1])
    begin(w, first, here, phi[m:], q[m:], mean, cov)


@compiled("f8[:, ::1](f8[:, ::1], i8, f8[:, ::1])", allocates=True)
def rows_on(w: Array, element: int, h: Array) -> Array:
    """Rows h (m, n) on an element (from 0) as rows (m, M n) on the transformed block."""
    n = h.shape[1]
    rows = np.empty((h.shape[0], len(w) * n))
    for i in range(h.shape[0]):
        for k in range(len(w)):
            for j in range(n):
                rows[i, k * n + j] = w[k, element] * h[i, j]
    return rows


@compiled(
    "void(f8[:, ::1], f8[::1], f8[:, ::1], i8, i8, i8, f8[::1], f8[:, ::1], f8[::1], i8[::1])"
)
def fold(
    w: Array,
    mean: Array,
    cov: Array,
    element: int,
    first: int,
    end: int,
    z: Array,
    h: Array,
    r: Array,
    ends: Indices,
) -> None:
    """Update a block in place with the epochs first ... end - 1 of a window, the first of which is
    the block's `element`.

    Paper 001, eq. 23, 26 and 27, one row after another.
    """
    for e in range(first, end):
        a, b = ends[e - 1] if e else 0, ends[e]
        update(cov, mean, z[a:b], rows_on(w, element + e - first, h[a:b]), r[a:b])


@compiled("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])", allocates=True)
def newest(w: Array, mean: Array, cov: Array, last: Array, last_cov: Array) -> None:
    """Write `last` (n,) and `last_cov` (n, n) of the last element, out of the wavelet domain."""
    m, n = len(w), len(last)
    last[:] = 0.0
    across = np.zeros((n, m * n))
    for k in range(m):
        c = w[k, m - 1]
        for i in range(n):
            last[i] += c * mean[k * n + i]
            for j in range(m * n):
                across[i, j] += c * cov[k * n + i, j]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(m):
                total += across[i, k * n + j] * w[k, m - 1]
            last_cov[i, j] = total
    for i in range(n):
        for j in range(i):
            last_cov[i, j] = last_cov[j, i] = 0.5 * (last_cov[i, j] + last_cov[j, i])


@compiled(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[::1], f8[:, ::1], i8[::1], f8[:, ::1])",
    allocates=True,
)
def rebase(w: Array, phi: Array, u: Array, z: Array, h: Array, ends: Indices, means: Array) -> None:
    """Subtract the oldest epoch's `u` from `u`, `z` and the blocks' `means` (M, M n), in place.

    t_(j+1) = Phi_j t_j solves the states' own equation, so t may be subtracted from all. With t
    from u of the oldest epoch only the window's own corrections are left, and no number grows with
    time. means[i] begins at epoch i.
    """
    m, n = len(w), u.shape[1]
    t = np.zeros(u.shape)
    t[0] = u[0]
    for e in range(1, len(u)):
        _times_vector(phi[e], t[e - 1], t[e])
    for e in range(len(u)):
        for row in range(ends[e - 1] if e else 0, ends[e]):
            for i in range(n):
                z[row] -= h[row, i] * t[e, i]
    u -= t
    for b in range(m):
        for k in range(m):
            for e in range(m):
                for i in range(n):
                    means[b, k * n + i] -= w[k, e] * t[b + e, i]
