"""Compiled kernels: P and sensitivities after an update that turned the axes of a tilt.

As fusiond.estimators.tilt_axes says, with what turn_rate and antenna_place add.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.antenna_place import keep_antenna
from fusiond.estimators.turn_rate import keep_turn
from fusiond.estimators.turned_axes import UPRIGHT
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import PHI
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import NAV_SIZE, Q0

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Below this (m/s^2) of s_a s_b it is left: velocities good to 0.1 m/s show an acceleration of 2e-3
# within a minute, and no update of a vehicle that knows its tilt pays for it.
SLIGHT_M_S2 = 1e-4


@compiled("f8(f8[::1], f8[::1])")
def heading_turn(before: Array, after: Array) -> float:
    """By how much (rad) about the vertical an attitude q_nb (4,) was turned to another."""
    w, x, y, z = before[0], before[1], before[2], before[3]
    to_w, to_x, to_y, to_z = after[0], after[1], after[2], after[3]
    along = w * to_w + x * to_x + y * to_y + z * to_z
    about = w * to_z - z * to_w + x * to_y - y * to_x
    psi = 2.0 * math.atan2(about, along)
    return psi - 2.0 * math.pi * round(psi / (2.0 * math.pi))


@compiled("void(f8[:, :], f8[::1], f8[::1], i8[::1], i8[::1])")
def keep_down_rows(m: Array, before: Array, after: Array, slots: Indices, axes: Indices) -> None:
    """M (n, k) <- T M: (C b)_D stays as it was known of the attitude q_nb (4,) `before`, in those
    of the one `after`; `slots` and `axes` as for `turn_rows`."""
    old, new = dcm_elements(before), dcm_elements(after)
    if slots.size == 0 or abs(new[8]) < UPRIGHT:
        return
    for k in range(m.shape[1]):
        left = 0.0
        for j in range(slots.size):
            axis = 6 + axes[j]
            left += (old[axis] - new[axis]) * m[slots[j], k]
        m[slots[0], k] += left / new[8]


@compiled("void(f8[:, :], f8[::1], f8[::1], i8[::1], i8[::1])")
def turn_rows(m: Array, before: Array, after: Array, slots: Indices, axes: Indices) -> None:
    """M (n, k) <- T M: as well as tilt and force biases together were known of the attitude q_nb
    (4,) `before`, they are of the one `after` with T P T^T.

    `slots` (j,) of the force biases and their `axes`, the first of them the one of the vertical
    axis that takes what is left; empty where a model has none.
    """
    psi = heading_turn(before, after)
    c, s = math.cos(psi), math.sin(psi)
    for k in range(m.shape[1]):
        north, east = m[PHI, k], m[PHI + 1, k]
        m[PHI, k] = c * north - s * east
        m[PHI + 1, k] = s * north + c * east
    keep_down_rows(m, before, after, slots, axes)


@compiled("b1(f8[:, :], i8[::1])")
def may_part(p: Array, slots: Indices) -> bool:
    """True if an update may tell tilt and force biases, the `slots` (j,) of P (n, n), apart that
    nothing has told apart."""
    if slots.size == 0:
        return False
    tilt = max(p[PHI, PHI], p[PHI + 1, PHI + 1])
    force = STANDARD_GRAVITY_M_S2**2 * p[PHI + 2, PHI + 2]
    for slot in slots:
        force = max(force, p[slot, slot])
    apart: bool = tilt * force > SLIGHT_M_S2**2
    return apart


@compiled("f8(f8[:, :], f8[::1], f8[::1], i8[:, ::1])")
def carry_over(p: Array, before: Array, after: Array, biases: Indices) -> float:
    """P (n, n) after an update that has turned the attitude q_nb (4,) `before` to `after`, which is
    by so much (rad) about the vertical."""
    turn_rows(p, before, after, biases[0], biases[1])
    turn_rows(p.T, before, after, biases[0], biases[1])
    return heading_turn(before, after)


# An estimate before an update: nav, the gyros' biases, what is left of a lever arm, the force
# biases; behind it what the update has told of the gyros, and the lever then.
_GYROS, _ARM, _FORCES, _TOLD, _ARM_AFTER, ESTIMATE_SIZE = NAV_SIZE, 13, 16, 19, 22, 25


@compiled("void(f8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], f8[::1])")
def remember_estimate(
    nav: Array, xi: Array, biases: Indices, gyros: Indices, lever: Indices, before: Array
) -> None:
    """Write the estimate to `before` (25,).

    Taken from nav (10,) and the slots (0 to 3,) in xi (n,), those of the force `biases` with their
    axes (2, k)."""
    for j in range(NAV_SIZE):
        before[j] = nav[j]
    for j in range(biases.shape[1]):
        before[_FORCES + j] = xi[biases[0, j]]
    for j in range(gyros.size):
        before[_GYROS + j] = xi[gyros[j]]
    for j in range(lever.size):
        before[_ARM + j] = xi[lever[j]]


@compiled("void(f8[:, :], f8[::1], f8[::1], f8[::1], f8, i8[::1], i8[::1], i8[::1])")
def keep_rows(
    m: Array,
    before: Array,
    nav: Array,
    xi: Array,
    turned: float,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> None:
    """M (n, k) <- T M after an update of an estimate `before`, which has `turned` the axes (rad):
    what is known of the gyros, and of the antenna's place."""
    if gyros.size:
        told = before[_TOLD:_ARM_AFTER]
        for j in range(3):
            told[j] = xi[gyros[j]] - before[_GYROS + j]
        keep_turn(m, before[Q0:NAV_SIZE], nav[Q0:], turned, told, gyros)
    if lever.size:
        after = before[_ARM_AFTER:ESTIMATE_SIZE]
        for j in range(3):
            after[j] = xi[lever[j]]
        keep_antenna(m, before[:NAV_SIZE], nav, before[_ARM:_TOLD], after, lever, late)


