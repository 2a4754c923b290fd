r"""Standstill: zero velocity and zero rate.

    z = v^ - 0 = dv + v
    z = mean of w^ over the window - C^T w_ie = e + v

The mean rate is that of a window in which the sensor was quiet (fusiond.navigation.standstill). A
quiet sensor alone cannot tell rest from smooth driving, so the aid holds only while the computed
speed can be zero: below `max_speed_m_s`.

Source: Groves, 2nd ed., section 15.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3, rate_columns
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.strapdown import LAT, VN


@dataclass(frozen=True, slots=True)
class ZeroVelocityAid(Aid):
    """Zero velocity with `sd_m_s`."""

    constraint: ClassVar[bool] = True

    sd_m_s: float
    max_speed_m_s: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.speed > self.max_speed_m_s:
            return NotApplicable("moving")
        rows = 2 if state.model.hold_height else 3
        h = np.zeros((rows, state.model.size))
        for i in range(rows):
            h[i, 3 + i] = 1.0
        return Innovation(state.nav[VN : VN + rows].copy(), h, np.full(rows, self.sd_m_s**2))


@dataclass(frozen=True, slots=True)
class ZeroRateAid(Aid):
    """Raw mean rate (rad/s, body axes) of a quiet window; `sd_rad_s` of what the vehicle may
    turn."""

    constraint: ClassVar[bool] = True

    mean_rate: Vector3
    sd_rad_s: float
    max_speed_m_s: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.speed > self.max_speed_m_s:
            return NotApplicable("moving")
        model, lat = state.model, state.nav[LAT]
        bias = np.array([sum(state.xi[s] for s in model.parameters(9 + j)) for j in range(3)])
        earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
        h = np.zeros((3, model.size))
        rate_columns(h, slice(None), model, np.eye(3))
        z = np.array(self.mean_rate) - bias - state.dcm.T @ earth
        return Innovation(z, h, np.full(3, self.sd_rad_s**2))
