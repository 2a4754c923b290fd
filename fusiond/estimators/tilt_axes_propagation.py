"""Compiled kernels: effect of an interval on the tilt axes of a covariance.

The equations are in fusiond.estimators.tilt_frame_after_heading_update. Covariances (width, width)
are flat, and P21 is not used: it is copied from P12 (fusiond.estimators.covariance_propagation).
`rest_axes` does the same as `turn_rows` after an update, which needs a complete covariance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import PLAIN
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.navigation.strapdown import STEP_DCM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Cosine of the tilt beyond which no accelerometer is the vertical one.
UPRIGHT = 0.5
# A turn: cosine and sine about down, and by how much of each bias the vertical one changes.
TURN_SIZE = 5


@compiled("void(f8[::1], i8, f8)", forceinline=True)
def turn_tilt(cov: Array, width: int, known: float) -> None:
    """Add to `cov`, flat and of `width` rows, a turn's effect on the tilt axes, if it may not have
    been real: the heading variance before it was `known` (rad^2)
    (fusiond.estimators.tilt_frame_after_heading_update)."""
    grown = cov[2 * width + 2] - known
    if grown > 0.0:
        north, east, both = cov[0], cov[width + 1], cov[1]
        cov[0] += grown * east
        cov[width + 1] += grown * north
        cov[1] -= grown * both
        cov[width] = cov[1]


@compiled("void(f8[::1], i8, f8[::1], i8[::1], i8[::1], f8, f8)", forceinline=True)
def turn_down(
    cov: Array,
    width: int,
    step: Array,
    sensor_slot: Indices,
    sensor_kind: Indices,
    grown_north: float,
    grown_east: float,
) -> None:
    """Add to `cov`, flat and of `width` rows, the effect of a tilt from gyro errors on the vertical
    force: variances (rad^2) by which a tilt has `grown`, times those of the lateral force biases
    (fusiond.estimators.tilt_frame_after_heading_update)."""
    upright = step[STEP_DCM + 8]
    north, east, vertical = 0.0, 0.0, -1
    for i in range(6, 12):
        if sensor_kind[i] != PLAIN:
            continue
        row = sensor_slot[i] * width
        if i // 2 == 5:
            vertical = sensor_slot[i]
        for k in range(6, 12):
            if sensor_kind[k] == PLAIN:
                p = cov[row + sensor_slot[k]]
                a, b = STEP_DCM + i // 2 - 3, STEP_DCM + k // 2 - 3
                north += step[a] * step[b] * p
                east += step[a + 3] * step[b + 3] * p
    if vertical >= 0 and abs(upright) >= UPRIGHT:
        more = max(grown_north, 0.0) * east + max(grown_east, 0.0) * north
        cov[vertical * width + vertical] += more / (upright * upright)


@compiled("void(f8, f8, f8, f8, f8[::1], f8[::1])", forceinline=True)
def turn_at_rest(w: float, x: float, y: float, z: float, after: Array, turn: Array) -> None:
    """Write `turn` (5,) from an attitude q_nb to the one `after` (4,)."""
    w1, x1, y1, z1 = after[0], after[1], after[2], after[3]
    along = w * w1 + z * z1 + x * x1 + y * y1
    about = w * z1 - z * w1 + x * y1 - y * x1
    both = along * along + about * about
    turn[0], turn[1] = (along * along - about * about) / both, 2.0 * along * about / both
    upright = 1.0 - 2.0 * (x1 * x1 + y1 * y1)
    turn[2] = turn[3] = turn[4] = 0.0
    if abs(upright) >= UPRIGHT:
        turn[2] = 2.0 * ((x * z - w * y) - (x1 * z1 - w1 * y1)) / upright
        turn[3] = 2.0 * ((y * z + w * x) - (y1 * z1 + w1 * x1)) / upright
        turn[4] = 2.0 * ((x1 * x1 + y1 * y1) - (x * x + y * y)) / upright


@compiled("i8(i8[::1], i8[::1])", forceinline=True)
def _vertical(sensor_slot: Indices, sensor_kind: Indices) -> int:
    """Slot of the force bias that takes the downward remainder; -1 without one."""
    for i in range(10, 12):
        if sensor_kind[i] == PLAIN:
            slot: int = sensor_slot[i]
            return slot
    return -1


@compiled("f8(f8[::1], i8, i8, f8[::1], i8[::1], i8[::1])", forceinline=True)
def _left(
    rows: Array, at: int, stride: int, turn: Array, sensor_slot: Indices, sensor_kind: Indices
) -> float:
    """Share of the entries of the force biases, the first of all at `at`, for the vertical one."""
    left = 0.0
    for i in range(6, 12):
        if sensor_kind[i] == PLAIN:
            left += turn[i // 2 - 1] * rows[at + sensor_slot[i] * stride]
    return left


@compiled("void(f8[::1], i8, i8, f8[::1], i8[::1], i8[::1])")
def rest_rows(
    rows: Array,
    width: int,
    count: int,
    turn: Array,
    sensor_slot: Indices,
    sensor_kind: Indices,
) -> None:
    """M <- T M of a `turn` at rest; M is flat, with `count` columns in rows of `width`."""
    vertical = _vertical(sensor_slot, sensor_kind)
    for j in range(count):
        north, east = rows[j], rows[width + j]
        rows[j] = turn[0] * north - turn[1] * east
        rows[width + j] = turn[1] * north + turn[0] * east
        if vertical >= 0:
            left = _left(rows, j, width, turn, sensor_slot, sensor_kind)
            rows[vertical * width + j] += left


@compiled("void(f8[::1], i8, i8, f8[::1], i8[::1], i8[::1])")
def rest_axes(
    cov: Array,
    width: int,
    n: int,
    turn: Array,
    sensor_slot: Indices,
    sensor_kind: Indices,
) -> None:
    """Transform P <- T P T^T of n states, for a `turn` at rest."""
    rest_rows(cov, width, n, turn, sensor_slot, sensor_kind)
    vertical = _vertical(sensor_slot, sensor_kind)
    for i in range(n):
        at = i * width
        if i < CORE_SIZE:
            north, east = cov[at], cov[at + 1]
            cov[at] = turn[0] * north - turn[1] * east
            cov[at + 1] = turn[1] * north + turn[0] * east
        if vertical >= 0:
            cov[at + vertical] += _left(cov, at, 1, turn, sensor_slot, sensor_kind)
