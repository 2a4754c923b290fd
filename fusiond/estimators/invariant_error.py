"""Kernels for a state with an error in invariant coordinates.

`velocity` and `place` (3,): the parts of velocity and position that turn with the heading;
`speeds`: true if the velocity part is the speed; `mounting` (0 or 2,): slots of the IMU's pitch and
yaw against the vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.update import feed_back
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, DR, DV, PHI
from fusiond.navigation.rotation import quaternion_to_dcm, turn_to_dcm
from fusiond.navigation.strapdown import (
    Q0,
    STEP_DCM,
    STEP_FORCE_N,
    STEP_SMOOTH_N,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def _product(a: Array, b: Array, out: Array) -> None:
    """Write A B (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@compiled("void(f8, f8[:, ::1])")
def about_down(psi: float, turn: Array) -> None:
    """Write the rotation (3, 3) by psi (rad) about the vertical."""
    turn[:] = 0.0
    turn[0, 0] = turn[1, 1] = math.cos(psi)
    turn[1, 0] = math.sin(psi)
    turn[0, 1] = -turn[1, 0]
    turn[2, 2] = 1.0


@compiled("void(f8[::1], f8[:, ::1], f8[:, ::1])", allocates=True)
def turns_of(error: Array, level: Array, whole: Array) -> None:
    """Write R(psi) and E (3, 3) of an error (n,) in xi."""
    tilt = np.empty((3, 3))
    turn_to_dcm(error[PHI], error[PHI + 1], 0.0, tilt)
    about_down(error[PHI + 2], level)
    _product(level, tilt, whole)


@compiled("void(f8[::1], f8[::1], i8[::1], f8[:, ::1])", allocates=True)
def vehicle_axes(nav: Array, xi: Array, mounting: Indices, axes: Array) -> None:
    """Write C_nv (3, 3) of the vehicle."""
    quaternion_to_dcm(nav[Q0:], axes)
    if mounting.size:
        dcm, turn = axes.copy(), np.empty((3, 3))
        # exp(-m x) is the inverse of exp(m x).
        turn_to_dcm(0.0, -xi[mounting[0]], -xi[mounting[1]], turn)
        _product(dcm, turn, axes)


@compiled(
    "void(f8[:, ::1], f8[::1], f8[::1], i8[::1], b1[::1], f8)",
    allocates=True,
)
def mount(m: Array, nav: Array, xi: Array, mounting: Indices, active: Flags, sign: float) -> None:
    """Apply M (n, n), with identity rows for the mounting, from the vehicle's dx to the IMU's; with
    -1 the inverse."""
    if mounting.size:
        axes = np.empty((3, 3))
        vehicle_axes(nav, xi, mounting, axes)
        for i in range(3):
            for k in range(2):
                m[PHI + i, mounting[k]] = sign * axes[i, 1 + k]
    for i in range(active.size):
        if not active[i]:
            m[i] = 0.0


@compiled("void(f8[::1], f8[::1], f8[::1], b1, f8[:, ::1])", allocates=True)
def write_jacobian(error: Array, velocity: Array, place: Array, speeds: bool, j: Array) -> None:
    """Write J (n, n), the vehicle's dx by xi, at the state that an error (n,) leads to."""
    level, whole, turning = np.empty((3, 3)), np.empty((3, 3)), velocity.copy()
    turns_of(error, level, whole)
    j[:] = 0.0
    for i in range(CORE_SIZE, error.size):
        j[i, i] = 1.0
    if speeds:
        turning -= error[DV : DV + 3]
    for first in (PHI, DV, DR):
        block = whole if speeds and first == DV else level
        for i in range(3):
            for k in range(3):
                j[first + i, first + k] = block[i, k]
    for first in (DV, DR):
        part = turning if first == DV else place
        x = whole[0, 0] * part[0] + whole[0, 1] * part[1] + whole[0, 2] * part[2]
        y = whole[1, 0] * part[0] + whole[1, 1] * part[1] + whole[1, 2] * part[2]
        z = whole[2, 0] * part[0] + whole[2, 1] * part[1] + whole[2, 2] * part[2]
        for k in range(3):
            j[first, PHI + k] = y * level[2, k] - z * level[1, k]
            j[first + 1, PHI + k] = z * level[0, k] - x * level[2, k]
            j[first + 2, PHI + k] = x * level[1, k] - y * level[0, k]


@compiled("void(f8[:, ::1], f8[::1])")
def rotation_vector(dcm: Array, phi: Array) -> None:
    """Write phi (3,) of exp(phi x); for half a turn without a defined axis that about down."""
    x = 0.5 * (dcm[2, 1] - dcm[1, 2])
    y = 0.5 * (dcm[0, 2] - dcm[2, 0])
    z = 0.5 * (dcm[1, 0] - dcm[0, 1])
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (dcm[0, 0] + dcm[1, 1] + dcm[2, 2] - 1.0))
    if sine < 1e-9:
        phi[0], phi[1], phi[2] = 0.0, 0.0, angle
    else:
        share = angle / sine
        phi[0], phi[1], phi[2] = x * share, y * share, z * share


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], b1, i8[::1], b1[::1])", allocates=True)
def take_out(
    nav: Array,
    xi: Array,
    error: Array,
    velocity: Array,
    place: Array,
    speeds: bool,
    mounting: Indices,
    active: Flags,
) -> None:
    """Subtract an `error` (n,) in xi from the state (10,) and the parameters (n,)."""
    level, whole, d = np.empty((3, 3)), np.empty((3, 3)), error.copy()
    turns_of(error, level, whole)
    for first in (DV, DR):
        part = velocity if first == DV else place
        axes = whole if speeds and first == DV else level
        for i in range(3):
            d[first + i] = part[i]
            for j in range(3):
                d[first + i] += axes[i, j] * error[first + j] - whole[i, j] * part[j]
    if mounting.size:
        axes, turn, more = np.empty((3, 3)), whole.copy(), np.empty((3, 3))
        vehicle_axes(nav, xi, mounting, axes)
        a, b = error[mounting[0]], error[mounting[1]]
        x, y = axes[0, 1] * a + axes[0, 2] * b, axes[1, 1] * a + axes[1, 2] * b
        turn_to_dcm(x, y, axes[2, 1] * a + axes[2, 2] * b, more)
        _product(turn, more, whole)
    rotation_vector(whole, d[PHI : PHI + 3])
    for i in range(active.size):
        if not active[i]:
            d[i] = 0.0
    feed_back(nav, xi, d)