@compiled("void(f8[::1], f8[::1], f8[::1], i8[:, ::1])")
def keep_downward(before: Array, nav: Array, xi: Array, biases: Indices) -> None:
    """Share of an update in xi's force `biases` downward, along the mean of the axes before and
    after: the vertical bias takes the difference."""
    if biases.shape[1] == 0:
        return
    old, new = dcm_elements(before[Q0:NAV_SIZE]), dcm_elements(nav[Q0:])
    if abs(new[8]) < UPRIGHT:
        return
    beyond = 0.0
    for j in range(biases.shape[1]):
        axis = 6 + biases[1, j]
        beyond += 0.5 * (new[axis] - old[axis]) * (xi[biases[0, j]] - before[_FORCES + j])
    xi[biases[0, 0]] -= beyond / new[8]


@compiled("f8(f8[:, :], f8[::1], f8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1])")
def carry_over_all(
    p: Array,
    before: Array,
    nav: Array,
    xi: Array,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> float:
    """`carry_over` of P (n, n), and `keep_rows` of it; `keep_downward` of xi (n,)."""
    keep_downward(before, nav, xi, biases)
    turned = carry_over(p, before[Q0:NAV_SIZE], nav[Q0:], biases)
    keep_rows(p, before, nav, xi, turned, gyros, lever, late)
    keep_rows(p.T, before, nav, xi, turned, gyros, lever, late)
    return turned


@compiled("void(f8[:, :], f8[::1], f8[::1], f8[::1], f8, i8[:, ::1], i8[::1], i8[::1], i8[::1])")
def carry_over_rows(
    m: Array,
    before: Array,
    nav: Array,
    xi: Array,
    turned: float,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> None:
    """V <- T V for sensitivities (n, k), as `carry_over_all` does P."""
    turn_rows(m, before[Q0:NAV_SIZE], nav[Q0:], biases[0], biases[1])
    keep_rows(m, before, nav, xi, turned, gyros, lever, late)
