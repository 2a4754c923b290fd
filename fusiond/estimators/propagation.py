"""Compiled kernels: propagation of the navigation state and its error statistics over IMU samples.

This module has the loop over samples; fusiond.estimators.covariance_propagation has the covariance
over an interval. One pass propagates one navigation state with a bank of covariances and error
estimates, and a transition matrix if a filter requests it.

An attitude error turns the sensed force, but for a vehicle known to rest only gravity: the sensed
force north and east is noise. Otherwise a heading error would turn that noise like motion, and each
zero velocity would add false information on the heading: up to 1 / rad^2 for an effective interval
of about four seconds, 5 deg would become 4.4 deg after 200 s at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.corrected_imu import compensate, sensor_estimates, slopes
from fusiond.estimators.covariance_propagation import (
    decays,
    mirror,
    propagate_error,
    propagate_parameters,
    transition_for,
    work_size,
)
from fusiond.estimators.fault_carried import carry_for, settle
from fusiond.estimators.multi_sample_covariance import (
    DENSITIES,
    GRID_NS,
    SPAN,
    STEPS,
    add_up,
    cross_for,
)
from fusiond.estimators.published_state import (
    ENTRIES,
    WIDER,
    entries,
    in_fix_time,
    moving,
    sigmas_of,
    widen,
)
from fusiond.estimators.sigmas_between_covariance_steps import (
    ROW,
    ROWS,
    WAITING,
    begin,
    fill,
    first_order,
)
from fusiond.estimators.sigmas_between_covariance_steps import SIZE as BETWEEN
from fusiond.estimators.state_array import (
    AHEAD,
    BANK,
    GAP,
    LINE,
    NAV_AT,
    PUBLISHED_AT,
    RECORDED,
    ROOM,
    SIZE,
    STEP_AT,
    SUMS_AT,
    TRANSITION,
    USED,
    WIDER_AT,
    XI_AT,
    scratch_size,
)
from fusiond.estimators.tilt_axes_propagation import rest_rows, turn_at_rest
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import COEFFICIENTS, CORE_SIZE, WIDTHS, coefficients
from fusiond.navigation.imu_buffer import END, HEAD_SIZE, HOLD, ROW_SIZE, START
from fusiond.navigation.rotation import rpy_from_quaternion
from fusiond.navigation.strapdown import (
    NAV_SIZE,
    Q0,
    STEP_FORCE_N,
    STEP_RESTS_S,
    STEP_SIZE,
    strapdown_step,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# What a propagation does beside the usual, added up.
HOLD_HEIGHT, RECORD, CARRY, TURN_TILT, PASSING = 1, 2, 4, 8, 16


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
    """Write `out` (13,): `nav` (10,) extrapolated by `ahead_s` with sample `newest` minus
    `estimate` (12,), converted by `in_fix_time`, and its roll, pitch and yaw."""
    if ahead_s > 0.0:
        nav = nav.copy()
        rate, force, zero = np.empty(3), np.empty(3), np.zeros(3)
        compensate(samples.reshape(samples.size), newest, estimate, rate, force)
        strapdown_step(nav, rate, force, zero, zero, ahead_s, hold_height, np.zeros(STEP_SIZE))
    published = out[:NAV_SIZE]
    in_fix_time(nav, xi, step, time_slot, published)
    w, x, y, z = out[Q0], out[Q0 + 1], out[Q0 + 2], out[Q0 + 3]
    out[NAV_SIZE], out[NAV_SIZE + 1], out[NAV_SIZE + 2] = rpy_from_quaternion(w, x, y, z)


@cache
def propagate_for(width: int) -> Callable[..., tuple[int, int]]:
    """`propagate` for covariances of `width` rows."""
    cross, propagate_transition = cross_for(width), transition_for(width)
    carry_hypotheses = carry_for(width)
    worked, scratched, square = work_size(width), scratch_size(width), width * width

    @compiled(
        "void(b1, b1, f8, b1, i8, i8, i8, f8[::1], f8[::1], f8[::1], f8[::1], i8, f8, f8, f8, i8,"
        " f8[::1], f8[::1], i8, f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], b1, b1[::1], i8[::1],"
        " i8[::1], f8[::1], f8[::1])",
        variant=width,
        forceinline=True,
    )
    def bring(
        ahead: bool,
        keep: bool,
        silence: float,
        rests: bool,
        count: int,
        i: int,
        now: int,
        bank: Array,
        between: Array,
        sigma_out: Array,
        wider: Array,
        time_slot: int,
        clock_sd_s: float,
        axes_sd_rad: float,
        q: float,
        of: int,
        covs: Array,
        held: Array,
        used: int,
        shares: Array,
        nav: Array,
        sums: Array,
        c: Array,
        turn: Array,
        turning: bool,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
    ) -> None:
        """Cross covariances, and the sigmas of the `count` samples before row i.

        Those sigmas have waited for `cross`; the covariance begins `of` doubles behind the
        first."""
        span = sums[SPAN]
        if count:
            whole = between[2 * ENTRIES : 3 * ENTRIES]
            first_order(between, q, sums, noise, sensor_terms, time_slot, whole)
        cross(
            ahead,
            keep,
            silence,
            rests,
            covs,
            held,
            used,
            shares,
            nav,
            sums,
            c,
            turn,
            turning,
            active,
            sensor_terms,
            rate_terms,
            noise,
            work,
        )
        if bank.size and not keep:
            carry_hypotheses(
                *(bank, now, nav, sums, span, c, rests, turn),
                *(active, sensor_terms, rate_terms, noise, work),
            )
        if count:
            reached = between[ENTRIES : 2 * ENTRIES]
            entries(covs[of:], width, time_slot, clock_sd_s, reached)
            fill(between, count, span, axes_sd_rad, wider, sigma_out, i)

    @compiled("UniTuple(i8, 2)(f8[::1], f8[::1], i8, i8, i8, i8)", variant=width)
    def propagate(
        state: Array, imu: Array, sample: int, now: int, target: int, options: int
    ) -> tuple[int, int]:
        """Propagate from `now` to `target` (ns); return the next sample's number and the new time.

        `state` is `Memory.array` and `imu` `ImuBuffer.packed`. Of the IMU's rows `times` and
        `samples` (rate, force): row i holds over (times[i-1], times[i]], with noise of `densities`
        beyond `noise`. Samples from `sample` on may be used; the last one only as far as `target`,
        so a target inside an interval splits it. `options` are HOLD_HEIGHT, RECORD, with which the
        solution and a covariance's sigmas at the end of each whole sample go into the IMU's rows,
        CARRY, with which the error estimates are propagated, too, TURN_TILT, with which an unknown
        turn rotates the axes of a tilt, and PASSING, without an update at `target`: covariances are
        computed there, but continue from their earlier state. The noise of each covariance is
        divided by its share.
        """
        hold_height = (options & HOLD_HEIGHT) != 0
        record, carry = (options & RECORD) != 0, (options & CARRY) != 0
        turning, passing = (options & TURN_TILT) != 0, (options & PASSING) != 0
        head, imu_head = state[:LINE].view(np.int64), imu[:HEAD_SIZE].view(np.int64)
        n, room, used = head[SIZE], head[ROOM], head[USED]
        gap_ns = min(head[GAP], imu_head[HOLD])
        start, end = imu_head[START], imu_head[END]
        wider, by = state[WIDER_AT : WIDER_AT + WIDER], state[PUBLISHED_AT:WIDER_AT]
        time_slot, clock_sd_s, axes_sd_rad = int(by[0]), by[1], by[2]
        nav, step, sums = state[NAV_AT:STEP_AT], state[STEP_AT:SUMS_AT], state[SUMS_AT:XI_AT]
        upto = XI_AT + n + room * n
        xi, dxs = state[XI_AT : XI_AT + n], state[XI_AT + n : upto]
        rest = state[(upto + LINE - 1) // LINE * LINE :]
        covs, rest = rest[: room * square], rest[room * square :]
        bank, rest = rest[: head[BANK]], rest[head[BANK] :]
        held, rest = rest[: room * square], rest[room * square :]
        of, transition = head[RECORDED] * square, head[TRANSITION]
        phi, rest = rest[: transition * square], rest[transition * square :]
        work, scratch, rest = rest[:worked], rest[worked:scratched], rest[scratched:]
        shares, model = rest[:room], rest[room:]
        noise, sensor_terms = model[: 3 * n], model[3 * n : 3 * n + 24].view(np.int64)
        flags = model.shape[0] - (n + 7) // 8
        rate_terms, active = model[3 * n + 24 : flags].view(np.int64), model[flags:].view(np.bool_)
        rows = imu[HEAD_SIZE:]
        m = rows.shape[0] // ROW_SIZE
        times = rows[:m].view(np.int64)
        samples, densities = rows[m : 7 * m], rows[7 * m : 13 * m]
        nav_out, sigma_out = rows[13 * m : 23 * m], rows[23 * m :]
        sensor_slot, sensor_kind = sensor_terms[:12], sensor_terms[12:]
        c, scratch = scratch[:COEFFICIENTS], scratch[COEFFICIENTS:]
        rate, force, rate_slope, force_slope = (
            scratch[:3],
            scratch[3:6],
            scratch[6:9],
            scratch[9:12],
        )
        estimate, turn = scratch[12:24], scratch[24:29]
        between, kept = scratch[29 : 29 + BETWEEN], scratch[29 + BETWEEN :]
        reached = between[ENTRIES : 2 * ENTRIES]
        mean = sums[STEPS:DENSITIES]
        decaying = rate_terms.shape[0] > 0
        for j in range(CORE_SIZE, n):
            decaying = decaying or noise[j] > 0.0
        sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
        q = 1.0 / shares[head[RECORDED]]
        given = (
            bank,
            between,
            sigma_out,
            wider,
            time_slot,
            clock_sd_s,
            axes_sd_rad,
            q,
            of,
            covs,
            held,
            used,
            shares,
            nav,
            sums,
            c,
            turn,
            turning,
            active,
            sensor_terms,
            rate_terms,
            noise,
            work,
        )
        alone, count = carry or transition != 0, 0
        ahead, there = head[AHEAD] != 0, head[AHEAD] != 0
        i = sample - start
        while i < end and now < target:
            stop = min(times[i], target)
            if stop > now:
                h = (stop - now) * 1e-9
                silent = slopes(times, samples, i, gap_ns, rate_slope, force_slope)
                compensate(samples, i, estimate, rate, force)
                rests = turning and step[STEP_RESTS_S] > 0.0
                single = alone or silent or rests
                if single and sums[SPAN] > 0.0:  # what came before is no part of it
                    bring(ahead, False, 0.0, False, count, i, now, *given)
                    ahead, count = False, 0
                w, x, y, z = nav[Q0], nav[Q0 + 1], nav[Q0 + 2], nav[Q0 + 3]
                strapdown_step(nav, rate, force, rate_slope, force_slope, h, hold_height, step)
                if step[STEP_RESTS_S] > 0.0:  # what is felt in north and east is noise
                    step[STEP_FORCE_N], step[STEP_FORCE_N + 1] = 0.0, 0.0
                add_up(sums, step, h, densities, i)
                there = False
                if rests:
                    turn_at_rest(w, x, y, z, nav[Q0:], turn)
                if single or stop // GRID_NS > now // GRID_NS:
                    # The held sample of a gap is a guess: its error acts over the whole of it.
                    silence = (times[i] - times[i - 1]) * 1e-9 if silent else 0.0
                    bring(ahead, False, silence, rests, count, i, stop, *given)
                    ahead, count = False, 0
                if decaying or carry:
                    decays(h, noise, width, kept)
                if transition:
                    propagate_transition(
                        phi, mean, c, h, active, sensor_terms, rate_terms, noise, work
                    )
                    if rests:
                        rest_rows(phi, width, width, turn, sensor_slot, sensor_kind)
                if carry:
                    for k in range(room):
                        dx = dxs[k * n : (k + 1) * n]
                        propagate_error(
                            dx, mean, c, h, active, sensor_terms, rate_terms, kept, work
                        )
                        if rests:
                            rest_rows(dx, 1, 1, turn, sensor_slot, sensor_kind)
                if decaying:
                    propagate_parameters(xi, h, rate_terms, kept)
                    sensor_estimates(xi, sensor_slot, sensor_kind, estimate)
            now = stop
            if now == times[i]:
                if record:
                    in_fix_time(nav, xi, step, time_slot, nav_out[10 * i : 10 * i + 10])
                    if sums[SPAN] > 0.0:
                        if count == 0:
                            p = held[of:] if ahead else covs[of:]
                            begin(p, width, sensor_terms, time_slot, clock_sd_s, between)
                        waits = between[WAITING + ROW * count : WAITING + ROW * (count + 1)]
                        first_order(between, q, sums, noise, sensor_terms, time_slot, waits)
                        moving(nav, step, waits[ENTRIES:])
                        waits[ROW - 1] = sums[SPAN]
                        count += 1
                        if count == ROWS:
                            bring(ahead, True, 0.0, False, count, i + 1, now, *given)
                            ahead, there, count = True, True, 0
                    else:
                        entries(covs[of:], width, time_slot, clock_sd_s, reached)
                        moving(nav, step, scratch)
                        out = sigma_out[9 * i : 9 * i + 9]
                        sigmas_of(reached, scratch, axes_sd_rad, out)
                        widen(wider, out)
                i += 1
        if sums[SPAN] > 0.0:
            if not there:
                bring(ahead, passing, 0.0, False, count, i, now, *given)
            elif not passing:
                if bank.size:  # the covariances are there already
                    coefficients(nav, mean, sums[SPAN], c)
                    carry_hypotheses(
                        *(bank, now, nav, sums, sums[SPAN], c, False, turn),
                        *(active, sensor_terms, rate_terms, noise, work),
                    )
                sums[SPAN] = 0.0
        if bank.size and not passing:
            settle(bank, n)
        head[AHEAD] = sums[SPAN] > 0.0
        for k in range(used):
            mirror(covs[k * square : (k + 1) * square], width, n)
        return i + start, now

    return propagate


# Compiled, or loaded from the cache, when this module is imported: never inside a navigation loop.
for _width in WIDTHS:
    propagate_for(_width)
