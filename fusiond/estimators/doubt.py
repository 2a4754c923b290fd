"""What a doubt opens in P."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.navigation.error_model import FORCE_ERROR, RATE_ERROR

Array = NDArray[np.float64]

# One sigma added when the motion is in doubt: to the attitude (rad) what an alignment on the move
# can be wrong by, to the sensor errors what a damaged or loose unit shows, a hundred times the bias
# of a data sheet.
DOUBTED_ATTITUDE_RAD = math.radians(3.0)
DOUBTED_RATE_RAD_S = math.radians(1.0)
DOUBTED_FORCE_M_S2 = 0.5


def open_by(cov: Array, model: Model, z: Array, h: Array, motion: bool) -> None:
    """Add the square of an innovation z (m,), H (m, n), to the states of P (n, n) that it measures
    directly. With `motion`, doubt attitude and sensor errors beyond what any data sheet says."""
    if motion:
        for slot in range(3):
            cov[slot, slot] += DOUBTED_ATTITUDE_RAD**2 * model.active[slot]
        unsettle(cov, model, 1.0)
    for row, value in zip(h, z, strict=True):
        # Position or velocity before the attitude that turns a lever arm.
        group = next(g for g in (slice(3, 9), slice(0, 3), slice(0, len(row))) if row[g].any())
        slot = group.start + int(np.argmax(np.abs(row[group])))
        if model.active[slot]:
            cov[slot, slot] += value * value


def unsettle(cov: Array, model: Model, share: float) -> None:
    """Add to P (n, n) that share of what a doubt of the motion adds to the sensor errors."""
    for first, sd in ((RATE_ERROR, DOUBTED_RATE_RAD_S), (FORCE_ERROR, DOUBTED_FORCE_M_S2)):
        for axis in range(first, first + 3):
            for slot in model.parameters(axis)[:1]:  # a model may know no such error
                cov[slot, slot] += share * sd**2 * model.active[slot]
