r"""Compiled kernels: an interval's effect on covariance, transition matrix and error estimate.

Covariance over one interval h, P in blocks of navigation errors (1) and parameters (2), the
transition M (9 rows), the transition T of the parameters (decay of Markov states; an offset o whose
rate d is a state, o <- o + h d):

    P11 <- M P M^T,   P12 <- M P T^T,   P22 <- T P22 T^T
    P <- P + q diag(G),   G = W h + s^2 (1 - D^2),   half of it before, the rest after

W is the white noise (trapezoid rule; the first half decays in Markov states, so the second is
larger there), s the steady sigma of Markov states, D their decay, q a factor on all noise (1, or 1
/ beta in a federated filter's local filters). Between intervals only P12 is kept; `mirror` copies
it to P21 before P is read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import PLAIN, SCALE
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, CORE_STRIDE, apply_for, apply_to_core

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


# Where the factors of `decays` begin: behind the interval that they are of, and 1 if one of them is
# not 1; two more let them begin a line of the cache.
KEPT = 4


def work_size(width: int) -> int:
    """Doubles of the kernels' work space for a row width, zero at first; `decays` at its end."""
    return (6 + 9) * width + (9 + 6 + 9) * CORE_STRIDE + 12 + KEPT + 2 * width


@compiled("f8[::1](f8[::1], i8)", allocates=True)
def kept_part(work: Array, width: int) -> Array:
    """The part of `work` (work_size(width),) that `decays` writes."""
    return work[15 * width + 24 * CORE_STRIDE + 12 :]


