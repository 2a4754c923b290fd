r"""Compiled kernels: a bank of error estimates with covariances, fused and shared out again.

    Y = sum w_k P_k^-1,   P_g = Y^-1,   x_g = P_g sum w_k P_k^-1 x_k

w_k is the part of its information that estimate k puts in (0: left out). States differ by many
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
    """a (n, n) <- its lower factor, in place, upper part untouched; False if there is none."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = a[i, j]
            for k in range(j):
                value -= a[i, k] * a[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                a[i, i] = math.sqrt(value)
            else:
                a[i, j] = value / a[j, j]
    return True


@compiled("void(f8[:, ::1], f8[:, ::1])")
def inverse_of_factor(lower: Array, out: Array) -> None:
    """out (n, n) <- (L L^T)^-1; the upper part of `lower` is overwritten."""
    n = lower.shape[0]
    # The columns of L^-1, as rows of the upper part; its diagonal apart.
    for j in range(n):
        for i in range(j + 1, n):
            value = -lower[i, j] / lower[j, j]
            for k in range(j + 1, i):
                value -= lower[i, k] * lower[j, k]
            lower[j, i] = value / lower[i, i]
    for i in range(n):
        for j in range(i + 1):
            # sum over k >= i of (L^-1)[k, i] (L^-1)[k, j]
            value = lower[j, i] / lower[i, i] if j < i else 1.0 / (lower[i, i] * lower[i, i])
            for k in range(i + 1, n):
                value += lower[i, k] * lower[j, k]
            out[i, j] = value
            out[j, i] = value


@compiled("b1(f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[::1])")
def _scaled_information(
    cov: Array, order: Indices, out: Array, work: Array, sigma: Array
) -> bool:
    """out (a, a) <- P^-1 of the states `order` of `cov`, times sigma_i sigma_j, their sigmas (a,)
    written too; False if P cannot be made positive definite."""
    a = order.shape[0]
    for i in range(a):
        sigma[i] = math.sqrt(cov[order[i], order[i]])
    addition = 0.0
    while addition < 1e-3:
        for i in range(a):
            for j in range(i):
                work[i, j] = cov[order[i], order[j]] / (sigma[i] * sigma[j])
            work[i, i] = 1.0 + addition
        if cholesky(work):
            inverse_of_factor(work, out)
            return True
        addition = FIRST_ADDITION if addition == 0.0 else addition * 10.0
    return False


@compiled(
    "b1(f8[:, :, ::1], f8[:, ::1], f8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[::1],"
    "f8[:, ::1], f8[::1], f8[::1])"
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

    Of the states `order` (a,) it writes the scaled information w P^-1 (k + 1, a, a) and w P^-1 x
    (k + 1, a), the last of each their sum, the `scale` (a,) of these, the fused covariance (a, a)
    and estimate (a,), and the trace of each P over the squares of the scale. False if a covariance
    is not positive definite: then nothing of it counts.
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
    "f8(f8[:, ::1], f8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[::1], i8, i8)"
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
    """The statistic of estimate `member` (`cov`, `dx`) against all others that `combine` has fused,
    on the last `tested` states of `order`; 0 if the others know nothing."""
    k, a, b = infos.shape[0] - 1, order.shape[0], tested
    lower, y = np.empty((a, a)), np.empty(a)
    for i in range(a):
        for j in range(i + 1):
            lower[i, j] = infos[k, i, j] - infos[member, i, j]
        y[i] = vectors[k, i] - vectors[member, i]
    if not cholesky(lower):
        return 0.0
    for i in range(a):
        for j in range(i):
            y[i] -= lower[i, j] * y[j]
        y[i] /= lower[i, i]
    first = a - b
    for i in range(a - 1, first - 1, -1):
        for j in range(i + 1, a):
            y[i] -= lower[j, i] * y[j]
        y[i] /= lower[i, i]
    tail, s, d = np.empty((b, b)), np.empty((b, b)), np.empty(b)
    for i in range(b):
        for j in range(b):
            tail[i, j] = lower[first + i, first + j] if j <= i else 0.0
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
        for j in range(i):
            d[i] -= s[i, j] * d[j]
        d[i] /= s[i, i]
        total += d[i] * d[i]
    return total


@compiled("void(f8[:, :, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[::1], f8[::1], b1[::1])")
def distribute(
    covs: Array,
    dxs: Array,
    order: Indices,
    fused: Array,
    estimate: Array,
    shares: Array,
    reset: NDArray[np.bool_],
) -> None:
    """Write the fused estimate into each of `dxs` and the fused covariance over its share into each
    of `covs` where `reset` (k,) is set."""
    a = order.shape[0]
    for m in range(covs.shape[0]):
        if reset[m]:
            covs[m] = 0.0
            dxs[m] = 0.0
            for i in range(a):
                dxs[m, order[i]] = estimate[i]
                for j in range(a):
                    covs[m, order[i], order[j]] = fused[i, j] / shares[m]
