r"""Position of an antenna: a GNSS fix, with or without height.

    z = [ (phi^ - phi) (R_M + h), (lambda^ - lambda) (R_N + h) cos phi, -(h^ - h) ] + C l^ + s b^
        + w c^ + v_a^ tau^ + a^ tau^2 / 2
      = dr + (C l) x phi + tau^ dv_a - C dl - s db - w dc - (v_a + a tau^) dtau + tau^2 / 2 da
        + noise

l is the lever arm from the IMU to the antenna, b an error that successive fixes share (orbits,
ionosphere), s its share in this fix, c an error of seconds, of w metres, down larger by the ratio
of the fix's sigmas (fusiond.aiding.fix_error_correlation), tau the time from the fix's stamp to its
validity, v_a the antenna's velocity (fusiond.aiding.antenna), a the acceleration, smoothed
(fusiond.aiding.smoothed_imu_jacobian); with states in the model they are estimated; dl, db,
dtau are true minus estimated. A timing error of sigma s_t that is not shared moves the antenna by v
s_t, which adds (v_i s_t)^2 to the variance of each axis. An error that lasts for seconds and has no
state is noise.

A time offset multiplies v_a. The second-order terms, the product of the two errors and dtau's
square, are noise, if P is the filter's own:

    z_2 = dv_a dtau - a dtau^2 / 2
    var(z_2) = P_va P_tau + P_va,tau^2 - 2 a P_tau P_va,tau + a^2 P_tau^2 / 2

for Gaussian errors (Isserlis); its mean is under a millimetre for sigmas of 0.01 s and 0.1 m/s, and
is neglected. The same applies to an unmeasured lever arm, which an attitude error turns: 3 deg and
a metre are 5 cm, with u = C dl

    z_2 = phi x u,   var(phi_j u_k - phi_k u_j) = P_jj U_kk + X_kj^2 + P_kk U_jj + X_jk^2
                                                  - 2 (P_jk U_jk + X_jj X_kk)

with P, U and X = cov(u, phi) of the two. (96 cars of
tests/estimators/test_antenna_position_after_attitude_update.py, NEES a degree of lever arm and
place: 1.5 without it, 1.1 with it.)

Source: Groves, 2nd ed., eq. 14.103 to 14.113; paper 000, eq. 3; Bar-Shalom, Li, Kirubarajan (2001),
section 10.3.2 (second-order terms).
"""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter
from struct import Struct
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.antenna import Matrix, antenna_velocity
from fusiond.aiding.base import (
    POSITION,
    AidingMeasurement,
    Innovation,
    NotApplicable,
    Packed,
    State,
    Vector3,
    level_arm_m,
)
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.aiding.smoothed_imu_jacobian import add_of_force
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity, meridian_radius, transverse_radius
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    LON,
    Q0,
    STEP_SMOOTH_N,
    STEP_SMOOTH_RATE_B,
    VN,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


_UNKNOWN = np.zeros((0, 0))
_BODY = Struct("<14d14q")


def markov_sd_of(axis: int, markov_m: float, sd: Vector3) -> float:
    """Metres of an error of seconds along an axis, down larger by the ratio of the fix's sigmas
    (m)."""
    return markov_m if axis < 2 else 2.0 * markov_m * sd[2] / (sd[0] + sd[1])


