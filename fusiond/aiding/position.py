r"""Position of an antenna: a GNSS fix, with or without height.

    z = [ (phi^ - phi) (R_M + h), (lambda^ - lambda) (R_N + h) cos phi, -(h^ - h) ] + C l^ + b^
        + v_a^ tau^ + a^ tau^2 / 2
      = dr + (C l) x phi + tau^ dv_a - C dl - db - (v_a + a tau^) dtau + tau^2 / 2 [f x] phi + noise

l is the lever arm from the IMU to the antenna, b an error that successive fixes share (orbits,
ionosphere), tau how much later than its stamp the fix is valid, v_a the antenna's velocity
(fusiond.aiding.antenna, also for the noise that products of errors are), a its acceleration; where
the model has states for them they are estimated, true minus estimated in dl, db, dtau. A timing
error of sigma s_t that is not shared moves the antenna by v s_t, which adds (v_i s_t)^2 to the
variance of each axis.

Source: Groves, 2nd ed., eq. 14.103 to 14.113; paper 000, eq. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.antenna import antenna, antenna_velocity, force_matrix, left_out
from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.aiding.offers import PositionOffer
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

Array = NDArray[np.float64]


@compiled("void(f8[::1], f8, f8, f8, f8, f8, f8, f8[::1], f8[:, ::1])")
def _position(
    nav: Array,
    lat: float,
    lon: float,
    height: float,
    l0: float,
    l1: float,
    l2: float,
    z: Array,
    h: Array,
) -> None:
    """Write z (m,) and H (m, n), zero before, for the first m of north, east, down."""
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = dcm_elements(nav[Q0:])
    x = c00 * l0 + c01 * l1 + c02 * l2
    y = c10 * l0 + c11 * l1 + c12 * l2
    d = c20 * l0 + c21 * l1 + c22 * l2
    east = nav[LON] - lon
    east -= 2.0 * math.pi * round(east / (2.0 * math.pi))
    z[0] = (nav[LAT] - lat) * (meridian_radius(nav[LAT]) + nav[HEIGHT]) + x
    z[1] = east * (transverse_radius(nav[LAT]) + nav[HEIGHT]) * math.cos(nav[LAT]) + y
    h[0, 1], h[0, 2] = -d, y
    h[1, 0], h[1, 2] = d, -x
    h[0, 6] = h[1, 7] = 1.0
    if z.shape[0] > 2:
        z[2] = height - nav[HEIGHT] + d
        h[2, 0], h[2, 1] = -y, x
        h[2, 8] = 1.0


@dataclass(frozen=True, slots=True)
class PositionAid(Aid):
    """Fix (rad, rad, m) of the antenna; `sd` (m) north, east, down; no height where it is None.

    `bias`: the blocks whose states north, east, down are the error that the fixes share; `time`
    that of their offset in time; `rest` that of what is left of the lever arm.
    """

    locates: ClassVar[bool] = True

    lat_rad: float
    lon_rad: float
    height_m: float | None
    sd: Vector3
    lever: Vector3
    sd_time_s: float = 0.0
    bias: tuple[str, ...] = ()
    time: str = ""
    rest: str = ""

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav = state.nav
        rows = 2 if self.height_m is None or state.model.hold_height else 3
        height = 0.0 if self.height_m is None else self.height_m
        z, h = np.empty(rows), np.zeros((rows, state.model.size))
        r = np.square(self.sd[:rows])
        lever, levers = antenna(state, self.lever, self.rest)
        _position(nav, self.lat_rad, self.lon_rad, height, *lever, z, h)
        if levers:
            h[:, levers] = -state.dcm[:rows]
        shared = [slot for block in self.bias for slot in state.model.slots_of(block)]
        for row, slot in zip(range(rows), shared, strict=False):
            h[row, slot] = -1.0
            z[row] += state.xi[slot]
        for slot in state.model.slots_of(self.time):
            late_s = float(state.xi[slot])
            v, of_v = antenna_velocity(state, lever, levers, rows)
            a = state.acceleration[:rows]
            z += (v + 0.5 * a * late_s) * late_s
            h[:, slot] = -(v + a * late_s)
            h += late_s * of_v
            h[:, :3] += 0.5 * late_s**2 * force_matrix(state)[:rows]
            r += left_out(state, slot, of_v, a)
        if self.sd_time_s:
            r += np.square(nav[VN : VN + rows] * self.sd_time_s)
        return Innovation(z, h, r)

    def offers(self) -> tuple[PositionOffer, ...]:
        place = self.lat_rad, self.lon_rad, self.height_m
        return (PositionOffer(self.t_ns, *place, self.sd, self.lever),)
