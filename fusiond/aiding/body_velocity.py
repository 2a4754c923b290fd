r"""Velocity in body axes: non-holonomic constraint and wheel speed.

At a point l of the vehicle (rear axle, wheel), with the body's rate w:

    z = C^T v^ + w x l - v_b = C^T dv - C^T [v x] phi - [l x] e + v

Non-holonomic: v_b right and down are 0. Wheel speed: v_b forward is what the wheel says.

Source: Dissanayake et al., The aiding of a low-cost strapdown IMU using vehicle constraints, IEEE
T-RA 17 (2001), eq. 8; Groves, 2nd ed., section 15.4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.aiding.offers import SpeedOffer
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import Q0, STEP_RATE_B, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FORWARD, RIGHT = 0, 1


@compiled("void(f8[::1], f8[::1], i8[::1], b1, f8, f8, f8, i8, f8[::1], f8[:, ::1])")
def _rows(
    nav: Array,
    step: Array,
    column_of: Indices,
    hold_height: bool,
    l0: float,
    l1: float,
    l2: float,
    first: int,
    z: Array,
    h: Array,
) -> None:
    """Write the point's velocity along body axes first, first + 1 ... to z (m,), and H (m, n)."""
    c = dcm_elements(nav[Q0:])
    w0, w1, w2 = step[STEP_RATE_B], step[STEP_RATE_B + 1], step[STEP_RATE_B + 2]
    v0, v1, v2 = nav[VN], nav[VN + 1], nav[VN + 2]
    turning = (w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0)
    # Rows of -[l x].
    arm = (0.0, l2, -l1, -l2, 0.0, l0, l1, -l0, 0.0)
    for i in range(z.shape[0]):
        axis = first + i
        a, b, e = c[axis], c[3 + axis], c[6 + axis]
        z[i] = a * v0 + b * v1 + e * v2 + turning[axis]
        h[i, 0] = e * v1 - b * v2
        h[i, 1] = a * v2 - e * v0
        h[i, 2] = b * v0 - a * v1
        h[i, 3], h[i, 4] = a, b
        if not hold_height:
            h[i, 5] = e
        for slot in range(CORE_SIZE, column_of.shape[0]):
            kind = column_of[slot] - RATE_ERROR
            if 0 <= kind < 3:
                h[i, slot] = arm[3 * axis + kind]


def _body_velocity(
    state: State, lever: Vector3, first: int, count: int, measured: float, sd: float
) -> Innovation:
    """Innovation along `count` body axes from `first` on."""
    model = state.model
    z, h = np.empty(count), np.zeros((count, model.size))
    _rows(state.nav, state.step, model.column_of, model.hold_height, *lever, first, z, h)
    z -= measured
    return Innovation(z, h, np.full(count, sd**2))


@dataclass(frozen=True, slots=True)
class NonHolonomicAid(Aid):
    """No sideways or vertical velocity (sigma `sd_m_s`) at `lever`, above `min_speed_m_s`."""

    constraint: ClassVar[bool] = True
    no_slip: ClassVar[bool] = True

    sd_m_s: float
    min_speed_m_s: float
    lever: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.speed < self.min_speed_m_s:
            return NotApplicable("too_slow")
        count = 1 if state.model.hold_height else 2  # right, down
        return _body_velocity(state, self.lever, RIGHT, count, 0.0, self.sd_m_s)


@dataclass(frozen=True, slots=True)
class WheelSpeedAid(Aid):
    """Forward speed (m/s) with `sd_m_s` at `lever`."""

    speed_m_s: float
    sd_m_s: float
    lever: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return _body_velocity(state, self.lever, FORWARD, 1, self.speed_m_s, self.sd_m_s)

    def offers(self) -> tuple[SpeedOffer, ...]:
        return (SpeedOffer(self.t_ns, self.speed_m_s, self.sd_m_s),)
