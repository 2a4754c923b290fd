r"""Compiled kernels: propagation of state and covariance over IMU samples, update, feedback.

Covariance over one interval h, P in blocks of navigation errors (1) and parameters (2), the
transition M (9 rows) and the diagonal decay D of the parameters:

    P11 <- M P M^T,   P12 <- M P D,   P22 <- D P22 D
    P <- P + diag(W h + s^2 (1 - D^2)),  half of the W h of the navigation errors before, half after

W the white noise (trapezoid rule), s the steady sigma of Markov states.

Update by one scalar row after another (rows must be uncorrelated), Joseph form:

    u = P h^T,  s = h u + r,  k = u / s,  P <- (I - k h) P (I - k h)^T + k r k^T

Source: Bierman, Factorization Methods (1977), section V.2; Groves, 2nd ed., eq. 3.58.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_M
from fusiond.navigation.error_model import (
    COEFFICIENTS,
    CORE_SIZE,
    CORE_STRIDE,
    STRIDE,
    apply_to_core,
    apply_to_state,
    coefficients,
)
from fusiond.navigation.rotation import rotate_quaternion
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    LON,
    NAV_SIZE,
    Q0,
    STEP_DCM,
    VN,
    strapdown_step,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# What the vehicle may do while the IMU is silent, one sigma of the unknown mean rate (rad/s) and
# force (m/s^2): a car that turns or brakes at a comfortable limit.
GAP_RATE_RAD_S = 0.1
GAP_FORCE_M_S2 = 1.0


WORK_SIZE = (6 + 9 + CORE_STRIDE) * STRIDE + (6 + 9) * CORE_STRIDE + 12

SCRATCH_SIZE = COEFFICIENTS + 24 + WORK_SIZE


def _gather_for(width: int) -> Callable[[Array, Indices, Array, Array], None]:
    """`gather` for rows of `width` doubles: a constant, so that the loops become vector code."""
    unsigned = np.uint64  # an index that cannot be negative needs no check
    wide = np.uint64(width)

    @compiled("void(f8[::1], i8[::1], f8[::1], f8[::1])", forceinline=True)
    def gather(rows: Array, sensor_slot: Indices, weight: Array, sensor: Array) -> None:
        """sensor (6 rows): the parameters' rows of `rows`, two an axis error, weighted."""
        for k in range(6):
            first = unsigned(sensor_slot[2 * k]) * wide
            second = unsigned(sensor_slot[2 * k + 1]) * wide
            of_first, of_second = weight[2 * k], weight[2 * k + 1]
            target = unsigned(k) * wide
            for i in range(width):
                j = unsigned(i)
                sensor[target + j] = of_first * rows[first + j] + of_second * rows[second + j]

    return gather


