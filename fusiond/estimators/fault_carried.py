"""Compiled kernel: propagation of a bank's sensitivities between two measurements.

One transition covers the time between two measurements. It is propagated with the covariance
(fusiond.estimators.multi_sample_covariance), and V is multiplied by it before an update. Most of
its rows are those of the identity; others are the nine of the navigation errors, and those of
states that decay, grow with a rate, or are turned at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.covariance_propagation import transition_for
from fusiond.estimators.fault_bank import PHI, SENSITIVITIES, WAITS, WIDTH
from fusiond.estimators.fault_update import walk_path
from fusiond.estimators.multi_sample_covariance import DENSITIES, STEPS
from fusiond.estimators.sensitivity_sums import add_rows
from fusiond.estimators.tilt_axes_propagation import rest_rows
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CHUNK = 128
"""Columns at once: what of V is read lies in the nearest cache then."""


@cache
def carry_for(width: int) -> Callable[..., None]:
    """`carry_hypotheses` for rows of `width` doubles."""
    propagate_transition, square = transition_for(width), width * width

    @compiled(
        "void(f8[::1], i8, f8[::1], f8[::1], f8, f8[::1], b1, f8[::1], b1[::1], i8[::1], i8[::1],"
        " f8[::1], f8[::1])",
        variant=width,
    )
    def carry_hypotheses(
        bank: Array,
        now: int,
        nav: Array,
        sums: Array,
        span: float,
        c: Array,
        rests: bool,
        turn: Array,
        active: NDArray[np.bool_],
        sensor_terms: Indices,
        rate_terms: Indices,
        noise: Array,
        work: Array,
    ) -> None:
        """Propagate path and transition of a bank over the interval of `sums`, `span` seconds until
        `now`."""
        walk_path(bank, nav, now * 1e-9, span)
        phi = bank[int(bank[PHI]) : int(bank[PHI]) + square]
        propagate_transition(
            phi, sums[STEPS:DENSITIES], c, span, active, sensor_terms, rate_terms, noise, work
        )
        if rests:
            rest_rows(phi, width, width, turn, sensor_terms[:12], sensor_terms[12:])
        bank[WAITS] = 1.0

    return carry_hypotheses


@compiled("void(f8[::1], i8, i8)")
def begin_transition(bank: Array, n: int, width: int) -> None:
    """Reset the transition to the identity."""
    phi = bank[int(bank[PHI]) :]
    for i in range(width):
        for j in range(width):
            phi[i * width + j] = 1.0 if i == j and i < n else 0.0
    bank[WAITS] = 0.0


@compiled("void(f8[::1], i8, i8[::1])", allocates=True)
def _multiply(bank: Array, n: int, rows: Indices) -> None:
    """Multiply V <- Phi V, where only `rows` (k,) differ from the identity; then reset Phi."""
    width, count = int(bank[WIDTH]), rows.shape[0]
    phi, v = bank[int(bank[PHI]) :], bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    # Which others a row takes something of; one that takes of none decays where it is.
    begins, of = np.zeros(count + 1, dtype=np.int64), np.empty(count * n, dtype=np.int64)
    alone = np.zeros(count, dtype=np.bool_)
    for k in range(count):
        end = begins[k]
        for j in range(n):
            if phi[rows[k] * width + j] != 0.0:
                of[end] = j
                end += 1
        begins[k + 1] = end
        alone[k] = end == begins[k] + 1 and of[begins[k]] == rows[k]
    new = np.empty(count * CHUNK, dtype=np.float32)
    for first in range(0, columns, CHUNK):
        length = min(CHUNK, columns - first)
        for k in range(count):
            if alone[k]:
                continue
            out = new[k * CHUNK : k * CHUNK + length]
            for j in range(out.shape[0]):
                out[j] = 0.0
            those = of[begins[k] : begins[k + 1]]
            row = phi[rows[k] * width : (rows[k] + 1) * width]
            add_rows(v, columns, first, those, those.shape[0], row, out)
        for k in range(count):
            at = rows[k] * columns + first
            out, to = new[k * CHUNK : k * CHUNK + length], v[at : at + length]
            if alone[k]:
                keep = np.float32(phi[rows[k] * width + rows[k]])
                for j in range(to.shape[0]):
                    to[j] *= keep
            else:
                for j in range(to.shape[0]):
                    to[j] = out[j]
    for i in rows:
        for j in range(width):
            phi[i * width + j] = 1.0 if i == j else 0.0


@compiled("void(f8[::1], i8)", allocates=True)
def settle(bank: Array, n: int) -> None:
    """Apply V <- Phi V for the transition since the last measurement."""
    if bank[WAITS] == 0.0:
        return
    width, phi = int(bank[WIDTH]), bank[int(bank[PHI]) :]
    rows, count = np.empty(n, dtype=np.int64), 0
    for i in range(n):
        row, entries = phi[i * width : i * width + n], 0
        for j in range(row.shape[0]):
            entries += row[j] != 0.0
        if entries != 1 or row[i] != 1.0:
            rows[count] = i
            count += 1
    _multiply(bank, n, rows[:count])
    bank[WAITS] = 0.0


@compiled("void(f8[::1], i8, i8[::1], f8[:, ::1])", allocates=True)
def mix(bank: Array, n: int, slots: Indices, t: Array) -> None:
    """Multiply V <- T V, where T is the identity but for rows and columns `slots` (k,): t (k,
    k)."""
    settle(bank, n)
    width, phi = int(bank[WIDTH]), bank[int(bank[PHI]) :]
    for a in range(slots.shape[0]):
        for b in range(slots.shape[0]):
            phi[slots[a] * width + slots[b]] = t[a, b]
    _multiply(bank, n, slots)
