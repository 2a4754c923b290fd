"""Compiled kernels: propagation of the navigation state and its error statistics over IMU samples.

The loop over samples lives here; what an interval does to a covariance is in
fusiond.estimators.covariance. One pass carries a bank of covariances and error estimates along one
navigation state, for filters that keep several, and a transition matrix where a filter asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance import (
    covariance_for,
    kept_part,
    mirror,
    propagate_error,
    propagate_parameters,
    transition_for,
    work_size,
)
from fusiond.estimators.reading import WIDER, in_fix_time, sigmas, widen
from fusiond.models.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import COEFFICIENTS, CORE_SIZE, WIDTHS, coefficients
from fusiond.navigation.imu_buffer import ROW_SIZE
from fusiond.navigation.rotation import rpy_from_quaternion
from fusiond.navigation.strapdown import NAV_SIZE, Q0, STEP_DCM, STEP_SIZE, strapdown_step

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# What the vehicle may do while the IMU is silent, one sigma of the mean rate (rad/s) and force
# (m/s^2) against the sample that is held: a car that turns or brakes at a comfortable limit. Real
# drives showed up to 0.09 rad/s (pitch, an engine that shakes the IMU) and 0.12 rad/s (yaw, 4 s in
# town) and 0.4 to 0.8 m/s^2 RMS over silences of 0.05 to 4 s, with single ones of four times that.
GAP_RATE_RAD_S = 0.1
GAP_FORCE_M_S2 = 1.0


# What a propagation does beside the usual, added up.
HOLD_HEIGHT, RECORD, CARRY, TURN_TILT = 1, 2, 4, 8
# Cosine of the tilt beyond which no accelerometer is the vertical one.
UPRIGHT = 0.5


def scratch_size(width: int) -> int:
    """Doubles of `propagate`'s scratch for a row width."""
    return COEFFICIENTS + 24 + work_size(width)


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


@compiled("b1(i8[::1], f8[:, ::1], i8, i8, f8[::1], f8[::1])", forceinline=True)
def slopes(
    times: Indices, samples: Array, i: int, gap_ns: int, rate_slope: Array, force_slope: Array
) -> bool:
    """Write the slopes (3,), a second, of rate and force over sample i; whether a gap precedes it.

    Zero where the sample before holds over another length of time: beside a gap, at the start.
    """
    silent = i > 0 and times[i] - times[i - 1] > gap_ns
    if i > 1 and not silent and times[i - 1] - times[i - 2] <= gap_ns:
        between = 2e9 / (times[i] - times[i - 2])
        for j in range(3):
            rate_slope[j] = (samples[i, j] - samples[i - 1, j]) * between
            force_slope[j] = (samples[i, 3 + j] - samples[i - 1, 3 + j]) * between
    else:
        for j in range(3):
            rate_slope[j] = 0.0
            force_slope[j] = 0.0
    return silent


@compiled("void(f8[::1], i8, b1[::1], f8, f8)", forceinline=True)
def widen_for_gap(
    cov: Array, width: int, active: NDArray[np.bool_], whole: float, h: float
) -> None:
    """Add to `cov`, flat and of `width` rows, what h seconds of an IMU silence of `whole` seconds
    leave unknown."""
    for r in range(CORE_SIZE):
        if not active[r]:
            continue
        at = r * width + r
        if r < 3:
            cov[at] += GAP_RATE_RAD_S**2 * whole * h
        elif r < 6:
            cov[at] += GAP_FORCE_M_S2**2 * whole * h
        else:
            cov[at] += 0.25 * GAP_FORCE_M_S2**2 * whole**3 * h


@compiled("void(f8[::1], i8, b1[::1], f8[::1], f8[:, ::1], i8, f8)", forceinline=True)
def shake(
    cov: Array,
    width: int,
    active: NDArray[np.bool_],
    step: Array,
    densities: Array,
    row: int,
    h: float,
) -> None:
    """Add to `cov`, flat and of `width` rows, what h seconds of noise of a row of `densities`
    (m, 6), body axes, leave: C diag(n) C^T h."""
    for first in (0, 3):
        if densities[row, first] + densities[row, first + 1] + densities[row, first + 2] == 0.0:
            continue
        for i in range(3):
            for j in range(3):
                if active[first + i] and active[first + j]:
                    total = 0.0
                    for k in range(3):
                        a, b = step[STEP_DCM + 3 * i + k], step[STEP_DCM + 3 * j + k]
                        total += a * b * densities[row, first + k]
                    cov[(first + i) * width + first + j] += h * total


@compiled("void(f8[::1], i8, f8)", forceinline=True)
def turn_tilt(cov: Array, width: int, known: float) -> None:
    """Add to `cov`, flat and of `width` rows, what a turn does to the axes of a tilt, if nobody
    knows whether it was one: the heading's variance was `known` (rad^2) before it
    (fusiond.estimators.tilt_axes)."""
    grown = cov[2 * width + 2] - known
    if grown > 0.0:
        north, east, both = cov[0], cov[width + 1], cov[1]
        cov[0] += grown * east
        cov[width + 1] += grown * north
        cov[1] -= grown * both
        cov[width] = cov[1]


