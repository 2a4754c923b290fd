r"""Velocity of an antenna over ground, north-east-down, horizontal or full.

    z = v^ + C^ (w x l^) + a^ tau^ - v_fix
      = dv + (C (w x l)) x phi - C [l x] e - C [w x] dl - a dtau + tau^ f x phi + noise

w is the rate of the body against the Earth; the Earth's own rate times the lever is under 1 mm/s
per 10 m. tau is how much later than its stamp the velocity is valid, a the acceleration, smoothed:
with the noise of single samples in its Jacobian an offset would come out too small, and too sure.
A timing error of sigma s_t that is not shared changes the velocity by a s_t, which adds (a_i s_t)^2
to the variance of each axis.

Source: Groves, 2nd ed., eq. 14.109.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.aiding.offers import VelocityOffer
from fusiond.navigation.compiled import compiled
from fusiond.navigation.earth import gravity
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import HEIGHT, LAT, Q0, STEP_RATE_B, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]

SUFFIX = "_velocity"
"""What the name of a receiver's velocity adds to that of the receiver."""
Indices = NDArray[np.int64]


@compiled(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], i8[::1], i8[::1], f8, f8, f8, f8[::1], f8[:, ::1])"
)
def _velocity(
    nav: Array,
    xi: Array,
    step: Array,
    column_of: Indices,
    time: Indices,
    rest: Indices,
    l0: float,
    l1: float,
    l2: float,
    z: Array,
    h: Array,
) -> None:
    """Write the antenna's velocity z (m,) and H (m, n), zero before: the first m of n, e, d.
    `time` (0 or 1,), `rest` (0 or 3,): slots in `xi`."""
    if rest.size:
        l0, l1, l2 = l0 + xi[rest[0]], l1 + xi[rest[1]], l2 + xi[rest[2]]
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
        if rest.size:
            h[i, rest[0]] = e * w1 - b * w2
            h[i, rest[1]] = a * w2 - e * w0
            h[i, rest[2]] = b * w0 - a * w1
    f0, f1, f2 = step[STEP_SMOOTH_N], step[STEP_SMOOTH_N + 1], step[STEP_SMOOTH_N + 2]
    for slot in time:
        late_s = xi[slot]
        z[0] += f0 * late_s
        z[1] += f1 * late_s
        h[0, slot], h[1, slot] = -f0, -f1
        h[0, 1] -= late_s * f2
        h[0, 2] += late_s * f1
        h[1, 0] += late_s * f2
        h[1, 2] -= late_s * f0
        if z.shape[0] > 2:
            down = f2 + gravity(nav[LAT], nav[HEIGHT])
            z[2] += down * late_s
            h[2, slot] = -down
            h[2, 0] -= late_s * f1
            h[2, 1] += late_s * f0


@dataclass(frozen=True, slots=True)
class VelocityAid(Aid):
    """Velocity (m/s) of the antenna with `sd`; two components (n, e) or three. `time` and
    `rest` as of `PositionAid`."""

    moves: ClassVar[bool] = True

    v_ned: tuple[float, ...]
    sd: tuple[float, ...]
    lever: Vector3
    time: str = ""
    rest: str = ""
    sd_time_s: float = 0.0

    @property
    def device(self) -> str:
        return self.source.removesuffix(SUFFIX)

    def innovation(self, state: State) -> Innovation | NotApplicable:
        model = state.model
        rows = 2 if model.hold_height else len(self.v_ned)
        z, h = np.empty(rows), np.zeros((rows, model.size))
        slots = model.column_of, model.slots_of_all((self.time,)), model.slots_of_all((self.rest,))
        _velocity(state.nav, state.xi, state.step, *slots, *self.lever, z, h)
        z -= self.v_ned[:rows]
        r = np.square(self.sd[:rows])
        if self.sd_time_s:
            r += np.square(state.acceleration[:rows] * self.sd_time_s)
        return Innovation(z, h, r)

    def offers(self) -> tuple[VelocityOffer, ...]:
        return (VelocityOffer(self.t_ns, self.v_ned, self.sd, self.lever),)
