r"""Compiled kernel: the error's mean and covariance through the strapdown equations themselves.

The error is written as P = sum_k L_k L_k^T + P', L_k the first three columns of the Cholesky
factor: attitude errors with all states correlated with them. Along these the sigma points
(fusiond.estimators.unscented.sigma_points) are drawn for each IMU interval. Each is a possible true
state: its own sensor errors are subtracted from the sample, and it runs through `strapdown_step`
beside the computed state. P' is the rest of velocity, position and parameters. In them one interval
is linear: the largest second-order terms, g (dr / R)^2 and dv^2 / R, are 2e-5 m/s^2 for 10 km and
2e-5 m/s^2 for 10 m/s. So P' takes the transition F of fusiond.estimators.covariance_propagation,
with the noise Q:

    P <- sum o_k o_k^T + sum e_k e_k^T + F P' F^T + Q        mean <- f(dx) + sum e_k / s

The mean is subtracted from the navigation state at once or, while feedback is held, kept in dx.

Large attitude errors need one more transform (`turn_attitude`): the feedback d of the attitude
turns the axes of the remaining error. From exp(d + e) = exp(J e) exp(d):

    e' = J(d) e,   J = I + (1 - cos a) / a [n x] + (1 - sin a / a) [n x]^2,   d = a n

Source: Julier, Uhlmann, Proc. IEEE 92 (2004), section III; states that act linearly set apart:
Schoen, Gustafsson, Nordlund, IEEE T-SP 53 (2005); J: Sola, A micro Lie theory, arXiv 1812.01537,
eq. 145; its use: Mueller, Hehn, D'Andrea, Covariance correction step, J. Guidance 40 (2017).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.corrected_imu import compensate, sensor_estimates, slopes
from fusiond.estimators.covariance_propagation import (
    covariance_for,
    kept_part,
    mirror,
    propagate_parameters,
)
from fusiond.estimators.multi_sample_covariance import shake, widen_for_gap
from fusiond.estimators.published_state import in_fix_time, sigmas
from fusiond.estimators.unscented.sigma_points import NO_PIVOT
from fusiond.estimators.update import feed_back
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.error_model import COEFFICIENTS, CORE_SIZE, WIDTHS, coefficients
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    LON,
    NAV_SIZE,
    Q0,
    STEP_SIZE,
    VN,
    strapdown_step,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Columns along which points are drawn: the attitude, slots 0 to 2.
POINTS = 3

# One kernel for all widths: it takes 4.6 s to compile, and a branch is nothing beside its points.
_covariance_narrow, _covariance_middle, _covariance_wide, _covariance_widest = (
    covariance_for(w) for w in WIDTHS
)


@compiled("void(f8[:, ::1], f8[:, ::1])")
def split(cov: Array, root: Array) -> None:
    """Write `root` (3, width), the first columns of the Cholesky factor; `cov` keeps the rest."""
    width = cov.shape[0]
    for k in range(POINTS):
        row = root[k]
        variance = cov[k, k]
        for i in range(k):
            variance += root[i, k] * root[i, k]
        if cov[k, k] > NO_PIVOT * variance:
            inverse = 1.0 / math.sqrt(cov[k, k])
            for j in range(width):
                row[j] = cov[k, j] * inverse
        else:
            row[:] = 0.0
        for a in range(k, width):
            c = row[a]
            if c != 0.0:
                for j in range(width):
                    cov[a, j] -= c * row[j]
        for j in range(width):
            cov[k, j] = 0.0
            cov[j, k] = 0.0


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1])")
def error_of(nav: Array, true: Array, scale: Array, out: Array) -> None:
    """Write `out` (9,), the error of `nav` (10,) from which `feed_back` would make `true` (10,).

    `scale` (2,): metres a rad of latitude and longitude at `nav`.
    """
    a0, a1, a2, a3 = nav[Q0], nav[Q0 + 1], nav[Q0 + 2], nav[Q0 + 3]
    b0, b1, b2, b3 = true[Q0], true[Q0 + 1], true[Q0 + 2], true[Q0 + 3]
    # true (x) nav^-1 = exp(phi)
    w = b0 * a0 + b1 * a1 + b2 * a2 + b3 * a3
    x = -b0 * a1 + b1 * a0 - b2 * a3 + b3 * a2
    y = -b0 * a2 + b1 * a3 + b2 * a0 - b3 * a1
    z = -b0 * a3 - b1 * a2 + b2 * a1 + b3 * a0
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    k = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    out[0], out[1], out[2] = k * x, k * y, k * z
    for j in range(3):
        out[3 + j] = nav[VN + j] - true[VN + j]
    east = nav[LON] - true[LON]
    east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
    out[6] = (nav[LAT] - true[LAT]) * scale[0]
    out[7] = east * scale[1]
    out[8] = true[HEIGHT] - nav[HEIGHT]


@compiled("void(f8[:, ::1], f8[::1], f8[::1])", allocates=True)
def turn_attitude(cov: Array, before: Array, after: Array) -> None:
    """Rotate `cov` (width, width) for the feedback that changed nav `before` to `after` (10,)."""
    d, scale = np.zeros(CORE_SIZE), np.ones(2)
    error_of(before, after, scale, d)
    x, y, z = d[0], d[1], d[2]
    a2 = x * x + y * y + z * z
    if a2 < 1e-6:  # series, to a^4
        p, q = 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    else:
        a = math.sqrt(a2)
        p, q = (1.0 - math.cos(a)) / a2, (1.0 - math.sin(a) / a) / a2
    j00, j01, j02 = 1.0 - q * (y * y + z * z), q * x * y - p * z, q * x * z + p * y
    j10, j11, j12 = q * x * y + p * z, 1.0 - q * (x * x + z * z), q * y * z - p * x
    j20, j21, j22 = q * x * z - p * y, q * y * z + p * x, 1.0 - q * (x * x + y * y)
    for j in range(cov.shape[0]):
        u, v, w = cov[0, j], cov[1, j], cov[2, j]
        cov[0, j] = j00 * u + j01 * v + j02 * w
        cov[1, j] = j10 * u + j11 * v + j12 * w
        cov[2, j] = j20 * u + j21 * v + j22 * w
    for i in range(cov.shape[0]):
        u, v, w = cov[i, 0], cov[i, 1], cov[i, 2]
        cov[i, 0] = j00 * u + j01 * v + j02 * w
        cov[i, 1] = j10 * u + j11 * v + j12 * w
        cov[i, 2] = j20 * u + j21 * v + j22 * w
    for i in range(cov.shape[0]):
        for j in range(min(i, 3)):
            mean = 0.5 * (cov[i, j] + cov[j, i])
            cov[i, j] = mean
            cov[j, i] = mean


@compiled(
    "UniTuple(i8, 2)(f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8, b1, b1[::1], i8[:, ::1],"
    "i8[:, ::1], f8[:, ::1], i8, f8, f8, i8[::1], f8[:, ::1], f8[:, ::1], i8, i8, i8, i8, i8, b1,"
    "f8[:, ::1], f8[:, ::1], b1, f8[::1])",
    allocates=True,
)
def propagate_points(
    nav: Array,
    xi: Array,
    cov: Array,
    dx: Array,
    step: Array,
    spread: float,
    hold_height: bool,
    active: NDArray[np.bool_],
    sensor_terms: Indices,
    rate_terms: Indices,
    noise: Array,
    time_slot: int,
    clock_sd_s: float,
    axes_sd_rad: float,
    times: Indices,
    samples: Array,
    densities: Array,
    first: int,
    end: int,
    now: int,
    target: int,
    gap_ns: int,
    record: bool,
    nav_out: Array,
    sigma_out: Array,
    carry: bool,
    work: Array,
) -> tuple[int, int]:
    """Propagate from `now` to `target` (ns); return the next sample's index and the new time.

    Arguments as `propagate` in fusiond.estimators.propagation, for one covariance `cov` (width,
    width) and its error estimate `dx` (n,); `spread` of the points in sigmas; `work` has
    work_size(width) doubles.
    """
    n, width = xi.shape[0], cov.shape[0]
    flat, kept = cov.reshape(width * width), kept_part(work, width)
    sensor_slot, sensor_kind = sensor_terms[0], sensor_terms[1]
    flat_samples, flat_densities = samples.reshape(samples.size), densities.reshape(densities.size)
    rates = rate_terms.reshape(rate_terms.size)
    terms = (active, sensor_terms.reshape(24), rates, noise.reshape(3 * n), 1.0, work)
    root, odd = np.empty((POINTS, width)), np.empty((POINTS, width))
    even = np.empty((POINTS, CORE_SIZE))
    c, estimate, d, mean = np.zeros(COEFFICIENTS), np.empty(12), np.empty(n), np.empty(n)
    rate, force = np.empty(3), np.empty(3)
    rate_slope, force_slope = np.empty(3), np.empty(3)
    before, true, xi_true = np.empty(NAV_SIZE), np.empty(NAV_SIZE), np.empty(n)
    unused, scale = np.empty(STEP_SIZE), np.empty(2)
    off = np.zeros((3, CORE_SIZE))  # errors at the end: of the mean, of a point and of its opposite
    half_inverse = 0.5 / spread

    i = first
    while i < end and now < target:
        stop = min(times[i], target)
        if stop > now:
            h = (stop - now) * 1e-9
            silent = slopes(times, flat_samples, i, gap_ns, rate_slope, force_slope)
            split(cov, root)
            before[:] = nav
            sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
            compensate(flat_samples, i, estimate, rate, force)
            strapdown_step(nav, rate, force, rate_slope, force_slope, h, hold_height, step)
            scale[0] = meridian_radius(nav[LAT]) + nav[HEIGHT]
            scale[1] = (transverse_radius(nav[LAT]) + nav[HEIGHT]) * math.cos(nav[LAT])

            coefficients(nav, step, h, c)
            if width == WIDTHS[0]:
                _covariance_narrow(flat, step, c, h, *terms)
            elif width == WIDTHS[1]:
                _covariance_middle(flat, step, c, h, *terms)
            elif width == WIDTHS[2]:
                _covariance_wide(flat, step, c, h, *terms)
            else:
                _covariance_widest(flat, step, c, h, *terms)
            mirror(flat, width, n)

            # Point 0 is the mean, 2 k + 1 and 2 k + 2 are the pair along L_k.
            for point in range(2 * POINTS + 1):
                k, which = (point - 1) // 2, (point - 1) % 2 + 1
                if point == 0:
                    if not carry:
                        continue  # the mean is the computed state
                    which = 0
                elif root[k, k] == 0.0:
                    odd[k] = 0.0
                    even[k] = 0.0
                    continue
                d[:] = dx
                if point > 0:
                    signed = spread if which == 1 else -spread
                    for j in range(n):
                        d[j] += signed * root[k, j]
                true[:] = before
                xi_true[:] = xi
                feed_back(true, xi_true, d)
                sensor_estimates(xi_true, sensor_slot, sensor_kind, estimate)
                compensate(flat_samples, i, estimate, rate, force)
                strapdown_step(true, rate, force, rate_slope, force_slope, h, hold_height, unused)
                error_of(nav, true, scale, off[which])
                if which < 2:
                    continue
                odd[k] = root[k]
                for j in range(CORE_SIZE):
                    odd[k, j] = (off[1, j] - off[2, j]) * half_inverse
                    even[k, j] = (off[1, j] + off[2, j] - 2.0 * off[0, j]) * half_inverse
                    if not active[j]:
                        odd[k, j] = 0.0
                        even[k, j] = 0.0
                propagate_parameters(odd[k, :n], h, rates, kept)

            mean[:] = 0.0
            for j in range(CORE_SIZE):
                mean[j] = off[0, j] if active[j] else 0.0
            for k in range(POINTS):
                row = odd[k]
                for a in range(n):
                    factor = row[a]
                    for b in range(width):
                        cov[a, b] += factor * row[b]
                for a in range(CORE_SIZE):
                    factor = even[k, a]
                    mean[a] += factor / spread
                    for b in range(CORE_SIZE):
                        cov[a, b] += factor * even[k, b]
            propagate_parameters(xi, h, rates, kept)
            if carry:
                for j in range(CORE_SIZE):
                    dx[j] = mean[j]
                propagate_parameters(dx, h, rates, kept)
            else:
                feed_back(nav, xi, mean)
            shake(flat, width, active, step, flat_densities, i, h)
            if silent:
                # The held sample is a guess: its error acts over the whole of the gap.
                widen_for_gap(flat, width, active, nav, (times[i] - times[i - 1]) * 1e-9, h)
        now = stop
        if now == times[i]:
            if record:
                in_fix_time(nav, xi, step, time_slot, nav_out[i])
                sigmas(cov, nav, step, time_slot, clock_sd_s, axes_sd_rad, sigma_out[i])
            i += 1
    return i, now
