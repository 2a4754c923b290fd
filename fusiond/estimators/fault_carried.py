"""Compiled kernel: the sensitivities of a bank of hypotheses, carried on between two measurements.

What lies between two measurements is one transition, which is carried from crossing to crossing as
the covariance is (fusiond.estimators.block_covariance), and V is multiplied by it where a
measurement is to be folded in. Most rows of it are those of the identity: of navigation errors
nine, of others those that decay, grow with a rate, or are turned at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.block_covariance import DENSITIES, STEPS
from fusiond.estimators.covariance import transition_for
from fusiond.estimators.fault_bank import PHI, SENSITIVITIES, WAITS, WIDTH
from fusiond.estimators.fault_rows import add_rows, walk_path
from fusiond.estimators.turned_axes import rest_rows
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
        """Carry path and transition of a bank over what `sums` hold, `span` seconds until `now`."""
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
    """Nothing lies between the last measurement and now."""
    phi = bank[int(bank[PHI]) :]
    for i in range(width):
        for j in range(width):
            phi[i * width + j] = 1.0 if i == j and i < n else 0.0
    bank[WAITS] = 0.0


@compiled("void(f8[::1], i8)", allocates=True)
def settle(bank: Array, n: int) -> None:
    """V <- Phi V of all that has been carried since the last measurement."""
    if bank[WAITS] == 0.0:
        return
    width = int(bank[WIDTH])
    phi, v = bank[int(bank[PHI]) :], bank[int(bank[SENSITIVITIES]) :].view(np.float32)
    columns = v.shape[0] // n
    # Rows that take something of others, and of which.
    mixed, count = np.empty(n, dtype=np.int64), 0
    begins, of = np.zeros(n + 1, dtype=np.int64), np.empty(n * n, dtype=np.int64)
    alone = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        begin = begins[count]
        end, row, entries = begin, phi[i * width : i * width + n], 0
        for j in range(row.shape[0]):
            entries += row[j] != 0.0
        alone[i] = entries == 1 and row[i] != 0.0
        if alone[i]:
            continue
        for j in range(n):
            if row[j] != 0.0:
                of[end] = j
                end += 1
        mixed[count] = i
        count += 1
        begins[count] = end
    new = np.empty(count * CHUNK, dtype=np.float32)
    for first in range(0, columns, CHUNK):
        length = min(CHUNK, columns - first)
        for k in range(count):
            out = new[k * CHUNK : k * CHUNK + length]
            for j in range(out.shape[0]):
                out[j] = 0.0
            those = of[begins[k] : begins[k + 1]]
            row = phi[mixed[k] * width : (mixed[k] + 1) * width]
            add_rows(v, columns, first, those, those.shape[0], row, out)
        for i in range(n):
            keep = np.float32(phi[i * width + i])
            if alone[i] and keep != 1.0:
                kept = v[i * columns + first : i * columns + first + length]
                for j in range(kept.shape[0]):
                    kept[j] *= keep
        for k in range(count):
            out, to = new[k * CHUNK : k * CHUNK + length], v[mixed[k] * columns + first :]
            for j in range(out.shape[0]):
                to[j] = out[j]
    begin_transition(bank, n, width)
