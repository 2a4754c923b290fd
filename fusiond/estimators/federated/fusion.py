r"""Fusion of estimates of one state: N uncorrelated ones, two correlated ones.

Uncorrelated, each x_i with covariance P_i:

    P_g = (sum P_i^-1)^-1,   x_g = P_g sum P_i^-1 x_i

Two with cross-covariance P_12 = E[e_1 e_2^T] = P_21^T (paper 004 prints P_12 = P_21, which holds
for scalars). Of all x_g = x_1 + W (x_2 - x_1) the one with the least covariance has

    W = (P_11 - P_12) D^-1,   D = P_11 - P_12 - P_21 + P_22 = cov(x_2 - x_1)
    P_g = P_11 - (P_11 - P_12) D^-1 (P_11 - P_12)^T

Both are weighted least squares: y = A x + e, y the stacked estimates, A stacked identities.

Source: paper 004, section 3; Bar-Shalom and Campo, IEEE Trans. AES 22 (1986), 803.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def information(p: Array) -> Array:
    """Information P^-1 (n, n) of a covariance, computed with its diagonal scaled to 1.

    Raises `numpy.linalg.LinAlgError` if P is not positive definite.
    """
    scale = np.sqrt(np.diag(p))
    root = np.linalg.inv(np.linalg.cholesky(p / np.outer(scale, scale)))
    inverse: Array = root.T @ root / np.outer(scale, scale)
    return inverse


def fuse_uncorrelated(estimates: Array, covariances: Array) -> tuple[Array, Array]:
    """Fused x_g (n,) and P_g (n, n) of `estimates` (k, n) with `covariances` (k, n, n).

    Raises `numpy.linalg.LinAlgError` if a covariance is not positive definite.
    """
    infos = [information(p) for p in covariances]
    fused = information(np.sum(infos, axis=0))
    weighted = np.sum([y @ x for y, x in zip(infos, estimates, strict=True)], axis=0)
    return fused @ weighted, fused


def fuse_correlated(
    x_1: Array, p_11: Array, x_2: Array, p_22: Array, p_12: Array
) -> tuple[Array, Array]:
    """Fused x_g (n,) and P_g (n, n) of two estimates (n,) with covariances and cross-covariance (n,
    n).

    Raises `numpy.linalg.LinAlgError` if the two are the same estimate (D is singular).
    """
    left = p_11 - p_12
    gain = np.linalg.solve((left - p_12.T + p_22).T, left.T).T
    fused = p_11 - gain @ left.T
    return x_1 + gain @ (x_2 - x_1), 0.5 * (fused + fused.T)
