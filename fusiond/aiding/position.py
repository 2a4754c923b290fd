r"""Position of an antenna: a GNSS fix, with or without height.

    z = [ (phi^ - phi) (R_M + h), (lambda^ - lambda) (R_N + h) cos phi, -(h^ - h) ] + C l^ + b^
        + v^ tau^
      = dr + (C l) x phi + tau^ dv - C dl - db - v dtau + noise

l is the lever arm from the IMU to the antenna, b an error that successive fixes share (orbits,
ionosphere), tau how much later than its stamp the fix is valid; where the model has states for
them they are estimated, true minus estimated in dl, db, dtau. A timing error of sigma s_t that is
not shared moves the antenna by v s_t, which adds (v_i s_t)^2 to the variance of each axis.

Source: Groves, 2nd ed., eq. 14.103 to 14.113; paper 000, eq. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.aiding.offers import PositionOffer
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, LON, Q0, VN

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled(
    "void(f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], f8, f8, f8, f8, f8, f8, f8[::1], f8[:, ::1])"
)
def _position(
    nav: Array,
    xi: Array,
    bias: Indices,
    time: Indices,
    rest: Indices,
    lat: float,
    lon: float,
    height: float,
    l0: float,
    l1: float,
    l2: float,
    z: Array,
    h: Array,
) -> None:
    """Write z (m,) and H (m, n), zero before, for the first m of north, east, down. `bias` (up to
    3,), `time` (0 or 1,), `rest` (0 or 3,): slots in `xi`."""
    c = dcm_elements(nav[Q0:])
    if rest.size:
        l0, l1, l2 = l0 + xi[rest[0]], l1 + xi[rest[1]], l2 + xi[rest[2]]
    x = c[0] * l0 + c[1] * l1 + c[2] * l2
    y = c[3] * l0 + c[4] * l1 + c[5] * l2
    d = c[6] * l0 + c[7] * l1 + c[8] * l2
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
    for i in range(z.shape[0]):
        for k in range(rest.size):
            h[i, rest[k]] = -c[3 * i + k]
        if i < bias.size:
            z[i] += xi[bias[i]]
            h[i, bias[i]] = -1.0
        for slot in time:
            z[i] += nav[VN + i] * xi[slot]
            h[i, slot] = -nav[VN + i]
            h[i, 3 + i] += xi[slot]


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
        nav, model = state.nav, state.model
        rows = 2 if self.height_m is None or model.hold_height else 3
        height = 0.0 if self.height_m is None else self.height_m
        z, h = np.empty(rows), np.zeros((rows, model.size))
        bias = model.slots_of_all(self.bias)
        time, rest = model.slots_of_all((self.time,)), model.slots_of_all((self.rest,))
        fix = self.lat_rad, self.lon_rad, height
        _position(nav, state.xi, bias, time, rest, *fix, *self.lever, z, h)
        r = np.square(self.sd[:rows])
        if self.sd_time_s:
            r += np.square(nav[VN : VN + rows] * self.sd_time_s)
        return Innovation(z, h, r)

    def coarser(self, factor: float) -> PositionAid:
        north, east, down = self.sd
        return replace(self, sd=(factor * north, factor * east, factor * down))

    def offers(self) -> tuple[PositionOffer, ...]:
        place = self.lat_rad, self.lon_rad, self.height_m
        return (PositionOffer(self.t_ns, *place, self.sd, self.lever),)
