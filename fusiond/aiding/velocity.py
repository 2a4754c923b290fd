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
from fusiond.aiding.position import antenna
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE, RATE_ERROR
from fusiond.navigation.rotation import dcm_elements
from fusiond.navigation.strapdown import Q0, STEP_RATE_B, STEP_SMOOTH_N, VN

Array = NDArray[np.float64]

SUFFIX = "_velocity"
"""What the name of a receiver's velocity adds to that of the receiver."""
Indices = NDArray[np.int64]


@compiled("void(f8[::1], f8[::1], i8[::1], f8, f8, f8, f8[::1], f8[:, ::1])")
def _velocity(
    nav: Array,
    step: Array,
    column_of: Indices,
    l0: float,
    l1: float,
    l2: float,
    z: Array,
    h: Array,
) -> None:
    """Write the antenna's velocity z (m,) and H (m, n), zero before: the first m of n, e, d."""
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
        rows = 2 if state.model.hold_height else len(self.v_ned)
        z, h = np.empty(rows), np.zeros((rows, state.model.size))
        lever, levers = antenna(state, self.lever, self.rest)
        _velocity(state.nav, state.step, state.model.column_of, *lever, z, h)
        if levers:
            x, y, w = state.rate_b
            turn = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
            h[:, levers] = -(state.dcm @ turn)[:rows]
        z -= self.v_ned[:rows]
        for slot in state.model.slots_of(self.time):
            late_s = float(state.xi[slot])
            z += state.acceleration[:rows] * late_s
            h[:, slot] = -state.acceleration[:rows]
            x, y, w = state.step[STEP_SMOOTH_N : STEP_SMOOTH_N + 3]
            force = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
            h[:, :3] += late_s * force[:rows]
        r = np.square(self.sd[:rows])
        if self.sd_time_s:
            r += np.square(state.acceleration[:rows] * self.sd_time_s)
        return Innovation(z, h, r)

    def offers(self) -> tuple[VelocityOffer, ...]:
        return (VelocityOffer(self.t_ns, self.v_ned, self.sd, self.lever),)
