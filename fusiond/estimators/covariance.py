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


# Where the factors of `decays` begin, behind the interval that they are of.
KEPT = 1


def work_size(width: int) -> int:
    """Doubles of work space that the kernels of a row width need, zero at first; `decays` at its
    end."""
    return (6 + 9 + CORE_STRIDE) * width + (6 + 9) * CORE_STRIDE + 12 + KEPT + width


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
    """Write `weight` (12,): by how much each parameter acts on its axis error, `step` (27,)."""
    for i in range(12):
        weight[i] = 0.0
        if sensor_terms[1, i] == PLAIN:
            weight[i] = 1.0
        elif sensor_terms[1, i] == SCALE:
            weight[i] = step[3 + i // 2]


@compiled("UniTuple(f8[::1], 7)(f8[::1], i8)")
def work_parts(work: Array, width: int) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """The parts of `work` (work_size(width),) that the kernels of a row width take: `sensor`,
    `top`, `turned`, `core_sensor`, `core`, `weight` and, for `decays`, `kept`.

    Made once for many intervals: a slice counts the references to its memory, atomically, and
    those of an interval took a third of its time.
    """
    a = 6 * width
    b = a + 9 * width
    c = b + width * CORE_STRIDE
    d = c + 6 * CORE_STRIDE
    e = d + 9 * CORE_STRIDE
    f = e + 12
    return work[:a], work[a:b], work[b:c], work[c:d], work[d:e], work[e:f], work[f:]


@compiled("void(f8, f8[:, ::1], f8[::1])", forceinline=True)
def decays(h: float, noise: Array, kept: Array) -> None:
    """Write what each parameter decays by in h seconds, 1 where it does not, to `kept` (1 + n,)
    from its `KEPT` on; `noise` (3, n) as of the model.

    They are kept from one interval to the next, which is most often as long: an exponential a
    state, and one more for its estimate, cost a tenth of an interval.
    """
    if kept[0] != h:
        kept[0] = h
        for i in range(noise.shape[1]):
            kept[KEPT + i] = math.exp(-h * noise[0, i]) if noise[0, i] > 0.0 else 1.0


@cache
def covariance_for(width: int) -> Callable[..., None]:
    """`propagate_covariance` for matrices of `width` rows."""
    advance = _advance_for(width)

    @compiled(
        "void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1],"
        "f8, f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])",
        variant=width,
    )
    def propagate_covariance(
        flat: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        sensor_slot: Indices,
        rate_terms: Indices,
        noise: Array,
        q: float,
        sensor: Array,
        top: Array,
        turned: Array,
        core_sensor: Array,
        core: Array,
        weight: Array,
        kept: Array,
    ) -> None:
        """Advance the covariance (width, width), `flat` (width^2,), in place by h seconds with
        transition coefficients `c`.

        The model's arrays are (n,), `sensor_slot` the first row of its `sensor_terms`; rows and
        columns from n on are zero and stay so. From `sensor` on what `work_parts` gives.
        """
        n = noise.shape[1]
        _weights(step, sensor_terms, weight)
        half = 0.5 * h * q
        for i in range(CORE_SIZE):
            flat[i * width + i] += half * noise[1, i]

        advance(flat, sensor_slot, weight, c, active, sensor, top)
        # As rows and as columns at once, and the rest of the columns from what then lies together.
        for i in range(CORE_SIZE):
            for j in range(width):
                value = top[i * width + j]
                turned[j * CORE_STRIDE + i] = value
                flat[i * width + j] = value
        for j in range(CORE_SIZE, width):
            for i in range(CORE_SIZE):
                flat[j * width + i] = turned[j * CORE_STRIDE + i]
        _advance_core(turned, sensor_slot, weight, c, active, core_sensor, core)
        for i in range(CORE_SIZE):
            for j in range(CORE_SIZE):
                lower, upper = core[i * CORE_STRIDE + j], core[j * CORE_STRIDE + i]
                flat[i * width + j] = 0.5 * (lower + upper)
            flat[i * width + i] += half * noise[1, i]
        for k in range(rate_terms.shape[1]):
            offset, rate = rate_terms[0, k], rate_terms[1, k]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
            for j in range(width):
                flat[j * width + offset] += h * flat[j * width + rate]
        decays(h, noise, kept)
        for i in range(CORE_SIZE, n):
            variance = q * h * noise[1, i]
            if noise[0, i] > 0.0:
                decay = kept[KEPT + i]
                for j in range(width):
                    flat[i * width + j] *= decay
                    flat[j * width + i] *= decay
                variance += q * noise[2, i] * (1.0 - decay * decay)
            flat[i * width + i] += variance

    return propagate_covariance


@cache
def transition_for(width: int) -> Callable[..., None]:
    """`propagate_transition` for matrices of `width` rows."""
    advance = _advance_for(width)

    @compiled(
        "void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1],"
        "f8[::1], f8[::1], f8[::1], f8[::1])",
        variant=width,
    )
    def propagate_transition(
        flat: Array,
        step: Array,
        c: Array,
        h: float,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        sensor_slot: Indices,
        rate_terms: Indices,
        noise: Array,
        sensor: Array,
        top: Array,
        weight: Array,
        kept: Array,
    ) -> None:
        """phi (width, width), `flat` (width^2,) <- transition over h seconds times phi; arguments
        as of `propagate_covariance`."""
        _weights(step, sensor_terms, weight)
        advance(flat, sensor_slot, weight, c, active, sensor, top)
        for i in range(CORE_SIZE * width):
            flat[i] = top[i]
        for k in range(rate_terms.shape[1]):
            offset, rate = rate_terms[0, k], rate_terms[1, k]
            for j in range(width):
                flat[offset * width + j] += h * flat[rate * width + j]
        decays(h, noise, kept)
        for i in range(CORE_SIZE, noise.shape[1]):
            if noise[0, i] > 0.0:
                decay = kept[KEPT + i]
                for j in range(width):
                    flat[i * width + j] *= decay

    return propagate_transition


@compiled("void(f8[::1], f8, i8[:, ::1], f8[::1])", forceinline=True)
def propagate_parameters(x: Array, h: float, rate_terms: Indices, kept: Array) -> None:
    """x (n,), parameters or their errors, over h seconds: offsets grow, Markov states decay by what
    `decays` has `kept` for it."""
    for k in range(rate_terms.shape[1]):
        x[rate_terms[0, k]] += h * x[rate_terms[1, k]]
    for i in range(CORE_SIZE, x.shape[0]):
        x[i] *= kept[KEPT + i]


@compiled("void(f8[::1], f8[::1], f8[::1], f8, b1[::1], i8[:, ::1], i8[:, ::1], f8[::1], f8[::1])")
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
    """dx (n,) <- Phi dx over h seconds, which `decays` has `kept`: an estimate that is not fed back
    yet (paper 000, 1.1)."""
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
    propagate_parameters(dx, h, rate_terms, kept)
