"""A compiled kernel: the innovation of an aid that is `Packed`, whatever its kind."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import speed_of
from fusiond.aiding.body_velocity import direction_of, no_slip_rows, speed_rows
from fusiond.aiding.packed import AMOUNT, COUNTS, KIND, NO_SLIP, POSITION, SLOTS, VELOCITY
from fusiond.aiding.position import position_rows
from fusiond.aiding.velocity import velocity_rows
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled(
    "b1(i8[::1], f8[::1], f8, f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], b1, f8[:, :],"
    "f8[::1], f8[:, ::1], f8[::1])"
)
def write_rows(
    slots: Indices,
    numbers: Array,
    coarse: float,
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    initial: Array,
    hold_height: bool,
    p: Array,
    z: Array,
    h: Array,
    r: Array,
) -> bool:
    """Write z (m,), H (m, n) and r (m,) of an aid, with `coarse` times the sigma that it states,
    at a state of a filter with P (n, n) and a model with these columns and sigmas (n,). Whether it
    holds there."""
    x = numbers
    a = SLOTS + slots[COUNTS]
    b = a + slots[COUNTS + 1]
    c = b + slots[COUNTS + 2]
    first, second, third, fourth = slots[SLOTS:a], slots[a:b], slots[b:c], slots[c:]
    if slots[KIND] == NO_SLIP and speed_of(nav) < x[5]:
        return False
    if slots[KIND] == POSITION:
        position_rows(
            nav,
            xi,
            step,
            column_of,
            first,
            second,
            third,
            fourth,
            x[0],
            x[1],
            x[2],
            x[3],
            x[4],
            x[5],
            coarse * x[6],
            coarse * x[7],
            coarse * x[8],
            x[9],
            x[10],
            x[11],
            x[12],
            x[13],
            p,
            z,
            h,
            r,
        )
    elif slots[KIND] == VELOCITY:
        sd_0, sd_1, sd_2 = coarse * x[3], coarse * x[4], coarse * x[5]
        velocity_rows(
            nav,
            xi,
            step,
            column_of,
            first,
            second,
            x[0],
            x[1],
            x[2],
            sd_0,
            sd_1,
            sd_2,
            x[6],
            x[7],
            x[8],
            x[9],
            z,
            h,
            r,
        )
    elif slots[KIND] == NO_SLIP:
        no_slip_rows(
            nav,
            step,
            xi,
            column_of,
            hold_height,
            x[0],
            x[1],
            x[2],
            first,
            x[3],
            x[4],
            z,
            h,
            r,
        )
    else:
        speed = x[3]
        if slots[KIND] == AMOUNT:
            direction = direction_of(
                nav,
                step,
                xi,
                column_of,
                hold_height,
                x[0],
                x[1],
                x[2],
                first,
                p,
                z,
                h,
            )
            if direction == 0.0:
                return False
            speed = math.copysign(speed, direction)
        speed_rows(
            nav,
            step,
            xi,
            column_of,
            hold_height,
            x[0],
            x[1],
            x[2],
            first,
            speed,
            x[4],
            x[5],
            second,
            initial,
            z,
            h,
            r,
        )
    return True