_gather_state = _gather_for(STRIDE)
_gather_core = _gather_for(CORE_STRIDE)


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], f8[:, ::1], f8[::1])")
def propagate_covariance(
    cov: Array,
    step: Array,
    c: Array,
    h: float,
    active: NDArray[np.bool_],
    sensor_terms: Indices,
    noise: Array,
    work: Array,
) -> None:
    """Advance `cov` (STRIDE, STRIDE) in place by h seconds with transition coefficients `c`.

    The model's arrays are (n,); rows and columns of `cov` from n on are zero and stay so.
    """
    decay_rate, white, steady_variance = noise[0], noise[1], noise[2]
    sensor_slot, sensor_kind = sensor_terms[0], sensor_terms[1]
    n = white.shape[0]
    flat = cov.reshape(STRIDE * STRIDE)
    weight = work[WORK_SIZE - 12 :]
    for i in range(12):
        weight[i] = 0.0
        if sensor_kind[i] == PLAIN:
            weight[i] = 1.0
        elif sensor_kind[i] == SCALE:
            weight[i] = step[3 + i // 2]
    a = 6 * STRIDE
    b = a + 9 * STRIDE
    d = b + STRIDE * CORE_STRIDE
    e = d + 6 * CORE_STRIDE
    sensor, top, turned = work[:a], work[a:b], work[b:d]
    core_sensor, core = work[d:e], work[e : WORK_SIZE - 12]
    for i in range(CORE_SIZE):
        flat[i * STRIDE + i] += 0.5 * h * white[i]

    _gather_state(flat, sensor_slot, weight, sensor)
    apply_to_state(flat, sensor, c, top)
    for i in range(CORE_SIZE):
        if not active[i]:
            for j in range(STRIDE):
                top[i * STRIDE + j] = 0.0
    for j in range(STRIDE):
        for i in range(CORE_SIZE):
            turned[j * CORE_STRIDE + i] = top[i * STRIDE + j]
    # Written back before `turned` is read again: the processor has its scalar stores done by then.
    for i in range(CORE_SIZE):
        for j in range(STRIDE):
            flat[i * STRIDE + j] = top[i * STRIDE + j]
    for j in range(CORE_SIZE, STRIDE):
        for i in range(CORE_SIZE):
            flat[j * STRIDE + i] = top[i * STRIDE + j]
    _gather_core(turned, sensor_slot, weight, core_sensor)
    apply_to_core(turned, core_sensor, c, core)
    for i in range(CORE_SIZE):
        if not active[i]:
            for j in range(CORE_SIZE):
                core[i * CORE_STRIDE + j] = 0.0
    for i in range(CORE_SIZE):
        for j in range(CORE_SIZE):
            lower, upper = core[i * CORE_STRIDE + j], core[j * CORE_STRIDE + i]
            flat[i * STRIDE + j] = 0.5 * (lower + upper)
        flat[i * STRIDE + i] += 0.5 * h * white[i]
    for i in range(CORE_SIZE, n):
        variance = h * white[i]
        if decay_rate[i] > 0.0:
            decay = math.exp(-h * decay_rate[i])
            for j in range(STRIDE):
                flat[i * STRIDE + j] *= decay
                flat[j * STRIDE + i] *= decay
            variance += steady_variance[i] * (1.0 - decay * decay)
        flat[i * STRIDE + i] += variance


@compiled("void(f8[::1], i8[::1], i8[::1], f8[::1])")
def sensor_estimates(
    xi: Array, sensor_slot: Indices, sensor_kind: Indices, estimate: Array
) -> None:
    """Write `estimate` (12,) of the parameters `xi` (n,): rate bias, force bias, their scales."""
    for k in range(12):
        estimate[k] = 0.0
    for i in range(12):
        if sensor_kind[i] == PLAIN:
            estimate[i // 2] += xi[sensor_slot[i]]
        elif sensor_kind[i] == SCALE:
            estimate[6 + i // 2] += xi[sensor_slot[i]]


@compiled("void(f8[:, ::1], i8, f8[::1], f8[::1], f8[::1])")
def compensate(samples: Array, i: int, estimate: Array, rate: Array, force: Array) -> None:
    """Write `rate` and `force` (3,) of sample i of `samples` (m, 6), `estimate` (12,) taken out."""
    for j in range(3):
        rate[j] = (samples[i, j] - estimate[j]) / (1.0 + estimate[6 + j])
        force[j] = (samples[i, 3 + j] - estimate[3 + j]) / (1.0 + estimate[9 + j])


@compiled("void(f8[:, ::1], f8[::1], f8[::1])")
def sigmas(cov: Array, step: Array, out: Array) -> None:
    """Write one sigma (9,): position n, e, d (m), velocity n, e, d (m/s), roll, pitch, yaw (rad).

    Roll, pitch and yaw follow from phi by Euler kinematics, with C_nb as `step` (18,) holds it.
    """
    for i in range(3):
        out[i] = math.sqrt(cov[6 + i, 6 + i])
        out[3 + i] = math.sqrt(cov[3 + i, 3 + i])
    # Rows of d(rpy)/d(phi) without sign: 1/cos(pitch) [cos yaw, sin yaw, 0], [-sin yaw, cos yaw,
    # 0],
    # and [tan(pitch) cos yaw, tan(pitch) sin yaw, 1].
    sp = -step[STEP_DCM + 6]
    cp = math.sqrt(max(1e-12, 1.0 - sp * sp))
    cy, sy = step[STEP_DCM] / cp, step[STEP_DCM + 3] / cp
    a, b, c = cov[0, 0], cov[1, 1], cov[2, 2]
    d, e, f = cov[0, 1], cov[0, 2], cov[1, 2]
    along = cy * cy * a + sy * sy * b + 2.0 * cy * sy * d
    cross = sy * sy * a + cy * cy * b - 2.0 * cy * sy * d
    t = sp / cp
    out[6] = math.sqrt(max(0.0, along)) / cp
    out[7] = math.sqrt(max(0.0, cross))
    out[8] = math.sqrt(max(0.0, t * t * along + c + 2.0 * t * (cy * e + sy * f)))


@compiled("void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[::1], i8[::1], f8[::1], f8[::1])")
def propagate_error(
    dx: Array,
    step: Array,
    c: Array,
    h: float,
    active: NDArray[np.bool_],
    sensor_slot: Indices,
    sensor_kind: Indices,
    decay_rate: Array,
    work: Array,
) -> None:
    """dx (n,) <- Phi dx over h seconds: an estimate that is not fed back yet (paper 000, 1.1)."""
    sensor = work[: 6 * CORE_STRIDE]
    rows = work[6 * CORE_STRIDE : 15 * CORE_STRIDE]
    out = work[15 * CORE_STRIDE : 24 * CORE_STRIDE]
    sensor[:] = 0.0
    for i in range(12):
        if sensor_kind[i] == PLAIN:
            sensor[i // 2 * CORE_STRIDE] += dx[sensor_slot[i]]
        elif sensor_kind[i] == SCALE:
            sensor[i // 2 * CORE_STRIDE] += step[3 + i // 2] * dx[sensor_slot[i]]
    rows[:] = 0.0
    for i in range(CORE_SIZE):
        rows[i * CORE_STRIDE] = dx[i]
    apply_to_core(rows, sensor, c, out)
    for i in range(CORE_SIZE):
        dx[i] = out[i * CORE_STRIDE] if active[i] else 0.0
    for i in range(CORE_SIZE, dx.shape[0]):
        if decay_rate[i] > 0.0:
            dx[i] *= math.exp(-h * decay_rate[i])


@compiled(
    "UniTuple(i8, 2)(f8[::1], f8[::1], f8[:, ::1], b1,"
    "b1[::1], i8[:, ::1], f8[:, ::1],"
    "i8[::1], f8[:, ::1], i8, i8, i8, i8, i8,"
    "b1, f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], b1, f8[::1])"
)
def propagate(
    nav: Array,
    xi: Array,
    cov: Array,
    hold_height: bool,
    active: NDArray[np.bool_],
    sensor_terms: Indices,
    noise: Array,
    times: Indices,
    samples: Array,
    first: int,
    end: int,
    now: int,
    target: int,
    gap_ns: int,
    record: bool,
    nav_out: Array,
    sigma_out: Array,
    step: Array,
    dx: Array,
    carry: bool,
    scratch: Array,
) -> tuple[int, int]:
    """Propagate from `now` to `target` (ns); return the next sample's index and the new time.

    `times` (m,) and `samples` (m, 6: rate, force) are the IMU's; sample i holds over
    (times[i-1], times[i]]. Samples first ... end-1 may be used; the last one only as far as
    `target`, so a target inside an interval splits it. With `record`, the solution and its sigmas
    at the end of each whole sample go to nav_out[i] (10,) and sigma_out[i] (9,). `step` (18,) is
    left as of the last step. With `carry`, the error estimate `dx` (n,) is propagated too.
    `scratch` has
    SCRATCH_SIZE doubles, zero at first.
    """
    decay_rate = noise[0]
    sensor_slot, sensor_kind = sensor_terms[0], sensor_terms[1]
    c, work = scratch[:COEFFICIENTS], scratch[COEFFICIENTS + 24 :]
    rate, force = (
        scratch[COEFFICIENTS : COEFFICIENTS + 3],
        scratch[COEFFICIENTS + 3 : COEFFICIENTS + 6],
    )
    rate_slope = scratch[COEFFICIENTS + 6 : COEFFICIENTS + 9]
    force_slope = scratch[COEFFICIENTS + 9 : COEFFICIENTS + 12]
    estimate = scratch[COEFFICIENTS + 12 : COEFFICIENTS + 24]
    decaying = False
    for j in range(CORE_SIZE, xi.shape[0]):
        decaying = decaying or decay_rate[j] > 0.0
    sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
    i = first
    while i < end and now < target:
        stop = min(times[i], target)
        if stop > now:
            h = (stop - now) * 1e-9
            silent = i > 0 and times[i] - times[i - 1] > gap_ns
            compensate(samples, i, estimate, rate, force)
            if i > 1 and not silent and times[i - 1] - times[i - 2] <= gap_ns:
                between = 2e9 / (times[i] - times[i - 2])
                for j in range(3):
                    rate_slope[j] = (samples[i, j] - samples[i - 1, j]) * between
                    force_slope[j] = (samples[i, 3 + j] - samples[i - 1, 3 + j]) * between
            else:
                rate_slope[:] = 0.0
                force_slope[:] = 0.0
            strapdown_step(nav, rate, force, rate_slope, force_slope, h, hold_height, step)
            coefficients(nav, step, h, c)
            propagate_covariance(
                cov,
                step,
                c,
                h,
                active,
                sensor_terms,
                noise,
                work,
            )
            if carry:
                propagate_error(dx, step, c, h, active, sensor_slot, sensor_kind, decay_rate, work)
            if decaying:
                for j in range(CORE_SIZE, xi.shape[0]):
                    if decay_rate[j] > 0.0:
                        xi[j] *= math.exp(-h * decay_rate[j])
                sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
            if silent:
                # The held sample is a guess: its error acts over the whole of the gap.
                whole = (times[i] - times[i - 1]) * 1e-9
                for r in range(CORE_SIZE):
                    if not active[r]:
                        continue
                    if r < 3:
                        cov[r, r] += GAP_RATE_RAD_S**2 * whole * h
                    elif r < 6:
                        cov[r, r] += GAP_FORCE_M_S2**2 * whole * h
                    else:
                        cov[r, r] += 0.25 * GAP_FORCE_M_S2**2 * whole**3 * h
        now = stop
        if now == times[i]:
            if record:
                for j in range(NAV_SIZE):
                    nav_out[i, j] = nav[j]
                sigmas(cov, step, sigma_out[i])
            i += 1
    return i, now


@compiled("f8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])")
def normalised_innovation_squared(cov: Array, z: Array, h: Array, r: Array, y: Array) -> float:
    """nu^T S^-1 nu for z (m,), h (m, n), r (m,) variances; S = H P H^T + diag(r) = L L^T.

    `y` (m,) is left as the whitened innovation L^-1 z.

    Computed row by row with a covariance that shrinks as the update's would: the same number
    without forming S^-1 (Bierman, section V.2), but on a copy.
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
        for b in range(m):
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


@compiled("void(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])")
def update(cov: Array, dx: Array, z: Array, h: Array, r: Array) -> None:
    """Fold rows z = h dx + noise (variances r) into `dx` (n,) and `cov` (n, n), in place."""
    n = dx.shape[0]
    u, k = np.empty(n), np.empty(n)
    for a in range(z.shape[0]):
        u[:] = 0.0
        innovation = z[a]
        for i in range(n):
            c = h[a, i]
            if c != 0.0:
                innovation -= c * dx[i]
                for j in range(n):
                    u[j] += c * cov[i, j]
        s = r[a]
        for i in range(n):
            s += h[a, i] * u[i]
        hk = 0.0
        for i in range(n):
            k[i] = u[i] / s
            hk += h[a, i] * k[i]
            dx[i] += k[i] * innovation
        # T = (I - k h) P = P - k u^T;  T h^T = u (1 - h k);  P = T - T h^T k^T + k r k^T.
        c = (1.0 - hk) * s
        for i in range(n):
            for j in range(i + 1):
                value = cov[i, j] - k[i] * u[j] - c * k[i] * k[j] + r[a] * k[i] * k[j]
                cov[i, j] = value
                cov[j, i] = value


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
    "f8(f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8, b1, f8[::1])"
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
