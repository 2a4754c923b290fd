r"""Compiled kernels: gate, measurement update, feedback.

An update takes one scalar row after another (rows must be uncorrelated), Joseph form:

    u = P h^T,  s = h u + r,  k = u / s,  P <- (I - k h) P (I - k h)^T + k r k^T

Source: Bierman, Factorization Methods (1977), section V.2; Groves, 2nd ed., eq. 3.58.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.navigation.rotation import rotate_quaternion
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

Array = NDArray[np.float64]


@compiled("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])", allocates=True)
def normalised_innovation_squared(cov: Array, z: Array, h: Array, r: Array, y: Array) -> float:
    """nu^T S^-1 nu for z (m,), h (m, n), r (m,) variances; S = H P H^T + diag(r) = L L^T.

    `y` (m,) is left as the whitened innovation L^-1 z.

    By Cholesky and forward substitution, without forming S^-1.
    """
    m = z.shape[0]
    n = h.shape[1]
    u = np.zeros((m, n))
    s = np.zeros((m, m))
    for a in range(m):
        for i in range(n):
            c = h[a, i]
            if c != 0.0:
                for j in range(n):
                    u[a, j] += c * cov[i, j]
    for a in range(m):
        for b in range(a + 1):
            total = 0.0
            for j in range(n):
                total += u[a, j] * h[b, j]
            s[a, b] = total
        s[a, a] += r[a]
    # Cholesky s = L L^T and forward substitution L y = z, y^T y is the answer.
    total = 0.0
    for a in range(m):
        for b in range(a + 1):
            value = s[a, b]
            for k in range(b):
                value -= s[a, k] * s[b, k]
            if a == b:
                if value <= 0.0:
                    return np.inf
                s[a, a] = math.sqrt(value)
            else:
                s[a, b] = value / s[b, b]
        value = z[a]
        for k in range(a):
            value -= s[a, k] * y[k]
        y[a] = value / s[a, a]
        total += y[a] * y[a]
    return total


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])", allocates=True)
def update(cov: Array, dx: Array, z: Array, h: Array, r: Array) -> None:
    """Fold rows z = h dx + noise (variances r) into `dx` (n,) and `cov` (n, n), in place."""
    n = dx.shape[0]
    u, k = np.empty(n), np.empty(n)
    for a in range(z.shape[0]):
        u[:] = 0.0
        innovation, noise = z[a], r[a]
        for i in range(n):
            c = h[a, i]
            if c != 0.0:
                innovation -= c * dx[i]
                for j in range(n):
                    u[j] += c * cov[i, j]
        s = noise
        for i in range(n):
            s += h[a, i] * u[i]
        hk = 0.0
        for i in range(n):
            k[i] = u[i] / s
            hk += h[a, i] * k[i]
            dx[i] += k[i] * innovation
        # T = (I - k h) P = P - k u^T;  T h^T = u (1 - h k);  P = T - T h^T k^T + k r k^T.
        # By rows, which is vector code, and above the diagonal by the products of what is below it:
        # the same bits. What is above it at first differs by what others have rounded.
        if a == 0:
            for i in range(n):
                for j in range(i):
                    cov[j, i] = cov[i, j]
        c = (1.0 - hk) * s
        for i in range(n):
            k_i, u_i = k[i], u[i]
            c_i, r_i = c * k_i, noise * k_i
            for j in range(n):
                k_j = k[j]
                below = j <= i
                t = k_i * u[j] if below else k_j * u_i
                turned = c_i * k_j if below else c * k_j * k_i
                of_noise = r_i * k_j if below else noise * k_j * k_i
                cov[i, j] = cov[i, j] - t - turned + of_noise


@compiled("void(f8[::1], f8[::1], f8[::1])")
def feed_back(nav: Array, xi: Array, d: Array) -> None:
    """Take the estimated errors `d` (n,) out of `nav` (10,), add its parameters to `xi` (n,)."""
    for i in range(CORE_SIZE, d.shape[0]):
        xi[i] += d[i]
    rotate_quaternion(nav[Q0:], d[0], d[1], d[2], True)
    for j in range(3):
        nav[VN + j] -= d[3 + j]
    sin_lat, cos_lat = math.sin(nav[LAT]), math.cos(nav[LAT])
    w2 = 1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat
    root = math.sqrt(w2)
    radius_n = SEMI_MAJOR_M / root + nav[HEIGHT]
    radius_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w2 * root) + nav[HEIGHT]
    nav[LAT] -= d[6] / radius_m
    nav[LON] -= d[7] / (radius_n * cos_lat)
    nav[HEIGHT] += d[8]


@compiled(
    "f8(f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, b1, f8[::1])",
    allocates=True,
)
def fuse(
    nav: Array,
    xi: Array,
    cov: Array,
    dx: Array,
    z: Array,
    h: Array,
    r: Array,
    threshold: float,
    holding: bool,
    y: Array,
) -> float:
    """Gate, update and feedback in one; the normalised innovation squared.

    Nothing changes if it is above `threshold` or not finite. With `holding` the estimate `dx` (n,)
    is kept and added to instead of fed back; `z` is then the innovation before `dx` is taken off.
    `y` (m,) is left as the whitened innovation.
    """
    n = dx.shape[0]
    innovation = z
    if holding:
        innovation = z.copy()
        for a in range(z.shape[0]):
            for i in range(n):
                innovation[a] -= h[a, i] * dx[i]
    nis = normalised_innovation_squared(cov, innovation, h, r, y)
    if nis <= threshold:
        if not holding:
            dx[:] = 0.0
        update(cov, dx, z, h, r)
        if not holding:
            feed_back(nav, xi, dx)
            dx[:] = 0.0
    return nis