@compiled("void(f8[::1], i8[::1], f8[::1])", forceinline=True)
def weights(step: Array, sensor_terms: Indices, weight: Array) -> None:
    """Write `weight` (12,): effect of each parameter on its axis error, by `step` (28,)."""
    for i in range(12):
        weight[i] = 0.0
        if sensor_terms[12 + i] == PLAIN:
            weight[i] = 1.0
        elif sensor_terms[12 + i] == SCALE:
            weight[i] = step[3 + i // 2]


@compiled("void(f8, f8[::1], i8, f8[::1])", forceinline=True)
def decays(h: float, noise: Array, width: int, kept: Array) -> None:
    """Write decay factors and variances of growth of h seconds to `kept`.

    From `KEPT` on the factor of each parameter, 1 where it does not decay; `width` behind it the
    variance that each state grows by. `noise` (3 n,) as of the model.

    They are cached, as most intervals have the same length: two exponentials for each state would
    cost a tenth of an interval.
    """
    if kept[0] != h:
        kept[0], kept[1] = h, 0.0
        n = noise.shape[0] // 3
        for i in range(n):
            decay, variance = 1.0, h * noise[n + i]
            if noise[i] > 0.0:
                decay, kept[1] = math.exp(-h * noise[i]), 1.0
                variance += noise[2 * n + i] * (1.0 - decay * decay)
            kept[KEPT + i], kept[KEPT + width + i] = decay, variance


@cache
def _gather_for(width: int) -> Callable[[Array, Indices, Array, Array], None]:
    """`gather` for rows of `width` doubles.

    Loops along a row end at a length read from an array: the compiler would unroll a short constant
    loop before it vectorises. Loops down a column have a constant length for the same reason:
    vector code would scatter, which costs more.
    """
    unsigned = np.uint64  # an index that cannot be negative needs no check
    wide = np.uint64(width)

    @compiled("void(f8[::1], i8[::1], f8[::1], f8[::1])", variant=width, forceinline=True)
    def gather(rows: Array, sensor_slot: Indices, weight: Array, sensor: Array) -> None:
        """sensor (6 rows): the parameters' rows of `rows`, two an axis error, weighted."""
        length = sensor.shape[0] // 6
        for k in range(6):
            first = unsigned(sensor_slot[2 * k]) * wide
            second = unsigned(sensor_slot[2 * k + 1]) * wide
            of_first, of_second = weight[2 * k], weight[2 * k + 1]
            target = unsigned(k) * wide
            for i in range(length):
                j = unsigned(i)
                sensor[target + j] = of_first * rows[first + j] + of_second * rows[second + j]

    return gather


@cache
def _columns_for(width: int) -> Callable[[Array, Indices, Array, int, Array], None]:
    """`columns` for rows of `width` doubles."""
    unsigned = np.uint64
    wide = np.uint64(width)

    @compiled("void(f8[::1], i8[::1], f8[::1], i8, f8[::1])", variant=width, forceinline=True)
    def columns(
        rows: Array, sensor_slot: Indices, weight: Array, stride: int, sensor: Array
    ) -> None:
        """sensor (6 rows of `stride` doubles, the first nine of each): the parameters' columns of
        the first nine `rows`, two an axis error, weighted."""
        for k in range(6):
            first, second = unsigned(sensor_slot[2 * k]), unsigned(sensor_slot[2 * k + 1])
            of_first, of_second = weight[2 * k], weight[2 * k + 1]
            target = unsigned(k) * unsigned(stride)
            for i in range(CORE_SIZE):
                j = unsigned(i)
                at = j * wide
                sensor[target + j] = of_first * rows[at + first] + of_second * rows[at + second]

    return columns


@compiled("void(f8[::1], i8, b1[::1])", forceinline=True)
def _keep_active(rows: Array, width: int, active: NDArray[np.bool_]) -> None:
    """Zero the rows, of nine of `width` doubles, that are not `active`."""
    for i in range(CORE_SIZE):
        if not active[i]:
            for j in range(width):
                rows[i * width + j] = 0.0


@cache
def covariance_for(width: int) -> Callable[..., None]:
    """`propagate_covariance` for matrices of `width` rows."""
    gather, columns, apply = _gather_for(width), _columns_for(width), apply_for(width)

    @compiled(
        "void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[::1], i8[::1], f8[::1], f8, f8[::1])",
        variant=width,
    )
    def propagate_covariance(
        flat: Array,
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
        """Propagate the covariance (width, width), `flat` (width^2,), in place by h seconds with
        transition coefficients `c`. P21 is neither read nor written; `mirror` makes it.

        The model's arrays are flat; rows and columns from n on are zero and stay so. `work` has
        work_size(width) doubles.
        """
        n = noise.shape[0] // 3
        sensor_slot = sensor_terms[:12]
        sensor, top = work[: 6 * width], work[6 * width : 15 * width]
        core_work = work[15 * width : 15 * width + 24 * CORE_STRIDE]
        turned = core_work[: 9 * CORE_STRIDE]
        core_sensor = core_work[9 * CORE_STRIDE : 15 * CORE_STRIDE]
        core = core_work[15 * CORE_STRIDE :]
        weight = work[15 * width + 24 * CORE_STRIDE : 15 * width + 24 * CORE_STRIDE + 12]
        kept = work[15 * width + 24 * CORE_STRIDE + 12 :]
        weights(step, sensor_terms, weight)
        decays(h, noise, width, kept)
        decay, grown = kept[KEPT : KEPT + width], kept[KEPT + width : KEPT + 2 * width]
        half = 0.5 * q
        for i in range(width):
            flat[i * width + i] += half * grown[i]

        gather(flat, sensor_slot, weight, sensor)
        columns(flat, sensor_slot, weight, width, sensor)
        apply(flat, sensor, c, top)
        _keep_active(top, width, active)
        for i in range(CORE_SIZE):
            for j in range(CORE_SIZE):
                turned[j * CORE_STRIDE + i] = top[i * width + j]
        columns(top, sensor_slot, weight, CORE_STRIDE, core_sensor)
        apply_to_core(turned, core_sensor, c, core)
        _keep_active(core, CORE_STRIDE, active)

        rates = rate_terms.shape[0] // 2
        for k in range(rates):
            offset, rate = rate_terms[k], rate_terms[rates + k]
            for i in range(CORE_SIZE):
                top[i * width + offset] += h * top[i * width + rate]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
            for i in range(CORE_SIZE, width):
                flat[i * width + offset] += h * flat[i * width + rate]
        for i in range(CORE_SIZE * width):
            flat[i] = top[i]
        if kept[1] != 0.0:
            for i in range(n):
                of_row = decay[i]
                for j in range(decay.shape[0]):
                    flat[i * width + j] *= of_row * decay[j]
        for i in range(CORE_SIZE, width):
            flat[i * width + i] += (q - half * decay[i] * decay[i]) * grown[i]
        for i in range(CORE_SIZE):
            for j in range(i):
                mean = 0.5 * (core[i * CORE_STRIDE + j] + core[j * CORE_STRIDE + i])
                flat[i * width + j] = mean
                flat[j * width + i] = mean
            flat[i * width + i] = core[i * CORE_STRIDE + i] + half * grown[i]

    return propagate_covariance


@compiled("void(f8[::1], i8, i8)")
def mirror(flat: Array, width: int, n: int) -> None:
    """Copy P12 of a covariance (width, width) of n states, `flat`, to P21."""
    unsigned, wide = np.uint64, np.uint64(width)
    for row in range(CORE_SIZE, n):
        j = unsigned(row)
        for column in range(CORE_SIZE):
            i = unsigned(column)
            flat[j * wide + i] = flat[i * wide + j]


@cache
def transition_for(width: int) -> Callable[..., None]:
    """`propagate_transition` for matrices of `width` rows."""
    gather, apply = _gather_for(width), apply_for(width)

    @compiled(
        "void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[::1], i8[::1], f8[::1], f8[::1])",
        variant=width,
    )
    def propagate_transition(
        flat: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
    ) -> None:
        """phi (width, width), `flat` (width^2,) <- transition over h seconds times phi; arguments
        as of `propagate_covariance`."""
        sensor, top = work[: 6 * width], work[6 * width : 15 * width]
        weight = work[15 * width + 24 * CORE_STRIDE : 15 * width + 24 * CORE_STRIDE + 12]
        kept = work[15 * width + 24 * CORE_STRIDE + 12 :]
        decay = kept[KEPT : KEPT + width]
        weights(step, sensor_terms, weight)
        gather(flat, sensor_terms[:12], weight, sensor)
        apply(flat, sensor, c, top)
        _keep_active(top, width, active)
        for i in range(CORE_SIZE * width):
            flat[i] = top[i]
        rates = rate_terms.shape[0] // 2
        for k in range(rates):
            offset, rate = rate_terms[k], rate_terms[rates + k]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
        decays(h, noise, width, kept)
        if kept[1] != 0.0:
            for i in range(CORE_SIZE, noise.shape[0] // 3):
                of_row = decay[i]
                for j in range(decay.shape[0]):
                    flat[i * width + j] *= of_row

    return propagate_transition


@compiled("void(f8[::1], f8, i8[::1], f8[::1])", forceinline=True)
def propagate_parameters(x: Array, h: float, rate_terms: Indices, kept: Array) -> None:
    """x (n,), parameters or their errors, over h seconds: offsets grow, Markov states decay by the
    factors that `decays` has `kept`."""
    rates = rate_terms.shape[0] // 2
    for k in range(rates):
        x[rate_terms[k]] += h * x[rate_terms[rates + k]]
    for i in range(CORE_SIZE, x.shape[0]):
        x[i] *= kept[KEPT + i]


@compiled("void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[::1], i8[::1], f8[::1], f8[::1])")
def propagate_error(
    dx: Array,
    step: Array,
    c: Array,
    h: float,
    active: NDArray[np.bool_],
    sensor_terms: Indices,
    rate_terms: Indices,
    kept: Array,
    work: Array,
) -> None:
    """Propagate an error estimate dx (n,) <- Phi dx over h seconds, with the decays in `kept`: an
    estimate before its feedback (paper 000, 1.1)."""
    sensor = work[: 6 * CORE_STRIDE]
    rows = work[6 * CORE_STRIDE : 15 * CORE_STRIDE]
    out = work[15 * CORE_STRIDE : 24 * CORE_STRIDE]
    weight = work[24 * CORE_STRIDE : 24 * CORE_STRIDE + 12]
    weights(step, sensor_terms, weight)
    sensor[:] = 0.0
    for i in range(12):
        sensor[i // 2 * CORE_STRIDE] += weight[i] * dx[sensor_terms[i]]
    rows[:] = 0.0
    for i in range(CORE_SIZE):
        rows[i * CORE_STRIDE] = dx[i]
    apply_to_core(rows, sensor, c, out)
    for i in range(CORE_SIZE):
        dx[i] = out[i * CORE_STRIDE] if active[i] else 0.0
    propagate_parameters(dx, h, rate_terms, kept)
