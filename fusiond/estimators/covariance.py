r"""Compiled kernels: an interval's effect on covariance, transition matrix and error estimate.

Covariance over one interval h, P in blocks of navigation errors (1) and parameters (2), the
transition M (9 rows), the transition T of the parameters (decay of Markov states; an offset o whose
rate d is a state, o <- o + h d):

    P11 <- M P M^T,   P12 <- M P T^T,   P22 <- T P22 T^T
    P <- P + q diag(W h + s^2 (1 - D^2)),  half of the W h of the navigation errors before, half
    after

W the white noise (trapezoid rule), s the steady sigma of Markov states, q a factor on all noise (1,
or 1 / beta in a federated filter's local filters).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import (
    CORE_SIZE,
    CORE_STRIDE,
    apply_for,
    apply_to_core,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


# Before the factors of `decays`: the interval that they are of.
_KEPT = 1


def work_size(width: int) -> int:
    """Doubles of work space that the kernels of a row width need, zero at first; `decays` at its
    end."""
    return (6 + 9 + CORE_STRIDE) * width + (6 + 9) * CORE_STRIDE + 12 + _KEPT + width


@cache
def _gather_for(width: int) -> Callable[[Array, Indices, Array, Array], None]:
    """`gather` for rows of `width` doubles: a constant, so that the loops become vector code."""
    unsigned = np.uint64  # an index that cannot be negative needs no check
    wide = np.uint64(width)

    @compiled("void(f8[::1], i8[::1], f8[::1], f8[::1])", variant=width, forceinline=True)
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


@cache
def _advance_for(width: int) -> Callable[..., None]:
    """`advance` for rows of `width` doubles."""
    gather, apply = _gather_for(width), apply_for(width)

    @compiled(
        "void(f8[::1], i8[::1], f8[::1], f8[::1], b1[::1], f8[::1], f8[::1])",
        variant=width,
        forceinline=True,
    )
    def advance(
        rows: Array,
        sensor_slot: Indices,
        weight: Array,
        c: Array,
        active: NDArray[np.bool_],
        sensor: Array,
        out: Array,
    ) -> None:
        """out (9 rows) = transition times `rows`; what is not `active` is zero.

        All flat. `sensor` (6 rows) is work space.
        """
        gather(rows, sensor_slot, weight, sensor)
        apply(rows, sensor, c, out)
        for i in range(CORE_SIZE):
            if not active[i]:
                for j in range(width):
                    out[i * width + j] = 0.0

    return advance


_advance_core = _advance_for(CORE_STRIDE)


@compiled("void(f8[::1], i8[:, ::1], f8[::1])", forceinline=True)
def _weights(step: Array, sensor_terms: Indices, weight: Array) -> None:
    """Write `weight` (12,): by how much each parameter acts on its axis error, `step` (21,)."""
    for i in range(12):
        weight[i] = 0.0
        if sensor_terms[1, i] == PLAIN:
            weight[i] = 1.0
        elif sensor_terms[1, i] == SCALE:
            weight[i] = step[3 + i // 2]


@compiled("f8[::1](f8, f8[::1], i8, f8[::1])", forceinline=True)
def decays(h: float, decay_rate: Array, width: int, work: Array) -> Array:
    """What each parameter (n,) decays by in h seconds, 1 where it does not.

    Kept in `work` from one interval to the next, which is most often as long: an exponential a
    state, and one more for its estimate, cost a tenth of an interval.
    """
    kept = work[work.shape[0] - width - _KEPT :]
    if kept[0] != h:
        kept[0] = h
        for i in range(decay_rate.shape[0]):
            kept[_KEPT + i] = math.exp(-h * decay_rate[i]) if decay_rate[i] > 0.0 else 1.0
    return kept[_KEPT:]


@cache
def covariance_for(width: int) -> Callable[..., None]:
    """`propagate_covariance` for matrices of `width` rows."""
    end, advance = work_size(width) - width - _KEPT - 12, _advance_for(width)

    @compiled(
        "void(f8[:, ::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[:, ::1], f8[:, ::1], f8,"
        "f8[::1])",
        variant=width,
    )
    def propagate_covariance(
        cov: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        q: float,
        work: Array,
    ) -> None:
        """Advance `cov` (width, width) in place by h seconds with transition coefficients `c`.

        The model's arrays are (n,); rows and columns of `cov` from n on are zero and stay so.
        """
        decay_rate, white, steady_variance = noise[0], noise[1], noise[2]
        sensor_slot = sensor_terms[0]
        n = white.shape[0]
        flat = cov.reshape(width * width)
        weight = work[end : end + 12]
        _weights(step, sensor_terms, weight)
        a = 6 * width
        b = a + 9 * width
        d = b + width * CORE_STRIDE
        e = d + 6 * CORE_STRIDE
        sensor, top, turned = work[:a], work[a:b], work[b:d]
        core_sensor, core = work[d:e], work[e:end]
        half = 0.5 * h * q
        for i in range(CORE_SIZE):
            flat[i * width + i] += half * white[i]

        advance(flat, sensor_slot, weight, c, active, sensor, top)
        for j in range(width):
            for i in range(CORE_SIZE):
                turned[j * CORE_STRIDE + i] = top[i * width + j]
        # Written back before `turned` is read again: its scalar stores are done by then.
        for i in range(CORE_SIZE):
            for j in range(width):
                flat[i * width + j] = top[i * width + j]
        for j in range(CORE_SIZE, width):
            for i in range(CORE_SIZE):
                flat[j * width + i] = top[i * width + j]
        _advance_core(turned, sensor_slot, weight, c, active, core_sensor, core)
        for i in range(CORE_SIZE):
            for j in range(CORE_SIZE):
                lower, upper = core[i * CORE_STRIDE + j], core[j * CORE_STRIDE + i]
                flat[i * width + j] = 0.5 * (lower + upper)
            flat[i * width + i] += half * white[i]
        for k in range(rate_terms.shape[1]):
            offset, rate = rate_terms[0, k], rate_terms[1, k]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
            for j in range(width):
                flat[j * width + offset] += h * flat[j * width + rate]
        factors = decays(h, decay_rate, width, work)
        for i in range(CORE_SIZE, n):
            variance = q * h * white[i]
            if decay_rate[i] > 0.0:
                decay = factors[i]
                for j in range(width):
                    flat[i * width + j] *= decay
                    flat[j * width + i] *= decay
                variance += q * steady_variance[i] * (1.0 - decay * decay)
            flat[i * width + i] += variance

    return propagate_covariance


@cache
def transition_for(width: int) -> Callable[..., None]:
    """`propagate_transition` for matrices of `width` rows."""
    end, advance = work_size(width) - width - _KEPT - 12, _advance_for(width)

    @compiled(
        "void(f8[:, ::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[:, ::1], f8[:, ::1],"
        "f8[::1])",
        variant=width,
    )
    def propagate_transition(
        phi: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
    ) -> None:
        """phi (width, width) <- transition over h seconds times phi."""
        decay_rate = noise[0]
        flat = phi.reshape(width * width)
        weight = work[end : end + 12]
        _weights(step, sensor_terms, weight)
        sensor, top = work[: 6 * width], work[6 * width : 15 * width]
        advance(flat, sensor_terms[0], weight, c, active, sensor, top)
        for i in range(CORE_SIZE * width):
            flat[i] = top[i]
        for k in range(rate_terms.shape[1]):
            offset, rate = rate_terms[0, k], rate_terms[1, k]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
        factors = decays(h, decay_rate, width, work)
        for i in range(CORE_SIZE, decay_rate.shape[0]):
            if decay_rate[i] > 0.0:
                decay = factors[i]
                for j in range(width):
                    flat[i * width + j] *= decay

    return propagate_transition


@compiled("void(f8[::1], f8, i8[:, ::1], f8[::1])", forceinline=True)
def propagate_parameters(x: Array, h: float, rate_terms: Indices, factors: Array) -> None:
    """x (n,), parameters or their errors, over h seconds: offsets grow, Markov states decay by
    `factors` (`decays`)."""
    for k in range(rate_terms.shape[1]):
        x[rate_terms[0, k]] += h * x[rate_terms[1, k]]
    for i in range(CORE_SIZE, x.shape[0]):
        x[i] *= factors[i]


@compiled(
    "void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[:, ::1], f8[::1], i8, f8[::1])"
)
def propagate_error(
    dx: Array,
    step: Array,
    c: Array,
    h: float,
    active: NDArray[np.bool_],
    sensor_terms: Indices,
    rate_terms: Indices,
    decay_rate: Array,
    width: int,
    work: Array,
) -> None:
    """dx (n,) <- Phi dx over h seconds: an estimate that is not fed back yet (paper 000, 1.1).

    `work` as for rows of `width`.
    """
    sensor = work[: 6 * CORE_STRIDE]
    rows = work[6 * CORE_STRIDE : 15 * CORE_STRIDE]
    out = work[15 * CORE_STRIDE : 24 * CORE_STRIDE]
    weight = work[24 * CORE_STRIDE : 24 * CORE_STRIDE + 12]
    _weights(step, sensor_terms, weight)
    sensor[:] = 0.0
    for i in range(12):
        sensor[i // 2 * CORE_STRIDE] += weight[i] * dx[sensor_terms[0, i]]
    rows[:] = 0.0
    for i in range(CORE_SIZE):
        rows[i * CORE_STRIDE] = dx[i]
    apply_to_core(rows, sensor, c, out)
    for i in range(CORE_SIZE):
        dx[i] = out[i * CORE_STRIDE] if active[i] else 0.0
    propagate_parameters(dx, h, rate_terms, decays(h, decay_rate, width, work))
