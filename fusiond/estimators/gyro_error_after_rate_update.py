r"""Gyro error after an update that changes the estimated turn rate.

While only the sum of tilt and force bias is known
(fusiond.estimators.tilt_frame_after_heading_update), both are constant on the vehicle. For a
computed attitude C that turns about the vertical at w, with tilt t and rate bias error e,

    (C e)_h + w z x t = 0   to some 0.01 deg/s                         z down, h horizontal

(t' = -(C e)_h, and with the turn that the yaw gyro's error only pretends + (C e)_D z x t: in truth
(C e)_h = -w_true z x t.) An update by dx of the gyros' biases reduces w by (C dx)_D; with P
unchanged the next measurements imply

    (C+ e)_h + w+ z x t = 0

as well. Both hold together only for t = 0: a false yaw rate of 2 deg/s with 5 deg of tilt looks
like 0.2 deg/s. The transform after the update from the first to the second,

    C+ e <- R(psi) (C e) + (C dx)_D z x R(psi) t        psi of
    fusiond.estimators.tilt_frame_after_heading_update

leaves only the second. It holds for a bias that was always wrong, not for one that has just
changed: after a doubt of the motion it is not applied until the filter restarts. It is needed for
starts on the move with gyro biases of 3 deg/s: their turn rate becomes known only once the vehicle
accelerates or does not slide, and then within a second.

Source: as of fusiond.estimators.tilt_frame_after_heading_update, which treats the same error in
other states.
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
    """Slots (3,) of the gyros' biases; empty if an axis has several or none."""
    found = [model.parameters(RATE_ERROR + axis) for axis in range(3)]
    one = all(len(slots) == 1 for slots in found)
    return np.array([slots[0] for slots in found] if one else [], dtype=np.int64)


@compiled("void(f8[:, :], f8[::1], f8[::1], f8, f8[::1], i8[::1])")
def keep_turn(
    m: Array, before: Array, after: Array, psi: float, told: Array, gyros: Indices
) -> None:
    """M (n, k) <- T M: transfer the information on the turn from attitude q_nb (4,) `before` to
    `after`, `psi` (rad) further about the vertical; P becomes T P T^T. `told` (3,): the update of
    the biases in slots `gyros` (3,); the tilt of M is in the axes of `after`."""
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
