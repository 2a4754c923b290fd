r"""Compiled kernels: propagation of state and covariance over IMU samples.

Covariance over one interval h, P in blocks of navigation errors (1) and parameters (2), the
transition M (9 rows) and the diagonal decay D of the parameters:

    P11 <- M P M^T,   P12 <- M P D,   P22 <- D P22 D
    P <- P + diag(W h + s^2 (1 - D^2)),  half of the W h of the navigation errors before, half after

W the white noise (trapezoid rule), s the steady sigma of Markov states.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import (
    COEFFICIENTS,
    CORE_SIZE,
    CORE_STRIDE,
    STRIDE,
    apply_to_core,
    apply_to_state,
    coefficients,
)
from fusiond.navigation.strapdown import (
    NAV_SIZE,
    STEP_DCM,
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
