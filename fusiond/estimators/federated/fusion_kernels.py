r"""Compiled kernels: fusion of a bank of error estimates, and redistribution.

    Y = sum w_k P_k^-1,   P_g = Y^-1,   x_g = P_g sum w_k P_k^-1 x_k

w_k is the part of its information that estimate k contributes (0: excluded). States differ by many
powers of ten and so do the estimates' covariances: each P_k is scaled to a unit diagonal before its
Cholesky decomposition, and the sum to the least sigma of each state. A scaled P_k that is not
positive definite by rounding gets the least growing addition to its diagonal that makes it so: more
uncertainty, never less.

Difference of estimate i and all others on the last b of the ordered states (position and velocity):

    d = x_i - x_o,   d^T (P_i + P_o)_bb^-1 d  ~  chi-square(b),   P_o = (Y - w_i P_i^-1)^-1

With these states last, Y - w_i P_i^-1 = L L^T gives (P_o)_bb = (L_bb L_bb^T)^-1 without the rest.

Source: paper 004, section 3; Carlson, IEEE Trans. AES 26 (1990), 517.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Of the unit diagonal: some hundred times the rounding of a 30-state decomposition.
FIRST_ADDITION = 1e-13


@compiled("b1(f8[:, ::1])")
def cholesky(a: Array) -> bool:
    """Cholesky factor U of a (n, n) with a = U^T U, in place from its upper part, lower part
    untouched; False if there is none."""
    n = a.shape[0]
    for k in range(n):
        if not a[k, k] > 0.0:
            return False
        pivot = math.sqrt(a[k, k])
        for j in range(k, n):
            a[k, j] /= pivot
        for i in range(k + 1, n):
            c = a[k, i]
            for j in range(i, n):
                a[i, j] -= c * a[k, j]
    return True


@compiled("void(f8[:, ::1], f8[:, ::1])", allocates=True)
def inverse_of_factor(upper: Array, out: Array) -> None:
    """out (n, n) <- (U^T U)^-1, from the rows of U^-T."""
    n = upper.shape[0]
    rows = np.zeros((n, n))
    for i in range(n):
        rows[i, i] = 1.0
        for k in range(i):
            c = upper[k, i]
            for j in range(k + 1):
                rows[i, j] -= c * rows[k, j]
        c = upper[i, i]
        for j in range(i + 1):
            rows[i, j] /= c
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
    for k in range(n):
        for i in range(k + 1):
            c = rows[k, i]
            for j in range(i + 1):
                out[i, j] += c * rows[k, j]
    for i in range(n):
        for j in range(i):
            out[j, i] = out[i, j]


@compiled("b1(f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[::1])")
def _scaled_information(cov: Array, order: Indices, out: Array, work: Array, sigma: Array) -> bool:
    """Write out (a, a) <- P^-1 of the states `order` of `cov`, times sigma_i sigma_j, and their
    sigmas (a,); False if P cannot be made positive definite."""
    a = order.shape[0]
    for i in range(a):
        sigma[i] = math.sqrt(cov[order[i], order[i]])
    addition = 0.0
    while addition < 1e-3:
        for i in range(a):
            for j in range(i + 1, a):
                work[i, j] = cov[order[i], order[j]] / (sigma[i] * sigma[j])
            work[i, i] = 1.0 + addition
        if cholesky(work):
            inverse_of_factor(work, out)
            return True
        addition = FIRST_ADDITION if addition == 0.0 else addition * 10.0
    return False


@compiled(
    "b1(f8[:, :, ::1], f8[:, ::1], f8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[::1],"
    "f8[:, ::1], f8[::1], f8[::1])",
    allocates=True,
)
def combine(
    covs: Array,
    dxs: Array,
    weight: Array,
    order: Indices,
    infos: Array,
    vectors: Array,
    scale: Array,
    fused: Array,
    estimate: Array,
    trace: Array,
) -> bool:
    """Fuse the estimates `dxs` (k, n), `covs` (k, width, width) with `weight` (k,) above 0.

    For the states `order` (a,) it writes the scaled information w P^-1 (k + 1, a, a) and w P^-1 x
    (k + 1, a), the last their sum, their `scale` (a,), the fused covariance (a, a) and estimate
    (a,), and each P's scaled trace. False, and void, if a covariance is not positive definite.
    """
    k, a = covs.shape[0], order.shape[0]
    work, sigma = np.empty((a, a)), np.empty((k, a))
    for i in range(a):
        scale[i] = np.inf
    for m in range(k):
        if weight[m] > 0.0:
            for i in range(a):
                if not covs[m, order[i], order[i]] > 0.0:
                    return False
            if not _scaled_information(covs[m], order, infos[m], work, sigma[m]):
                return False
            for i in range(a):
                scale[i] = min(scale[i], sigma[m, i])
    infos[k] = 0.0
    vectors[k] = 0.0
    for m in range(k):
        trace[m] = 0.0
        if weight[m] > 0.0:
            for i in range(a):
                ratio = scale[i] / sigma[m, i]
                trace[m] += 1.0 / (ratio * ratio)
                total = 0.0
                for j in range(a):
                    value = weight[m] * infos[m, i, j] * ratio * scale[j] / sigma[m, j]
                    infos[m, i, j] = value
                    infos[k, i, j] += value
                    total += value * dxs[m, order[j]] / scale[j]
                vectors[m, i] = total
                vectors[k, i] += total
    work[:] = infos[k]
    if not cholesky(work):
        return False
    inverse_of_factor(work, fused)
    for i in range(a):
        total = 0.0
        for j in range(a):
            total += fused[i, j] * vectors[k, j]
        estimate[i] = total * scale[i]
    for i in range(a):
        for j in range(a):
            fused[i, j] *= scale[i] * scale[j]
    return True


@compiled(
    "f8(f8[:, ::1], f8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[::1], i8, i8)", allocates=True
)
def difference(
    cov: Array,
    dx: Array,
    order: Indices,
    infos: Array,
    vectors: Array,
    scale: Array,
    member: int,
    tested: int,
) -> float:
    """Statistic of estimate `member` (`cov`, `dx`) against all others that `combine` has fused, on
    the last `tested` states of `order`; 0 without information of others."""
    k, a, b = infos.shape[0] - 1, order.shape[0], tested
    upper, y = np.empty((a, a)), np.empty(a)
    for i in range(a):
        for j in range(i, a):
            upper[i, j] = infos[k, i, j] - infos[member, i, j]
        y[i] = vectors[k, i] - vectors[member, i]
    if not cholesky(upper):
        return 0.0
    for i in range(a):
        y[i] /= upper[i, i]
        for j in range(i + 1, a):
            y[j] -= upper[i, j] * y[i]
    first = a - b
    for i in range(a - 1, first - 1, -1):
        for j in range(i + 1, a):
            y[i] -= upper[i, j] * y[j]
        y[i] /= upper[i, i]
    tail, s, d = np.zeros((b, b)), np.empty((b, b)), np.empty(b)
    for i in range(b):
        for j in range(i, b):
            tail[i, j] = upper[first + i, first + j]
    inverse_of_factor(tail, s)
    for i in range(b):
        unit = scale[first + i]
        d[i] = dx[order[first + i]] / unit - y[first + i]
        for j in range(b):
            s[i, j] += cov[order[first + i], order[first + j]] / (unit * scale[first + j])
    if not cholesky(s):
        return 0.0
    total = 0.0
    for i in range(b):
        d[i] /= s[i, i]
        total += d[i] * d[i]
        for j in range(i + 1, b):
            d[j] -= s[i, j] * d[i]
    return total


@compiled(
    "void(f8[:, :, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])", allocates=True
)
def carry(covs: Array, dxs: Array, shares: Array, phi: Array, before: Array, after: Array) -> None:
    """Propagate a bank over an interval with transition `phi` (width, width), in place:

        P_k <- phi (P_k - B / beta_k) phi^T + A / beta_k,   x_k <- phi x_k

    `before` B and `after` A are a covariance with the whole process noise at both ends, so that A -
    phi B phi^T is the noise of the interval.
    """
    width, n = phi.shape[0], dxs.shape[1]
    d, half, x = np.empty((width, width)), np.empty((width, width)), np.empty(n)
    for k in range(covs.shape[0]):
        part = 1.0 / shares[k]
        for i in range(n):
            for j in range(width):
                d[i, j] = covs[k, i, j] - before[i, j] * part
        # Rows of the parameters hold one or two elements.
        for i in range(n):
            x[i] = 0.0
            for j in range(width):
                half[i, j] = 0.0
            for m in range(n):
                c = phi[i, m]
                if c != 0.0:
                    x[i] += c * dxs[k, m]
                    for j in range(width):
                        half[i, j] += c * d[m, j]
        for i in range(n):
            for j in range(i + 1):
                d[i, j] = half[j, i]
                d[j, i] = half[i, j]
        # d = (phi D)^T, so that phi (phi D)^T = phi D phi^T by rows again.
        for i in range(n):
            for j in range(width):
                half[i, j] = 0.0
            for m in range(n):
                c = phi[i, m]
                if c != 0.0:
                    for j in range(width):
                        half[i, j] += c * d[m, j]
        for i in range(n):
            dxs[k, i] = x[i]
            for j in range(i + 1):
                value = 0.5 * (half[i, j] + half[j, i]) + after[i, j] * part
                covs[k, i, j] = value
                covs[k, j, i] = value


@compiled("void(f8[:, ::1], f8[::1], i8[::1], f8[:, ::1], f8[::1])")
def publish(cov: Array, dx: Array, order: Indices, fused: Array, estimate: Array) -> None:
    """Write the result of `combine` into `cov` (width, width) and `dx` (n,)."""
    for i in range(order.shape[0]):
        dx[order[i]] = estimate[i]
        for j in range(order.shape[0]):
            cov[order[i], order[j]] = fused[i, j]
