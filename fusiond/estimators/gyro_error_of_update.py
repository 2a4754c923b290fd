r"""Gyro error after an update that changes the estimated turn rate.

While tilt and force bias hide each other (fusiond.estimators.tilt_frame_after_heading_update), both
stay as they are on the vehicle: of a computed attitude C that turns about the vertical at w, with a
tilt t and a rate bias error e, what moves the vehicle changes with

    (C e)_h + w z x t = 0   to some 0.01 deg/s                         z down, h horizontal

(t' = -(C e)_h, and with the turn that the yaw gyro's error only pretends + (C e)_D z x t: in truth
(C e)_h = -w_true z x t.) An update that tells dx of the gyros' biases makes w of it less by
(C dx)_D, and if P stays as it is, the next measurements say

    (C+ e)_h + w+ z x t = 0

as well. Both at once are true of t = 0 alone: 2 deg/s of yaw rate that were none, with 5 deg of
tilt, pass for 0.2 deg/s. The transform after the update that carries the first over to the second,

    C+ e <- R(psi) (C e) + (C dx)_D z x R(psi) t        psi of
    fusiond.estimators.tilt_frame_after_heading_update

leaves the second alone. That holds of a bias that was always wrong, and would be false of one that
has just changed: after a doubt of the motion there is none until the filter starts anew. Cars that
start on the move, of gyros with 3 deg/s, are the ones that it is for: what they turn at is known
only once they accelerate, or do not slide, and then within a second.

Source: as of fusiond.estimators.tilt_frame_after_heading_update, whose error this is in other
states.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import PHI, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def gyro_slots(model: Model) -> Indices:
    """Slots (3,) of the gyros' biases; none where an axis has several, or none."""
    found = [model.parameters(RATE_ERROR + axis) for axis in range(3)]
    one = all(len(slots) == 1 for slots in found)
    return np.array([slots[0] for slots in found] if one else [], dtype=np.int64)


@compiled("void(f8[:, :], f8[::1], f8[::1], f8, f8[::1], i8[::1])")
def keep_turn(
    m: Array, before: Array, after: Array, psi: float, told: Array, gyros: Indices
) -> None:
    """M (n, k) <- T M: what was known of the turn at the attitude q_nb (4,) `before` is known of
    the one `after`, which is by `psi` (rad) about the vertical, with T P T^T. Of the biases, slots
    `gyros` (3,), the update has told `told` (3,); the tilt of M is in the axes of after."""
    c, s = math.cos(psi), math.sin(psi)
    old, new = dcm_elements(before), dcm_elements(after)
    less = old[6] * told[0] + old[7] * told[1] + old[8] * told[2]
    for k in range(m.shape[1]):
        x, y, z = m[gyros[0], k], m[gyros[1], k], m[gyros[2], k]
        north = old[0] * x + old[1] * y + old[2] * z
        east = old[3] * x + old[4] * y + old[5] * z
        down = old[6] * x + old[7] * y + old[8] * z
        turned_north = c * north - s * east - less * m[PHI + 1, k]
        turned_east = s * north + c * east + less * m[PHI, k]
        for j in range(3):
            m[gyros[j], k] = new[j] * turned_north + new[3 + j] * turned_east + new[6 + j] * down
