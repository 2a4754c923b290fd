r"""Compiled kernels: gate, measurement update, feedback.

Rows must be uncorrelated. With S = H P H^T + R = L L^T and z the innovation

    y = L^-1 z,   G = L^-1 H P,   nu^T S^-1 nu = y^T y,   dx <- dx + G^T y,   P <- P - G^T G

which is the update by one scalar row after another with a stored factor. All rows are subtracted
from P in one pass, bit for bit the same above and below the diagonal.

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


@compiled("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])")
def whiten(cov: Array, z: Array, h: Array, r: Array, y: Array, g: Array) -> float:
    """nu^T S^-1 nu for z (m,), h (m, n), r (m,) variances; infinite where S is not positive.

    `y` (m,) is left as the whitened innovation L^-1 z, `g` (m, w) as L^-1 H P for P (w, w).
    """
    m, n = h.shape
    width = g.shape[1]
    total = 0.0
    for a in range(m):
        for j in range(width):
            g[a, j] = 0.0
        for i in range(n):
            c = h[a, i]
            if c != 0.0:
                for j in range(width):
                    g[a, j] += c * cov[i, j]
        innovation, s = z[a], r[a]
        b = 0
        while b < a:
            g_0, c_0 = g[b], 0.0
            if b + 4 <= a:  # four rows in one pass, one after the other
                g_1, g_2, g_3 = g[b + 1], g[b + 2], g[b + 3]
                c_1 = c_2 = c_3 = 0.0
                for i in range(n):
                    c = h[a, i]
                    if c != 0.0:
                        c_0 += c * g_0[i]
                        c_1 += c * g_1[i]
                        c_2 += c * g_2[i]
                        c_3 += c * g_3[i]
                innovation = innovation - c_0 * y[b] - c_1 * y[b + 1]
                innovation = innovation - c_2 * y[b + 2] - c_3 * y[b + 3]
                row = g[a]
                for j in range(width):
                    row[j] = row[j] - c_0 * g_0[j] - c_1 * g_1[j] - c_2 * g_2[j] - c_3 * g_3[j]
                b += 4
            else:
                for i in range(n):
                    if h[a, i] != 0.0:
                        c_0 += h[a, i] * g_0[i]
                innovation -= c_0 * y[b]
                for j in range(width):
                    g[a, j] -= c_0 * g_0[j]
                b += 1
        for i in range(n):
            if h[a, i] != 0.0:
                s += h[a, i] * g[a, i]
        if s <= 0.0:
            return np.inf
        root = math.sqrt(s)
        y[a] = innovation / root
        total += y[a] * y[a]
        for j in range(width):
            g[a, j] /= root
    return total


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])")
def fold_in(cov: Array, dx: Array, y: Array, g: Array) -> None:
    """Update `dx` (n,) and `cov` (w, w), in place, from the results of `whiten`."""
    m = g.shape[0]
    at = 0
    while at < m:
        g_0 = g[at]
        if at + 3 <= m:  # three rows in one pass, one after the other
            g_1, g_2 = g[at + 1], g[at + 2]
            for i in range(dx.shape[0]):
                c_0, c_1, c_2, row = g_0[i], g_1[i], g_2[i], cov[i]
                dx[i] = dx[i] + c_0 * y[at] + c_1 * y[at + 1] + c_2 * y[at + 2]
                for j in range(row.shape[0]):
                    row[j] = row[j] - c_0 * g_0[j] - c_1 * g_1[j] - c_2 * g_2[j]
            at += 3
        else:
            for i in range(dx.shape[0]):
                c_0, row = g_0[i], cov[i]
                dx[i] += c_0 * y[at]
                for j in range(row.shape[0]):
                    row[j] -= c_0 * g_0[j]
            at += 1


@compiled("void(f8[::1], f8[:, ::1], f8[::1], f8[::1])", forceinline=True)
def take_off(z: Array, h: Array, dx: Array, out: Array) -> None:
    """Write z - H dx to `out` (m,)."""
    for a in range(z.shape[0]):
        out[a] = z[a]
        for i in range(dx.shape[0]):
            out[a] -= h[a, i] * dx[i]


@compiled("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])", allocates=True)
def normalised_innovation_squared(cov: Array, z: Array, h: Array, r: Array, y: Array) -> float:
    """nu^T S^-1 nu for z (m,), h (m, n), r (m,); `y` (m,) is left as the whitened innovation."""
    return whiten(cov, z, h, r, y, np.empty((z.shape[0], cov.shape[1])))


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])", allocates=True)
def update(cov: Array, dx: Array, z: Array, h: Array, r: Array) -> None:
    """Fold rows z = h dx + noise (variances r) into `dx` (n,) and `cov` (w, w), in place; no change
    if S is not positive."""
    m = z.shape[0]
    innovation, y, g = np.empty(m), np.empty(m), np.empty((m, cov.shape[1]))
    take_off(z, h, dx, innovation)
    if whiten(cov, innovation, h, r, y, g) < np.inf:
        fold_in(cov, dx, y, g)


@compiled("void(f8[::1], f8[::1], f8[::1])")
def feed_back(nav: Array, xi: Array, d: Array) -> None:
    """Subtract the estimated errors `d` (n,) from `nav` (10,) and add its parameters to `xi`
    (n,)."""
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


def work(rows: int, width: int) -> tuple[Array, Array]:
    """Workspace of `fuse` for m rows: y (m,) and g (m, w)."""
    return np.empty(rows), np.empty((rows, width))


@compiled(
    "f8(f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, b1, f8[::1],"
    "f8[:, ::1])"
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
    g: Array,
) -> float:
    """Gate, update and feedback in one; the normalised innovation squared.

    Nothing changes if it is above `threshold` or not finite. With `holding` the estimate `dx` (n,)
    is kept and updated instead of fed back; `z` is then the innovation before `dx` is subtracted.
    `y` (m,) is left as the whitened innovation, `g` (m, w) as `whiten` leaves it.
    """
    innovation = z
    if holding:
        innovation = y  # each of its elements is read before it is written
        take_off(z, h, dx, innovation)
    nis = whiten(cov, innovation, h, r, y, g)
    if nis <= threshold:
        if not holding:
            dx[:] = 0.0
        fold_in(cov, dx, y, g)
        if not holding:
            feed_back(nav, xi, dx)
            dx[:] = 0.0
    return nis
