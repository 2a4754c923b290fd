r"""Velocity of an antenna over ground, north-east-down, horizontal or full.

    z = v^ + C^ (w x l^) + a^ tau^ - v_fix
      = dv + (C (w x l)) x phi - C [l x] e - C [w x] dl - a dtau + tau^ da + noise

w is the rate of the body against the Earth (fusiond.aiding.antenna). tau is the time from the
velocity's stamp to its validity, a the acceleration (its error da:
fusiond.aiding.smoothed_imu_jacobian), smoothed: with the noise of single samples in the
Jacobian an offset would be biased and too certain. The product of the two errors is not treated as
noise: on drive_0708 that cost a tenth of the accuracy in outages without a more honest sigma. A
timing error of sigma s_t that is not shared changes the velocity by a s_t, which adds (a_i s_t)^2
to the variance of each axis.

A velocity that lags behind the position of the same stamp, by tau_p - tau, has been averaged or
filtered for about twice as long. Under constant acceleration that is a delay; if the acceleration
changes within that time, it is not:

    var = (AVERAGED (tau_p - tau) a_i)^2    no velocity is ahead of its position: else 0

Source: Groves, 2nd ed., eq. 14.109.
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
from fusiond.aiding.antenna import antenna_velocity
from fusiond.aiding.base import (
    VELOCITY,
    AidingMeasurement,
    Innovation,
    NotApplicable,
    Packed,
    State,
    Vector3,
    level_arm_m,
)
from fusiond.aiding.heading_history import HeadingHistory
from fusiond.aiding.initialisation_candidates import VelocityCandidate
from fusiond.aiding.smoothed_imu_jacobian import add_of_force
from fusiond.models.model import Model
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, Q0, STEP_RATE_B, STEP_SMOOTH_N

Array = NDArray[np.float64]

_BODY = Struct("<10d8q")
SUFFIX = "_velocity"
"""Suffix of a source's name for a receiver's velocity."""
AVERAGED = 0.5
"""One sigma of a velocity's averaging error, as a share of the effect of its lag; a sudden change
leaves between nothing and all. With 0.5 the steps of stamps and forces that explain drive_0708
(receiver's lag 0.13 s) follow chi-square (mean l / p of 1.1 and 0.9; 5.2 and 1.7 without it, with
seven decisions in six runs; 0.7 and 0.6 with 1)."""
CORNER_RAD_S = 0.2
"""Usual turn rate of a vehicle at a street corner: a quarter turn in six to eight seconds.
By so much times its lever arm an antenna goes its own way."""
Indices = NDArray[np.int64]


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], i8[::1], f8, f8, f8, f8, f8, f8,"
    "f8, f8, f8, f8, f8[::1], f8[:, ::1], f8[::1])"
)
def velocity_rows(
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    time: Indices,
    rest: Indices,
    fix_time: Indices,
    v0: float,
    v1: float,
    v2: float,
    sd0: float,
    sd1: float,
    sd2: float,
    l0: float,
    l1: float,
    l2: float,
    sd_time: float,
    z: Array,
    h: Array,
    r: Array,
) -> None:
    """Write z (m,), H (m, n) and r (m,) for the first m of north, east, down. `time` (0 or 1,),
    `rest` (0 or 3,), `fix_time` (0 or 1,): slots in `xi`."""
    h[:] = 0.0
    if rest.size:
        l0, l1, l2 = l0 + xi[rest[0]], l1 + xi[rest[1]], l2 + xi[rest[2]]
    c = dcm_elements(nav[Q0:])
    antenna_velocity(nav, step, column_of, rest, c, l0, l1, l2, STEP_RATE_B, z, h)
    f0, f1, f2 = step[STEP_SMOOTH_N], step[STEP_SMOOTH_N + 1], step[STEP_SMOOTH_N + 2]
    down = f2 + gravity(nav[LAT], nav[HEIGHT])
    for slot in time:
        delay_s = xi[slot]
        z[0], z[1] = z[0] + f0 * delay_s, z[1] + f1 * delay_s
        h[0, slot], h[1, slot] = -f0, -f1
        h[0, 1] -= delay_s * f2
        h[0, 2] += delay_s * f1
        h[1, 0] += delay_s * f2
        h[1, 2] -= delay_s * f0
        if z.shape[0] > 2:
            z[2] += down * delay_s
            h[2, slot] = -down
            h[2, 0] -= delay_s * f1
            h[2, 1] += delay_s * f0
        for i in range(z.shape[0]):
            x, y, d = delay_s * c[3 * i], delay_s * c[3 * i + 1], delay_s * c[3 * i + 2]
            add_of_force(step, column_of, c, x, y, d, h[i])
    z[0], z[1] = z[0] - v0, z[1] - v1
    r[0], r[1] = sd0 * sd0, sd1 * sd1
    if z.shape[0] > 2:
        z[2] -= v2
        r[2] = sd2 * sd2
    square = sd_time * sd_time
    if time.size and fix_time.size:
        square += (AVERAGED * max(xi[fix_time[0]] - xi[time[0]], 0.0)) ** 2
    if square > 0.0:
        r[0] += f0 * f0 * square
        r[1] += f1 * f1 * square
        if z.shape[0] > 2:
            r[2] += down * down * square


@immutable()
class VelocityMeasurement(AidingMeasurement):
    """Velocity (m/s) of the antenna with `sd`; two components (n, e) or three. `time` and
    `rest` as of `PositionMeasurement`; `fix_time` is the `time` of the position with the same
    stamp."""

    moves: ClassVar[bool] = True
    shown: ClassVar[attrgetter[Any] | None] = attrgetter("v_ned")

    v_ned: tuple[float, ...]
    sd: tuple[float, ...]
    lever: Vector3
    time: str = ""
    rest: str = ""
    sd_time_s: float = 0.0
    fix_time: str = ""

    @property
    def device(self) -> str:
        return self.source.removesuffix(SUFFIX)

    def without_attitude(self, way: HeadingHistory) -> VelocityMeasurement:
        aside = CORNER_RAD_S * level_arm_m(self.lever)
        north, east, *down = self.sd
        sd = math.hypot(north, aside), math.hypot(east, aside), *down
        return replace(self, sd=sd, lever=(0.0, 0.0, 0.0), rest="")

    def innovation(self, state: State) -> Innovation | NotApplicable:
        nav, xi, step, model, _, lent = state
        at = model.indices
        m = 2 if model.hold_height else len(self.v_ned)
        rows = lent.get(m) or Innovation.unwritten(m, model.size)
        slots = model.column_of, at[self.time], at[self.rest], at[self.fix_time]
        north, east, down = self.v_ned if len(self.v_ned) == 3 else (*self.v_ned, 0.0)
        sd_n, sd_e, sd_d = self.sd if len(self.sd) == 3 else (*self.sd, 0.0)
        measured = north, east, down, sd_n, sd_e, sd_d  # 0 where there is none down
        velocity_rows(nav, xi, step, *slots, *measured, *self.lever, self.sd_time_s, *rows)
        return rows

    def packed(self, model: Model) -> Packed | None:
        names, v, sd = (self.time, self.rest, self.fix_time), self.v_ned, self.sd
        slots = model.listed.get(names) or model.list_slots(names, (1, 3, 1))
        measured = (*v, *sd) if len(v) == 3 else (*v, 0.0, *sd, 0.0)
        body = _BODY.pack(*measured, *self.lever, self.sd_time_s, *slots)
        return Packed(VELOCITY, 2 if model.hold_height else len(self.v_ned), body)

    def candidates(self) -> tuple[VelocityCandidate, ...]:
        return (
            VelocityCandidate(self.t_ns, self.v_ned, self.sd, self.lever, self.time, self.rest),
        )
