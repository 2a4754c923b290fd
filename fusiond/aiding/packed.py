"""Measurements as packed rows of numbers, from which one compiled kernel computes innovations.

A timeline that runs again has hundreds of them, and a call of Python for each would cost more than
all that a filter does with it. Position, velocity, no slip and a wheel's speed have such a row;
others make their innovations themselves.

A row is `HEADER`, which the timeline fills, and a body of the measurement's own: what its kernel
takes, in that order, each list of slots with its length before it. Integers are those of 64 bits in
the same places.
"""

from __future__ import annotations

import math
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import NO_SLIP, POSITION, VELOCITY, speed_of
from fusiond.aiding.body_velocity import direction_of, no_slip_rows, speed_rows
from fusiond.aiding.position import position_rows
from fusiond.aiding.velocity import velocity_rows
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

HEADER = Struct("<3qd4q")
"""Header of a row: kind, instant (ns), number of rows, gate (chi-square), series number. Then the
measures and device for the bank (fusiond.estimators.fault_bank), and the requests."""
KIND, T_NS, ROWS, GATE, SERIES, MEASURES, OF_DEVICE, ASKED, BODY = range(9)
MEASURED, MOTION_ASKED = 1, 2
"""Flags of `ASKED`: a measurement, not a constraint; motion of the vehicle is to be reported with
the outcome."""
SIZE = 40
"""Numbers of a row."""
APPLIES, TOO_SLOW, NO_DIRECTION = range(3)
NAMES = ("", "too_slow", "direction_unknown")
"""Names of a kernel's results."""


@compiled("i8[::1](i8[::1], i8)", forceinline=True, allocates=True)
def _slots(ints: Indices, at: int) -> Indices:
    """Slots of a list whose length is at `at`."""
    return ints[at + 1 : at + 1 + ints[at]]


@compiled(
    "i8(f8[::1], UniTuple(f8[::1], 3), Tuple((i8[::1], f8[::1], b1)), f8[:, :], f8[::1],"
    "f8[:, ::1], f8[::1])",
    allocates=True,
)
def packed_rows(
    x: Array,
    state: tuple[Array, Array, Array],
    model: tuple[Indices, Array, bool],
    p: Array,
    z: Array,
    h: Array,
    r: Array,
) -> int:
    """Write z (m,), H (m, n) and r (m,) of the row `x` (SIZE,); returns `APPLIES` or a refusal.

    `state`: a filter's state (10,), parameters (n,) and last step, with P (n, n); `model`: columns
    and initial sigmas of its parameters (n,), and whether it holds the height.
    """
    nav, xi, step = state
    column_of, initial, hold_height = model
    ints = x.view(np.int64)
    kind, a = ints[KIND], BODY
    if kind == POSITION:
        position_rows(
            *(nav, xi, step, column_of),
            *(_slots(ints, a + 14), _slots(ints, a + 18), _slots(ints, a + 20)),
            _slots(ints, a + 24),
            *(x[a], x[a + 1], x[a + 2], x[a + 3], x[a + 4], x[a + 5], x[a + 6], x[a + 7]),
            *(x[a + 8], x[a + 9], x[a + 10], x[a + 11], x[a + 12], x[a + 13]),
            *(p, z, h, r),
        )
    elif kind == VELOCITY:
        velocity_rows(
            *(nav, xi, step, column_of),
            *(_slots(ints, a + 10), _slots(ints, a + 12), _slots(ints, a + 16)),
            *(x[a], x[a + 1], x[a + 2], x[a + 3], x[a + 4], x[a + 5], x[a + 6], x[a + 7]),
            *(x[a + 8], x[a + 9]),
            *(z, h, r),
        )
    elif kind == NO_SLIP:
        if speed_of(nav) < x[a + 5]:
            return TOO_SLOW
        no_slip_rows(
            *(nav, step, xi, column_of, hold_height, x[a], x[a + 1], x[a + 2]),
            *(ints[a + 7 : a + 13], x[a + 6], x[a + 3], x[a + 4], z, h, r),
        )
    else:
        slots, speed = ints[a + 8 : a + 14], x[a + 3]
        at = nav, step, xi, column_of, hold_height, x[a], x[a + 1], x[a + 2], slots, x[a + 6]
        if ints[a + 7] == 0:
            direction = direction_of(*at, p, z, h)
            if direction == 0.0:
                return NO_DIRECTION
            speed = math.copysign(speed, direction)
        speed_rows(*at, speed, x[a + 4], x[a + 5], _slots(ints, a + 14), initial, z, h, r)
    return APPLIES
