r"""Antenna position of an unmeasured lever arm, preserved when an update rotates the vehicle.

A fix measures the antenna's position, not the lever arm:

    dr + (C l) x phi - C dl - v dtau = noise          (fusiond.aiding.position, its sum z)

with the estimates of attitude C, lever arm l and velocity v. After an update to C+, l+ and v+ with
P unchanged, the next fix implies

    dr + (C+ l+) x phi - C+ dl - v+ dtau = noise

as well. Both hold together only for (C+ - C) dl = 0: RTK resolves half a degree times a metre, so
each correction of the attitude adds false information on the lever arm. It also separates l_x and
-v tau, which are indistinguishable at one speed. (Twelve cars with fixes of 2 cm: the antenna's
position 0.5 to 2 m off at 4 to 6 sigma.) The transform after the update from the first sum to the
second,

    dr <- dr - (C+ (l+ - l)) x phi + (C+ - C) dl + (v+ - v) dtau

leaves only the second. C+ l+ - C l is approximated by C+ (l+ - l); the rest turns l by the same
angle as phi. In a real turn C changes and dr does not, which shows dl.

Source: as of fusiond.estimators.tilt_frame_after_heading_update, which treats the same error in
another state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import ANTENNA_LEVER, FIX_TIME
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import DR, PHI
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import Q0, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def antenna_slots(model: Model) -> tuple[Indices, Indices]:
    """Slots of a lever arm's error (3,) and of its fixes' time offset (0 or 1,).

    Empty if the model estimates no lever arm, or several: one position is then known by two
    paths."""
    levers = [block.name for block in model.blocks if block.name.startswith(ANTENNA_LEVER)]
    if len(levers) != 1:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    time = FIX_TIME + levers[0].removeprefix(ANTENNA_LEVER)
    return model.slots_of_all((levers[0],)), model.slots_of_all((time,))


@compiled("void(f8[:, :], f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[::1])", allocates=True)
def keep_antenna(
    m: Array,
    before: Array,
    after: Array,
    arm_before: Array,
    arm_after: Array,
    lever: Indices,
    time: Indices,
) -> None:
    """M (n, k) <- T M: transfer the information on the antenna's position from nav (10,) `before`
    to `after`, with the estimates of its lever arm (3,); P becomes T P T^T. `lever` (3,) and `time`
    (0 or 1,): their slots."""
    old, new = dcm_elements(before[Q0:]), dcm_elements(after[Q0:])
    moved = np.empty(3)
    for i in range(3):
        moved[i] = 0.0
        for j in range(3):
            moved[i] += new[3 * i + j] * (arm_after[j] - arm_before[j])
    for k in range(m.shape[1]):
        north, east, down = m[PHI, k], m[PHI + 1, k], m[PHI + 2, k]
        m[DR, k] -= moved[1] * down - moved[2] * east
        m[DR + 1, k] -= moved[2] * north - moved[0] * down
        m[DR + 2, k] -= moved[0] * east - moved[1] * north
        for i in range(3):
            told = 0.0
            for j in range(3):
                told += (new[3 * i + j] - old[3 * i + j]) * m[lever[j], k]
            for slot in time:
                told += (after[VN + i] - before[VN + i]) * m[slot, k]
            m[DR + i, k] += told
