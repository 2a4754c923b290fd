r"""The point of a vehicle that a receiver's antenna is, and how it moves.

    v_a = v + C (w x l),   d v_a = dv + (C (w x l)) x phi - C [l x] e + C [w x] dl'

l is the lever arm from the IMU, its rest dl' computed minus true; w the rate of the body against
the Earth. An offset in time multiplies v_a: what of the product of two errors a linear filter
leaves out is noise to it, and so is what its square makes of the acceleration,

    q = P_tau P_v + P_v,tau^2 + a^2 P_tau^2 / 2

Of a velocity's offset the like, out of the error of the acceleration, is not taken for noise: on
drive_0708 it cost a tenth of the accuracy in outages, and took the NEES of such an offset, at a
start that is off level by a degree, from 2.8 to 2.0 only.

Source: Groves, 2nd ed., eq. 14.109; Bar-Shalom, Li, Kirubarajan (2001), section 10.3.2 (second
order terms).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import State, Vector3
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import Q0, STEP_RATE_B, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled("void(f8[::1], f8[::1], i8[::1], f8, f8, f8, f8[::1], f8[:, ::1])")
def _velocity(
    nav: Array,
    step: Array,
    column_of: Indices,
    l0: float,
    l1: float,
    l2: float,
    z: Array,
    h: Array,
) -> None:
    """Write the antenna's velocity z (m,) and H (m, n), zero before: the first m of n, e, d."""
    c = dcm_elements(nav[Q0:])
    w0, w1, w2 = step[STEP_RATE_B], step[STEP_RATE_B + 1], step[STEP_RATE_B + 2]
    u0, u1, u2 = w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0
    x = c[0] * u0 + c[1] * u1 + c[2] * u2
    y = c[3] * u0 + c[4] * u1 + c[5] * u2
    d = c[6] * u0 + c[7] * u1 + c[8] * u2
    z[0], z[1] = nav[VN] + x, nav[VN + 1] + y
    h[0, 1], h[0, 2] = -d, y
    h[1, 0], h[1, 2] = d, -x
    h[0, 3] = h[1, 4] = 1.0
    if z.shape[0] > 2:
        z[2] = nav[VN + 2] + d
        h[2, 0], h[2, 1] = -y, x
        h[2, 5] = 1.0
    for i in range(z.shape[0]):
        a, b, e = c[3 * i], c[3 * i + 1], c[3 * i + 2]
        for slot in range(CORE_SIZE, column_of.shape[0]):
            axis = column_of[slot] - RATE_ERROR
            if axis == 0:
                h[i, slot] = e * l1 - b * l2
            elif axis == 1:
                h[i, slot] = a * l2 - e * l0
            elif axis == 2:
                h[i, slot] = b * l0 - a * l1


def antenna(state: State, lever: Vector3, block: str) -> tuple[Vector3, list[int]]:
    """The lever arm (m) with the estimate of its rest, and the slots of that, none without it."""
    slots = state.model.slots_of(block)
    if not slots:
        return lever, slots
    x, y, z = (a + float(state.xi[slot]) for a, slot in zip(lever, slots, strict=True))
    return (x, y, z), slots


def antenna_velocity(
    state: State, lever: Vector3, levers: list[int], rows: int
) -> tuple[Array, Array]:
    """v_a (rows,) of north, east, down, and d v_a (rows, n)."""
    z, h = np.empty(rows), np.zeros((rows, state.model.size))
    _velocity(state.nav, state.step, state.model.column_of, *lever, z, h)
    if levers:
        x, y, w = state.rate_b
        turn = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
        h[:, levers] = -(state.dcm @ turn)[:rows]
    return z, h


def force_matrix(state: State) -> Array:
    """[f x] (3, 3): what an attitude error makes of the acceleration, da = [f x] phi + C a_b."""
    x, y, w = state.step[STEP_SMOOTH_N : STEP_SMOOTH_N + 3]
    return np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])


def left_out(state: State, slot: int, of_v: Array, a: Array) -> Array:
    """q (m,) of the offset in `slot`, with d v_a (m, n) and the acceleration (m,); 0 without P."""
    p = state.covariance
    if p is None:
        return np.zeros(len(a))
    across = of_v @ p
    q: Array = np.einsum("ij,ij->i", across, of_v) * p[slot, slot] + np.square(across[:, slot])
    q += 0.5 * np.square(a * p[slot, slot])
    return q.clip(min=0.0)
