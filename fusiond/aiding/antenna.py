r"""Position and velocity of a receiver's antenna on the vehicle, from its lever arm.

    v_a = v + C (w x l),   d v_a = dv + (C (w x l)) x phi - C [l x] e - C [w x] dl

l is the lever arm from the IMU, w the rate of the body against the Earth, whose own rate times the
lever is under 1 mm/s per 10 m. e is the error of the rate (computed minus true), dl that of the
lever arm's rest, an estimate (true minus estimated).

The slope by dl uses the part of w that is not noise (fusiond.aiding.smoothed_imu_jacobian).

Source: Groves, 2nd ed., eq. 14.109.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.smoothed_imu_jacobian import turning
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.strapdown import VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Matrix = tuple[float, float, float, float, float, float, float, float, float]


@compiled(
    "void(f8[::1], f8[::1], i8[::1], i8[::1], UniTuple(f8, 9), f8, f8, f8, i8, f8[::1],f8[:, ::1])",
    forceinline=True,
)
def antenna_velocity(
    nav: Array,
    step: Array,
    column_of: Indices,
    rest: Indices,
    c: Matrix,
    l0: float,
    l1: float,
    l2: float,
    rate: int,
    v: Array,
    of_v: Array,
) -> None:
    """Write v_a (m,) and d v_a (m, n), zero before: the first m of north, east, down.

    `c`: C_nb by rows; l0 to l2: lever arm with the estimate of its rest; `rest` (0 or 3,): its
    slots; `rate`: index of the rate of v_a in `step`.
    """
    w0, w1, w2 = step[rate], step[rate + 1], step[rate + 2]
    u0, u1, u2 = w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0
    x = c[0] * u0 + c[1] * u1 + c[2] * u2
    y = c[3] * u0 + c[4] * u1 + c[5] * u2
    d = c[6] * u0 + c[7] * u1 + c[8] * u2
    v[0], v[1] = nav[VN] + x, nav[VN + 1] + y
    of_v[0, 1], of_v[0, 2] = -d, y
    of_v[1, 0], of_v[1, 2] = d, -x
    of_v[0, 3] = of_v[1, 4] = 1.0
    if v.shape[0] > 2:
        v[2] = nav[VN + 2] + d
        of_v[2, 0], of_v[2, 1] = -y, x
        of_v[2, 5] = 1.0
    for i in range(v.shape[0]):
        a, b, e = c[3 * i], c[3 * i + 1], c[3 * i + 2]
        for slot in range(CORE_SIZE, column_of.shape[0]):
            axis = column_of[slot] - RATE_ERROR
            if axis == 0:
                of_v[i, slot] = e * l1 - b * l2
            elif axis == 1:
                of_v[i, slot] = a * l2 - e * l0
            elif axis == 2:
                of_v[i, slot] = b * l0 - a * l1
        if rest.size:
            w0, w1, w2 = turning(step, 0), turning(step, 1), turning(step, 2)
            of_v[i, rest[0]] = e * w1 - b * w2
            of_v[i, rest[1]] = a * w2 - e * w0
            of_v[i, rest[2]] = b * w0 - a * w1