@compiled("void(UniTuple(f8, 9), i8[::1], f8[:, :], f8[::1])", forceinline=True, allocates=True)
def _add_of_turned_lever(c: Matrix, rest: Indices, p: Array, r: Array) -> None:
    """Add to r (m,) the variance of phi x C dl by P (n, n), with dl in the slots `rest` (3,)."""
    u, x = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for a in range(3):
            of_lever = c[3 * i + a]
            for j in range(3):
                x[i, j] += of_lever * p[rest[a], j]
                for b in range(3):
                    u[i, j] += of_lever * p[rest[a], rest[b]] * c[3 * j + b]
    for i in range(r.shape[0]):
        j, k = (i + 1) % 3, (i + 2) % 3
        alone = p[j, j] * u[k, k] + x[k, j] ** 2 + p[k, k] * u[j, j] + x[j, k] ** 2
        r[i] += max(alone - 2.0 * (p[j, k] * u[j, k] + x[j, j] * x[k, k]), 0.0)


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], f8, f8, f8, f8,"
    "f8, f8, f8, f8, f8, f8, f8, f8, f8, f8, f8[:, :], f8[::1], f8[:, ::1], f8[::1])",
    allocates=True,
)
def position_rows(
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    bias: Indices,
    time: Indices,
    rest: Indices,
    markov: Indices,
    lat: float,
    lon: float,
    height: float,
    l0: float,
    l1: float,
    l2: float,
    sd0: float,
    sd1: float,
    sd2: float,
    sd_time: float,
    s0: float,
    s1: float,
    s2: float,
    markov_m: float,
    p: Array,
    z: Array,
    h: Array,
    r: Array,
) -> None:
    """Write the rows of a position: z (m,), H (m, n) and r (m,).

    The first m of north, east, down. P (n, n) gives the part that offset in time and lever arm
    leave out; (0, 0) if unknown. Slots in `xi`: `bias` (up to 3,), `time` (0 or 1,), `rest`
    (0 or 3,), `markov` (0 or 3,)."""
    m, n = h.shape
    h[:] = 0.0
    share = (s0, s1, s2)
    r[0], r[1] = sd0 * sd0, sd1 * sd1
    if m > 2:
        r[2] = sd2 * sd2
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
    if m > 2:
        z[2] = height - nav[HEIGHT] + d
        h[2, 0], h[2, 1] = -y, x
        h[2, 8] = 1.0
    for i in range(m):
        for k in range(rest.size):
            h[i, rest[k]] = -c[3 * i + k]
        if i < bias.size:
            z[i] += share[i] * xi[bias[i]]
            h[i, bias[i]] = -share[i]
        if i < markov.size:
            # Down it is as much larger as the fix says that its errors are.
            w = markov_m if i < 2 else 2.0 * markov_m * sd2 / (sd0 + sd1)
            z[i] += w * xi[markov[i]]
            h[i, markov[i]] = -w
        elif markov_m > 0.0:  # the model has no state for it
            w = markov_m if i < 2 else 2.0 * markov_m * sd2 / (sd0 + sd1)
            r[i] += w * w
    for slot in time:
        delay_s = xi[slot]
        v, of_v, columns = np.empty(m), np.zeros((m, n)), np.empty(n, dtype=np.int64)
        antenna_velocity(nav, step, column_of, rest, c, l0, l1, l2, STEP_SMOOTH_RATE_B, v, of_v)
        f0, f1, f2 = step[STEP_SMOOTH_N], step[STEP_SMOOTH_N + 1], step[STEP_SMOOTH_N + 2]
        a = (f0, f1, f2 + gravity(nav[LAT], nav[HEIGHT]))
        turned = ((0.0, -f2, f1), (f2, 0.0, -f0), (-f1, f0, 0.0))
        for i in range(m):
            z[i] += (v[i] + 0.5 * a[i] * delay_s) * delay_s
            for j in range(n):
                h[i, j] += delay_s * of_v[i, j]
            for j in range(3):
                h[i, j] += 0.5 * delay_s * delay_s * turned[i][j]
            half = 0.5 * delay_s * delay_s
            x0, x1, x2 = half * c[3 * i], half * c[3 * i + 1], half * c[3 * i + 2]
            add_of_force(step, column_of, c, x0, x1, x2, h[i])
            h[i, slot] = -(v[i] + a[i] * delay_s)
            if p.size:
                variance, across, count = 0.0, 0.0, 0
                for j in range(n):
                    if of_v[i, j] != 0.0:
                        columns[count] = j
                        count += 1
                for j in columns[:count]:
                    across += of_v[i, j] * p[j, slot]
                    for k in columns[:count]:
                        variance += of_v[i, j] * p[j, k] * of_v[i, k]
                square = a[i] * p[slot, slot]
                left = variance * p[slot, slot] + across * across
                r[i] += max(left - 2.0 * square * across + 0.5 * square * square, 0.0)
    if rest.size and p.size:
        _add_of_turned_lever(c, rest, p, r)
    if sd_time > 0.0:
        for i in range(m):
            r[i] += (nav[VN + i] * sd_time) ** 2


@immutable()
class PositionMeasurement(AidingMeasurement):
    """Fix (rad, rad, m) of the antenna; `sd` (m) north, east, down; None for an unknown height.

    Blocks of the model: `bias` has the error that fixes share (north, east, down), of which
    `bias_share` enters each axis; `time` the fixes' offset in time; `rest` the residual of the
    lever arm; `markov` the error that lasts for seconds, of `markov_m` (m).
    """

    locates: ClassVar[bool] = True
    shown: ClassVar[attrgetter[Any] | None] = attrgetter("lat_rad", "lon_rad")

    lat_rad: float
    lon_rad: float
    height_m: float | None
    sd: Vector3
    lever: Vector3
    sd_time_s: float = 0.0
    bias: tuple[str, ...] = ()
    time: str = ""
    rest: str = ""
    bias_share: Vector3 = (1.0, 1.0, 1.0)
    markov: str = ""
    markov_m: float = 0.0

    @property
    def shares(self) -> tuple[str, ...]:
        return self.bias

    def without_attitude(self, way: HeadingHistory) -> PositionMeasurement:
        (north, east, down), arm = self.sd, level_arm_m(self.lever)
        sd = math.hypot(north, arm), math.hypot(east, arm), down
        return replace(self, sd=sd, lever=(0.0, 0.0, self.lever[2]), rest="")

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav, xi, step, model, p, lent = state
        height, at = self.height_m, model.indices
        m = 2 if height is None or model.hold_height else 3
        rows = lent.get(m) or Innovation.unwritten(m, model.size)
        slots = model.column_of, at[self.bias], at[self.time], at[self.rest], at[self.markov]
        fix = self.lat_rad, self.lon_rad, 0.0 if height is None else height
        where = *self.lever, *self.sd, self.sd_time_s, *self.bias_share, self.markov_m
        position_rows(nav, xi, step, *slots, *fix, *where, _UNKNOWN if p is None else p, *rows)
        return rows

    def packed(self, model: Model) -> Packed | None:
        height, names = self.height_m, (self.bias, self.time, self.rest, self.markov)
        slots = model.listed.get(names) or model.list_slots(names, (3, 1, 3, 3))
        fix = self.lat_rad, self.lon_rad, 0.0 if height is None else height
        body = _BODY.pack(
            *(*fix, *self.lever, *self.sd, self.sd_time_s, *self.bias_share, self.markov_m),
            *slots,
        )
        return Packed(POSITION, 2 if height is None or model.hold_height else 3, body)

    def candidates(self) -> tuple[PositionCandidate, ...]:
        measured = self.t_ns, self.lat_rad, self.lon_rad, self.height_m, self.sd, self.lever
        n, e, d = self.bias_share
        along = (n, 0.0, 0.0), (0.0, e, 0.0), (0.0, 0.0, d)
        shared = self.bias, self.time, self.rest, along, self.markov, self.markov_m
        return (PositionCandidate(*measured, *shared),)
