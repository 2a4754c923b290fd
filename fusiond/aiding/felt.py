r"""What an acceleration that an aid takes from the IMU is wrong by: the force's own errors.

    a = C f + g,   d a = [f x] phi + C e,   e = db + ds f       (computed minus true, body axes)

An offset in time multiplies a. Tilt and force bias are known by their sum long before they are each
(fusiond.estimators.tilt_axes): an aid that has the first term alone would tell them apart, a little
with each measurement, whatever the truth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, FORCE_ERROR, FORCE_SCALE
from fusiond.navigation.strapdown import STEP_SMOOTH_N

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Matrix = tuple[float, float, float, float, float, float, float, float, float]


@compiled("void(f8[::1], i8[::1], UniTuple(f8, 9), f8, f8, f8, f8[::1])", forceinline=True)
def add_of_force(
    step: Array, column_of: Indices, c: Matrix, r0: float, r1: float, r2: float, h: Array
) -> None:
    """Add to h (n,) the slopes by e of (r0, r1, r2) . f_body, by the force that `step` (21,) holds,
    smoothed; `c` C_nb by rows."""
    row = (r0, r1, r2)
    for slot in range(CORE_SIZE, column_of.shape[0]):
        axis = column_of[slot] - FORCE_ERROR
        if 0 <= axis < 3:
            h[slot] += row[axis]
        axis = column_of[slot] - FORCE_SCALE
        if 0 <= axis < 3:
            force = 0.0
            for k in range(3):
                force += c[3 * k + axis] * step[STEP_SMOOTH_N + k]
            h[slot] += row[axis] * force
