r"""Velocity in body axes: non-holonomic constraint and wheel speed.

At a point l of the vehicle (rear axle, wheel), with the body's rate w:

    z = C^T v^ + w x l - v_b = C^T dv - C^T [v x] phi - [l x] e + v

Non-holonomic: v_b right and down are 0. Wheel speed: v_b forward is what the wheel says.

Source: Dissanayake et al., The aiding of a low-cost strapdown IMU using vehicle constraints, IEEE
T-RA 17 (2001), eq. 8; Groves, 2nd ed., section 15.4.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3, rate_columns
from fusiond.navigation.rotation import skew
from fusiond.navigation.strapdown import VN

FORWARD, RIGHT, DOWN = 0, 1, 2


def _body_velocity(
    state: State, lever: Vector3, axes: tuple[int, ...], measured: float, sd: float
) -> Innovation:
    c_bn = state.dcm.T
    v_n, arm = state.nav[VN : VN + 3], np.array(lever)
    rows = list(axes)
    z = (c_bn @ v_n + np.cross(state.rate_b, arm))[rows] - measured
    h = np.zeros((len(rows), state.model.size))
    h[:, 3:6] = c_bn[rows]
    if state.model.hold_height:
        h[:, 5] = 0.0
    h[:, 0:3] = -(c_bn @ skew(v_n))[rows]
    rate_columns(h, slice(None), state.model, -skew(arm)[rows])
    return Innovation(z, h, np.full(len(rows), sd**2))


@dataclass(frozen=True, slots=True)
class NonHolonomicAid(Aid):
    """No sideways or vertical velocity (sigma `sd_m_s`) at `lever`, above `min_speed_m_s`."""

    sd_m_s: float
    min_speed_m_s: float
    lever: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.speed < self.min_speed_m_s:
            return NotApplicable("too_slow")
        axes = (RIGHT,) if state.model.hold_height else (RIGHT, DOWN)
        return _body_velocity(state, self.lever, axes, 0.0, self.sd_m_s)


@dataclass(frozen=True, slots=True)
class WheelSpeedAid(Aid):
    """Forward speed (m/s) with `sd_m_s` at `lever`."""

    speed_m_s: float
    sd_m_s: float
    lever: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return _body_velocity(state, self.lever, (FORWARD,), self.speed_m_s, self.sd_m_s)
