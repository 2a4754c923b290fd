r"""Position of an antenna: GNSS fix (3-D) or BeiDou RDSS fix (horizontal).

    z = [ (phi^ - phi) (R_M + h), (lambda^ - lambda) (R_N + h) cos phi, -(h^ - h) ] + C l
      = dr + (C l) x phi + v

l is the lever arm from the IMU to the antenna. A timing error of sigma s_t moves the antenna by
v s_t, which adds (v_i s_t)^2 to the variance of each axis.

Source: Groves, 2nd ed., eq. 14.103 to 14.113; paper 000, eq. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import skew
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, VN


@dataclass(frozen=True, slots=True)
class PositionAid(Aid):
    """Fix (rad, rad, m) of the antenna; `sd` (m) north, east, down; no height where it is None."""

    lat_rad: float
    lon_rad: float
    height_m: float | None
    sd: Vector3
    lever: Vector3
    sd_time_s: float = 0.0

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav = state.nav
        height = nav[HEIGHT]
        lever = state.dcm @ np.array(self.lever)
        rows = 2 if self.height_m is None or state.model.hold_height else 3
        east = nav[LON] - self.lon_rad
        east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
        z = np.array(
            [
                (nav[LAT] - self.lat_rad) * (meridian_radius(nav[LAT]) + height),
                east * (transverse_radius(nav[LAT]) + height) * math.cos(nav[LAT]),
                0.0 if self.height_m is None else self.height_m - height,
            ]
        )
        z += lever
        h = np.zeros((rows, state.model.size))
        for i in range(rows):
            h[i, 6 + i] = 1.0
        h[:, 0:3] = skew(lever)[:rows]
        moved = nav[VN : VN + 3] * self.sd_time_s
        r = np.square(self.sd) + np.square(moved)
        return Innovation(z[:rows], h, r[:rows])