@compiled("void(f8[::1], i8, f8[::1], i8[::1], i8[::1], f8, f8)", forceinline=True)
def turn_down(
    cov: Array,
    width: int,
    step: Array,
    sensor_slot: Indices,
    sensor_kind: Indices,
    grown_north: float,
    grown_east: float,
) -> None:
    """Add to `cov`, flat and of `width` rows, what a tilt that only the gyros' errors have made
    does to the vertical force: variances (rad^2) that a tilt has `grown` by, times those of the
    force biases across (fusiond.estimators.tilt_axes)."""
    upright = step[STEP_DCM + 8]
    north, east, vertical = 0.0, 0.0, -1
    for i in range(6, 12):
        if sensor_kind[i] != PLAIN:
            continue
        row = sensor_slot[i] * width
        if i // 2 == 5:
            vertical = sensor_slot[i]
        for k in range(6, 12):
            if sensor_kind[k] == PLAIN:
                p = cov[row + sensor_slot[k]]
                a, b = STEP_DCM + i // 2 - 3, STEP_DCM + k // 2 - 3
                north += step[a] * step[b] * p
                east += step[a + 3] * step[b + 3] * p
    if vertical >= 0 and abs(upright) >= UPRIGHT:
        more = max(grown_north, 0.0) * east + max(grown_east, 0.0) * north
        cov[vertical * width + vertical] += more / (upright * upright)


@compiled(
    "void(f8[::1], f8[::1], f8[::1], f8[:, ::1], i8, f8[::1], f8, b1, i8, f8[::1])", allocates=True
)
def published_ahead(
    nav: Array,
    xi: Array,
    step: Array,
    samples: Array,
    newest: int,
    estimate: Array,
    ahead_s: float,
    hold_height: bool,
    time_slot: int,
    out: Array,
) -> None:
    """Write `out` (13,): what `in_fix_time` makes of `nav` (10,) `ahead_s` later, while sample
    `newest` less `estimate` (12,) holds, and its roll, pitch and yaw."""
    if ahead_s > 0.0:
        nav = nav.copy()
        rate, force, zero = np.empty(3), np.empty(3), np.zeros(3)
        compensate(samples, newest, estimate, rate, force)
        strapdown_step(nav, rate, force, zero, zero, ahead_s, hold_height, np.zeros(STEP_SIZE))
    published = out[:NAV_SIZE]
    in_fix_time(nav, xi, step, time_slot, published)
    w, x, y, z = out[Q0], out[Q0 + 1], out[Q0 + 2], out[Q0 + 3]
    out[NAV_SIZE], out[NAV_SIZE + 1], out[NAV_SIZE + 2] = rpy_from_quaternion(w, x, y, z)


