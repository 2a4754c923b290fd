"""Compiled kernels: rotation of P and sensitivities after an update that rotated the tilt axes.

Equations: fusiond.estimators.tilt_frame_after_heading_update, gyro_error_after_rate_update and
antenna_position_after_attitude_update.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.antenna_position_after_attitude_update import keep_antenna
from fusiond.estimators.fault_carried import mix
from fusiond.estimators.gyro_error_after_rate_update import keep_turn
from fusiond.estimators.tilt_axes_propagation import UPRIGHT
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import DR, PHI
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import NAV_SIZE, Q0

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Below this (m/s^2) of s_a s_b it is left: velocities good to 0.1 m/s show an acceleration of 2e-3
# within a minute, and no update of a vehicle that knows its tilt pays for it.
SLIGHT_M_S2 = 1e-4


@compiled("f8(f8[::1], f8[::1])")
def heading_turn(before: Array, after: Array) -> float:
    """Rotation (rad) about the vertical from one attitude q_nb (4,) to another."""
    w, x, y, z = before[0], before[1], before[2], before[3]
    to_w, to_x, to_y, to_z = after[0], after[1], after[2], after[3]
    along = w * to_w + x * to_x + y * to_y + z * to_z
    about = w * to_z - z * to_w + x * to_y - y * to_x
    psi = 2.0 * math.atan2(about, along)
    return psi - 2.0 * math.pi * round(psi / (2.0 * math.pi))


@compiled("void(f8[:, :], f8[::1], f8[::1], i8[::1], i8[::1])")
def keep_down_rows(m: Array, before: Array, after: Array, slots: Indices, axes: Indices) -> None:
    """M (n, k) <- T M: keep (C b)_D of attitude q_nb (4,) `before` in the axes of `after`; `slots`
    and `axes` as in `turn_rows`."""
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
    """M (n, k) <- T M: transfer the information on tilt and force biases from attitude q_nb (4,)
    `before` to `after`; P becomes T P T^T.

    `slots` (j,) of the force biases and their `axes`, first that of the vertical axis, which takes
    the remainder; empty if a model has none.
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
    """True if an update may separate tilt and force biases, the `slots` (j,) of P (n, n), that were
    inseparable so far."""
    if slots.size == 0:
        return False
    tilt = max(p[PHI, PHI], p[PHI + 1, PHI + 1])
    force = STANDARD_GRAVITY_M_S2**2 * p[PHI + 2, PHI + 2]
    for slot in slots:
        force = max(force, p[slot, slot])
    apart: bool = tilt * force > SLIGHT_M_S2**2
    return apart


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
    """Apply M (n, k) <- T M after an update of an estimate `before`.

    The update has rotated the axes by `turned` (rad); gyro errors and antenna position are kept.
    """
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
    """Preserve the downward component of the force `biases` in xi, along the mean of the axes
    before and after; the vertical bias takes the difference."""
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


@compiled("i8[::1](i8[::1], i8[::1], i8[::1], i8[::1])", allocates=True)
def _turned_slots(forces: Indices, gyros: Indices, lever: Indices, late: Indices) -> Indices:
    """Slots (k,) whose rows and columns of an update's T differ from the identity."""
    behind = 3 + forces.size + gyros.size
    slots = np.empty(behind + (3 + lever.size + late.size if lever.size else 0), dtype=np.int64)
    for j in range(3):
        slots[j] = PHI + j
    for j in range(forces.size):
        slots[3 + j] = forces[j]
    for j in range(gyros.size):
        slots[3 + forces.size + j] = gyros[j]
    if lever.size:
        for j in range(3):
            slots[behind + j] = DR + j
        for j in range(lever.size):
            slots[behind + 3 + j] = lever[j]
        for j in range(late.size):
            slots[behind + 3 + lever.size + j] = late[j]
    return slots


@compiled("void(f8[:, ::1], i8[::1], f8[:, ::1])", allocates=True)
def turn_covariance(cov: Array, slots: Indices, t: Array) -> None:
    """Transform P <- T P T^T of P (w, w), where T is the identity but for rows and columns `slots`
    (k,): t (k, k)."""
    count, end = slots.shape[0], 0
    mixed, rows = np.empty(count, dtype=np.int64), np.zeros((count, cov.shape[1]))
    for a in range(count):
        entries = 0
        for b in range(count):
            entries += t[a, b] != 0.0
        if entries == 1 and t[a, a] == 1.0:
            continue
        out = rows[end]
        for b in range(count):
            c, row = t[a, b], cov[slots[b]]
            if c != 0.0:
                for j in range(out.shape[0]):
                    out[j] += c * row[j]
        mixed[end] = a
        end += 1
    crossed = np.zeros((end, end))
    for i in range(end):
        for k in range(i + 1):
            for b in range(count):
                crossed[i, k] += rows[i, slots[b]] * t[mixed[k], b]
            crossed[k, i] = crossed[i, k]
    for i in range(end):
        for k in range(end):
            rows[i, slots[mixed[k]]] = crossed[i, k]
    for i in range(end):
        for j in range(cov.shape[1]):
            cov[slots[mixed[i]], j] = cov[j, slots[mixed[i]]] = rows[i, j]


@compiled(
    "f8(f8[:, ::1], i8, f8[::1], f8[::1], f8[::1], f8[::1], i8[:, ::1], i8[::1], i8[::1], i8[::1])",
    allocates=True,
)
def carry_over(
    cov: Array,
    n: int,
    bank: Array,
    before: Array,
    nav: Array,
    xi: Array,
    biases: Indices,
    gyros: Indices,
    lever: Indices,
    late: Indices,
) -> float:
    """Transform P <- T P T^T and V <- T V after an update.

    P (w, w) has n states; V is that of a `bank`, if it has any room; `before` is the earlier
    estimate. Applies `keep_downward` to xi (n,). Returns the rotation (rad) of the axes about the
    vertical by the update.
    """
    keep_downward(before, nav, xi, biases)
    turned = heading_turn(before[Q0:NAV_SIZE], nav[Q0:])
    slots = _turned_slots(biases[0], gyros, lever, late)
    m, t = np.zeros((n, slots.size)), np.empty((slots.size, slots.size))
    for a in range(slots.size):
        m[slots[a], a] = 1.0
    turn_rows(m, before[Q0:NAV_SIZE], nav[Q0:], biases[0], biases[1])
    keep_rows(m, before, nav, xi, turned, gyros, lever, late)
    for a in range(slots.size):
        t[a] = m[slots[a]]
    turn_covariance(cov, slots, t)
    if bank.size:
        mix(bank, n, slots, t)
    return turned
