"""Innovation in metres or m/s before the gate: estimate minus measurement.

    z = H_p dr + ...   or, where no position is measured,   z = H_v dv + ...

Rows have the form of the filter; those of RDSS fixes are whitened by their covariance. The raw
innovation is solved for the measured axes (north, east, down) if there are as many as rows; else
each row is taken along its own direction, z_i / |H_i|, as for wheels. Angles and pseudoranges have
no raw innovation.

While feedback is delayed (RDSS by optimal prediction), the estimate is the navigation state without
it.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from fusiond.aiding.base import Linearised, NotApplicable, State
from fusiond.estimators.base import Estimator

PARTS: tuple[tuple[int, Literal["m", "m/s"]], ...] = ((3, "m"), (0, "m/s"))
"""First columns of position and of velocity."""
VELOCITY_AND_POSITION = slice(3, 9)
"""Columns of velocity and position in the error state."""


class RawInnovation(NamedTuple):
    """Estimate minus measurement. `axes`: a letter of `ned` for each value; empty if each value has
    its own direction."""

    values: tuple[float, ...]
    unit: Literal["m", "m/s"]
    axes: str


def raw_innovation(measurement: Linearised, estimator: Estimator) -> RawInnovation | None:
    """Raw innovation of a measurement before its update; None if it measures neither position nor
    velocity."""
    if measurement.screened or math.isfinite(measurement.period):
        return None
    e = estimator
    rows = measurement.innovation(State(e.nav, e.xi, e.step, e.model, e.covariance))
    if isinstance(rows, NotApplicable):
        return None
    return of_rows(rows.z.tolist(), rows.h[:, VELOCITY_AND_POSITION].tolist())


def of_rows(z: list[float], of_state: list[list[float]]) -> RawInnovation | None:
    """Raw innovation from an innovation (m,) and its rows for velocity and position (m, 6)."""
    for first, unit in PARTS:
        h = [row[first : first + 3] for row in of_state]
        axes = [k for k in range(3) if any(row[k] for row in h)]
        if not axes:
            continue
        if len(axes) != len(h):
            values = [value / math.hypot(*row) for value, row in zip(z, h, strict=True)]
            return RawInnovation(tuple(values), unit, "")
        square = [[row[k] for k in axes] for row in h]
        if not _is_identity(square):
            z = np.linalg.solve(square, z).tolist()
        return RawInnovation(tuple(z), unit, "".join("ned"[k] for k in axes))
    return None


def _is_identity(square: list[list[float]]) -> bool:
    return all(v == (i == k) for i, row in enumerate(square) for k, v in enumerate(row))