@cache
def propagate_for(width: int) -> Callable[..., tuple[int, int]]:
    """`propagate` for covariances of `width` rows."""
    propagate_covariance, propagate_transition = covariance_for(width), transition_for(width)
    worked, scratched = work_size(width), scratch_size(width)

    @compiled(
        "UniTuple(i8, 2)(f8[::1], f8[:, :, ::1], f8[:, ::1], f8[::1], f8[:, ::1], u1[::1], f8[::1],"
        "i8, i8, i8, i8, i8, i8)",
        variant=width,
    )
    def propagate(
        state: Array,
        covs: Array,
        dxs: Array,
        shares: Array,
        phi: Array,
        model: NDArray[np.uint8],
        imu: Array,
        first: int,
        end: int,
        now: int,
        target: int,
        gap_ns: int,
        options: int,
    ) -> tuple[int, int]:
        """Propagate from `now` to `target` (ns); return the next sample's index and the new time.

        A call costs 25 ns an argument: what belongs together comes as one.
        `state` is scratch_size(width) doubles, zero at first, nav (10,), xi (n,), the last step
        (27,), the variances (9,) that what is published is wider by, and `Published`; `model` and
        `imu` are `Model.packed` and `ImuBuffer.packed`. Of the IMU's m rows `times` and `samples`
        (rate, force): sample i holds over (times[i-1], times[i]], with noise of `densities` beyond
        `noise`. Samples first ... end-1 may be used; the last one only as far as `target`, so a
        target inside an interval splits it. `options` are HOLD_HEIGHT, RECORD, with which the
        solution and the sigmas of covariance 0 at the end of each whole sample go into the IMU's
        rows, CARRY, with which the error estimates `dxs` (k, n) are propagated too,
        and TURN_TILT, with which a turn that is not known turns the axes of a tilt. `covs`
        (k, width, width) are covariances, their noise divided by `shares` (k,). `phi`
        (width, width) is propagated unless it is (0, 0).
        """
        hold_height = (options & HOLD_HEIGHT) != 0
        record, carry = (options & RECORD) != 0, (options & CARRY) != 0
        turning = (options & TURN_TILT) != 0
        n, m = dxs.shape[1], imu.shape[0] // ROW_SIZE
        work, scratch, rest = state[:worked], state[worked:scratched], state[scratched:]
        nav, xi = rest[:NAV_SIZE], rest[NAV_SIZE : NAV_SIZE + n]
        step = rest[NAV_SIZE + n : NAV_SIZE + n + STEP_SIZE]
        wider = rest[NAV_SIZE + n + STEP_SIZE : NAV_SIZE + n + STEP_SIZE + WIDER]
        by = NAV_SIZE + n + STEP_SIZE + WIDER
        time_slot, clock_sd_s, axes_sd_rad = int(rest[by]), rest[by + 1], rest[by + 2]
        noise = model[: 24 * n].view(np.float64).reshape((3, n))
        sensor_terms = model[24 * n : 24 * n + 192].view(np.int64).reshape((2, 12))
        rates = model[24 * n + 192 : model.shape[0] - n].view(np.int64)
        rate_terms = rates.reshape((2, rates.shape[0] // 2))
        active = model[model.shape[0] - n :].view(np.bool_)
        times = imu[:m].view(np.int64)
        samples, densities = imu[m : 7 * m].reshape((m, 6)), imu[7 * m : 13 * m].reshape((m, 6))
        nav_out = imu[13 * m : 23 * m].reshape((m, 10))
        sigma_out = imu[23 * m :].reshape((m, 9))
        sensor_slot, sensor_kind = sensor_terms[0], sensor_terms[1]
        c = scratch[:COEFFICIENTS]
        kept = kept_part(work, width)
        flats, first_cov = covs.reshape((covs.shape[0], width * width)), covs[0]
        flat_phi = phi.reshape(phi.size)
        rate, force = (
            scratch[COEFFICIENTS : COEFFICIENTS + 3],
            scratch[COEFFICIENTS + 3 : COEFFICIENTS + 6],
        )
        rate_slope = scratch[COEFFICIENTS + 6 : COEFFICIENTS + 9]
        force_slope = scratch[COEFFICIENTS + 9 : COEFFICIENTS + 12]
        estimate = scratch[COEFFICIENTS + 12 : COEFFICIENTS + 24]
        decaying = rate_terms.shape[1] > 0
        for j in range(CORE_SIZE, xi.shape[0]):
            decaying = decaying or noise[0, j] > 0.0
        sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
        i = first
        while i < end and now < target:
            stop = min(times[i], target)
            if stop > now:
                h = (stop - now) * 1e-9
                silent = slopes(times, samples, i, gap_ns, rate_slope, force_slope)
                compensate(samples, i, estimate, rate, force)
                strapdown_step(nav, rate, force, rate_slope, force_slope, h, hold_height, step)
                coefficients(nav, step, h, c)
                # The held sample of a gap is a guess: its error acts over the whole of it.
                whole = (times[i] - times[i - 1]) * 1e-9 if silent else 0.0
                for k in range(covs.shape[0]):
                    cov, q = flats[k], 1.0 / shares[k]
                    known = cov[2 * width + 2]
                    north, east = cov[0], cov[width + 1]
                    propagate_covariance(
                        cov,
                        step,
                        c,
                        h,
                        active,
                        sensor_terms,
                        rate_terms,
                        noise,
                        q,
                        work,
                    )
                    shake(cov, width, active, step, densities, i, h / shares[k])
                    if silent:
                        widen_for_gap(cov, width, active, whole, h / shares[k])
                    if turning:
                        grown_north, grown_east = cov[0] - north, cov[width + 1] - east
                        turn_tilt(cov, width, known)
                        turn_down(
                            cov,
                            width,
                            step,
                            sensor_slot,
                            sensor_kind,
                            grown_north,
                            grown_east,
                        )
                if phi.shape[0]:
                    propagate_transition(
                        flat_phi,
                        step,
                        c,
                        h,
                        active,
                        sensor_terms,
                        rate_terms,
                        noise,
                        work,
                    )
                if carry:
                    for k in range(dxs.shape[0]):
                        propagate_error(
                            dxs[k],
                            step,
                            c,
                            h,
                            active,
                            sensor_terms,
                            rate_terms,
                            kept,
                            work,
                        )
                if decaying:
                    propagate_parameters(xi, h, rate_terms, kept)
                    sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
            now = stop
            if now == times[i]:
                if record:
                    in_fix_time(nav, xi, step, time_slot, nav_out[i])
                    out = sigma_out[i]
                    sigmas(first_cov, nav, step, time_slot, clock_sd_s, axes_sd_rad, out)
                    widen(wider, out)
                i += 1
        for k in range(covs.shape[0]):
            mirror(flats[k], width, n)
        return i, now

    return propagate


# Compiled, or loaded from the cache, when this module is imported: never inside a navigation loop.
for _width in WIDTHS:
    propagate_for(_width)
