r"""Velocity of an antenna over ground, north-east-down, horizontal or full.

    z = v^ + C^ (w x l) - v_fix = dv + (C (w x l)) x phi - C [l x] e + v

w is the rate of the body against the Earth; the Earth's own rate times the lever is under 1 mm/s
per 10 m.

Source: Groves, 2nd ed., eq. 14.109.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3, rate_columns
from fusiond.navigation.rotation import skew
from fusiond.navigation.strapdown import VN


@dataclass(frozen=True, slots=True)
class VelocityAid(Aid):
    """Velocity (m/s) of the antenna with `sd`; two components (n, e) or three."""

    v_ned: tuple[float, ...]
    sd: tuple[float, ...]
    lever: Vector3

    def innovation(self, state: State) -> Innovation | NotApplicable:
        rows = 2 if state.model.hold_height else len(self.v_ned)
        dcm, lever = state.dcm, np.array(self.lever)
        turning = dcm @ np.cross(state.rate_b, lever)
        z = (state.nav[VN : VN + 3] + turning)[:rows] - np.array(self.v_ned[:rows])
        h = np.zeros((rows, state.model.size))
        for i in range(rows):
            h[i, 3 + i] = 1.0
        h[:, 0:3] = skew(turning)[:rows]
        rate_columns(h, slice(0, rows), state.model, -(dcm @ skew(lever))[:rows])
        return Innovation(z, h, np.square(self.sd[:rows]))
