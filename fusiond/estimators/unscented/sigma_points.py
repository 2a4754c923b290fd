r"""Compiled kernels: sigma points of the error state, and a measurement's linear form from them.

Of m states with mean x and covariance P = L L^T, L_i column i of L, s the spread in sigmas:

    x_0 = x,   x_i+- = x +- s L_i                                     i = 1 ... m
    o_i = (g(x_i+) - g(x_i-)) / 2 s,   e_i = (g(x_i+) + g(x_i-) - 2 g(x)) / 2 s
    mean = g(x) + sum e_i / s
    cov(g) = sum o_i o_i^T + sum e_i e_i^T,    cov(g, x) = sum o_i L_i^T

This is the scaled unscented transform with s^2 = alpha^2 (m + kappa) and beta = alpha^2, its
weighted sums written with the odd and even parts of g: without negative weights, so no difference
of large numbers and never an indefinite covariance, whatever the spread. For other beta the last
line but one has (beta - alpha^2) times the square of the mean's shift. s = sqrt(3) gives a
Gaussian's fourth moment and so the mean to fourth order on each axis; cov(g) is then, for g a sum
of squares, 1.5 times the Gaussian's: on the safe side.

A measurement z_0 = g(dx) + v is taken as z = H dx + v', which is exact for mean and gain:

    H = cov(g, x) P^-1,  from  H L_i = o_i             cov(v') = R + sum e_i e_i^T = U D U^T

Then H P H^T + cov(v') = cov(g) + R, the innovation's covariance, and P H^T = cov(x, g). U is unit
lower triangular; rows U^-1 z, U^-1 H with variances D are uncorrelated. Where g is linear, e = 0
and U = 1. Rows that are judged one by one stay separate: each gets the sum of its row of |cov(v')|
as variance, a diagonal matrix that is never below cov(v') (Gershgorin).

Source: Julier, Uhlmann, Unscented Filtering and Nonlinear Estimation, Proc. IEEE 92 (2004),
sections III and VI; odd and even parts: Norgaard, Poulsen, Ravn, Automatica 36 (2000), section 3;
statistical linearisation: Lefebvre, Bruyninckx, De Schutter, IEEE T-AC 47 (2002).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.update import feed_back
from fusiond.models.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import NAV_SIZE, STEP_RATE_B, STEP_SIZE

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# A pivot this small a part of its variance is rounding: the state is known from those before it.
NO_PIVOT = 1e-15


@compiled("void(f8[:, ::1], i8[::1], f8[:, ::1])")
def factor(cov: Array, slots: Indices, root: Array) -> None:
    """Write `root` (m, m), row i = column L_i of the Cholesky factor of cov[slots][:, slots].

    A state without variance of its own gets a row of zeros. `cov` is symmetric.
    """
    m = slots.shape[0]
    root[:] = 0.0
    for i in range(m):
        variance = cov[slots[i], slots[i]]
        pivot = variance
        for k in range(i):
            pivot -= root[k, i] * root[k, i]
        if not pivot > NO_PIVOT * variance:
            continue
        diagonal = math.sqrt(pivot)
        row = root[i]
        for j in range(i, m):
            row[j] = cov[slots[i], slots[j]]
        for k in range(i):
            c = root[k, i]
            if c != 0.0:
                for j in range(i, m):
                    row[j] -= c * root[k, j]
        inverse = 1.0 / diagonal
        for j in range(i, m):
            row[j] *= inverse


@compiled(
    "void(f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[:, ::1], f8[:, ::1], f8, f8[:, ::1],"
    "f8[:, ::1], f8[:, ::1])",
    allocates=True,
)
def spread_states(
    nav: Array,
    xi: Array,
    step: Array,
    dx: Array,
    slots: Indices,
    sensor_terms: Indices,
    root: Array,
    spread: float,
    navs: Array,
    xis: Array,
    steps: Array,
) -> None:
    """Write the true states for the errors dx, dx + s L_1, dx - s L_1, dx + s L_2 ...

    navs (2m + 1, 10), xis (2m + 1, n), steps (2m + 1, 28): rates and forces with their own sensor
    errors taken out.
    """
    n = xi.shape[0]
    d = np.empty(n)
    for p in range(navs.shape[0]):
        d[:] = dx
        if p > 0:
            signed = spread if p % 2 == 1 else -spread
            for k in range(slots.shape[0]):
                d[slots[k]] += signed * root[(p - 1) // 2, k]
        for k in range(NAV_SIZE):
            navs[p, k] = nav[k]
        for k in range(n):
            xis[p, k] = xi[k]
        for k in range(STEP_SIZE):
            steps[p, k] = step[k]
        feed_back(navs[p], xis[p], d)
        for k in range(12):
            at = STEP_RATE_B + k // 2
            if sensor_terms[1, k] == PLAIN:
                steps[p, at] -= d[sensor_terms[0, k]]
            elif sensor_terms[1, k] == SCALE:
                steps[p, at] -= step[at] * d[sensor_terms[0, k]]


@compiled(
    "void(f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8[::1], f8[:, ::1], f8, b1, f8[::1],"
    "f8[:, ::1], f8[::1])",
    allocates=True,
)
def linear_form(
    points: Array,
    central: Array,
    r: Array,
    dx: Array,
    slots: Indices,
    root: Array,
    spread: float,
    one_by_one: bool,
    z: Array,
    h: Array,
    d: Array,
) -> None:
    """Write z (rows,), h (rows, n) and variances d (rows,) of uncorrelated rows.

    `points` (2m + 1, rows): innovations at the states of `spread_states`; a pair with a NaN uses
    `central` (rows, n), the Jacobian at the centre. `r` (rows,) variances of the noise. Rows judged
    `one_by_one` stay separate.
    """
    m, rows = slots.shape[0], r.shape[0]
    odd, even = np.zeros((m, rows)), np.zeros((m, rows))
    shift = np.zeros(rows)
    inverse = 0.5 / spread
    for i in range(m):
        if root[i, i] == 0.0:
            continue
        sound = True
        for a in range(rows):
            plus, minus = points[2 * i + 1, a], points[2 * i + 2, a]
            # What a true state leaves unexplained falls as its error explains more: g = -points.
            odd[i, a] = (minus - plus) * inverse
            even[i, a] = (plus + minus - 2.0 * points[0, a]) * inverse
            sound = sound and math.isfinite(odd[i, a])
        if not sound:
            for a in range(rows):
                even[i, a] = 0.0
                odd[i, a] = 0.0
                for j in range(i, m):
                    odd[i, a] += central[a, slots[j]] * root[i, j]
        for a in range(rows):
            shift[a] += even[i, a] / spread
    h[:] = 0.0
    for a in range(rows):
        z[a] = points[0, a] + shift[a]
        for i in range(m - 1, -1, -1):
            if root[i, i] == 0.0:
                h[a, slots[i]] = central[a, slots[i]]
                continue
            value = odd[i, a]
            for j in range(i + 1, m):
                value -= h[a, slots[j]] * root[i, j]
            h[a, slots[i]] = value / root[i, i]
        for i in range(m):
            z[a] += h[a, slots[i]] * dx[slots[i]]

    # R + sum e e^T = U D U^T, and U^-1 on the rows.
    u = np.zeros((rows, rows))
    for i in range(m):
        for a in range(rows):
            if even[i, a] != 0.0:
                for b in range(a + 1):
                    u[a, b] += even[i, a] * even[i, b]
    if one_by_one:
        for a in range(rows):
            d[a] = r[a]
        for a in range(rows):
            d[a] += u[a, a]
            for b in range(a):
                d[a] += abs(u[a, b])
                d[b] += abs(u[a, b])
        return
    for a in range(rows):
        d[a] = u[a, a] + r[a]
        for b in range(a):
            value = u[a, b]
            for k in range(b):
                value -= u[a, k] * d[k] * u[b, k]
            u[a, b] = value / d[b]
            d[a] -= u[a, b] * u[a, b] * d[b]
        for b in range(a):
            c = u[a, b]
            if c != 0.0:
                z[a] -= c * z[b]
                for j in range(m):
                    h[a, slots[j]] -= c * h[b, slots[j]]