@compiled("void(f8[::1], f8)")
def turn_step(step: Array, psi: float) -> None:
    """Rotate the last step (28,) by psi (rad)."""
    c, s = math.cos(psi), math.sin(psi)
    for first in (STEP_FORCE_N, STEP_SMOOTH_N):
        north, east = step[first], step[first + 1]
        step[first], step[first + 1] = c * north - s * east, s * north + c * east
    for j in range(STEP_DCM, STEP_DCM + 3):
        north, east = step[j], step[j + 3]
        step[j], step[j + 3] = c * north - s * east, s * north + c * east


@compiled(
    "Tuple((f8, f8))(f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])", allocates=True
)
def solve(nu: Array, h: Array, r: Array, p: Array, y: Array, gain: Array) -> tuple[float, float]:
    """nu^T S^-1 nu and ln |S|; infinite and 0 where S is not positive.

    Of nu (m,), H (m, n), variances r (m,) and P (n, n). Writes L^-1 nu (m,), where S = L L^T, and
    K^T (m, n)."""
    m, n = h.shape
    nis = log = 0.0
    for a in range(m):
        for j in range(n):
            gain[a, j] = 0.0
        for i in range(n):
            if h[a, i] != 0.0:
                for j in range(n):
                    gain[a, j] += h[a, i] * p[i, j]
    factor = np.zeros((m, m))
    for a in range(m):
        for b in range(a + 1):
            total = r[a] if a == b else 0.0
            for i in range(n):
                total += gain[a, i] * h[b, i]
            for c in range(b):
                total -= factor[a, c] * factor[b, c]
            if b < a:
                factor[a, b] = total / factor[b, b]
            elif total > 0.0:
                factor[a, a] = math.sqrt(total)
            else:
                return math.inf, 0.0
        y[a] = nu[a]
        for b in range(a):
            y[a] -= factor[a, b] * y[b]
        y[a] /= factor[a, a]
        nis += y[a] * y[a]
        log += 2.0 * math.log(factor[a, a])
    for j in range(n):
        for a in range(m):
            for b in range(a):
                gain[a, j] -= factor[a, b] * gain[b, j]
            gain[a, j] /= factor[a, a]
        for a in range(m - 1, -1, -1):
            for b in range(a + 1, m):
                gain[a, j] -= factor[b, a] * gain[b, j]
            gain[a, j] /= factor[a, a]
    return nis, log
