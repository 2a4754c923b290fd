r"""Velocity of an antenna over ground, north-east-down, horizontal or full.

    z = v^ + C^ (w x l^) + a^ tau^ - v_fix
      = dv + (C (w x l)) x phi - C [l x] e - C [w x] dl - a dtau + tau^ f x phi + noise

w is the rate of the body against the Earth; the Earth's own rate times the lever is under 1 mm/s
per 10 m (fusiond.aiding.antenna). tau is how much later than its stamp the velocity is valid, a the
acceleration, smoothed: with the noise of single samples in its Jacobian an offset would come out
too small, and too sure. A timing error of sigma s_t that is not shared changes the velocity by
a s_t, which adds (a_i s_t)^2 to the variance of each axis.

Source: Groves, 2nd ed., eq. 14.109.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusiond.aiding.antenna import antenna, antenna_velocity, force_matrix
from fusiond.aiding.base import Aid, Innovation, NotApplicable, State, Vector3
from fusiond.aiding.offers import VelocityOffer

SUFFIX = "_velocity"
"""What the name of a receiver's velocity adds to that of the receiver."""


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
        lever, levers = antenna(state, self.lever, self.rest)
        z, h = antenna_velocity(state, lever, levers, rows)
        z -= self.v_ned[:rows]
        for slot in state.model.slots_of(self.time):
            late_s = float(state.xi[slot])
            z += state.acceleration[:rows] * late_s
            h[:, slot] = -state.acceleration[:rows]
            h[:, :3] += late_s * force_matrix(state)[:rows]
        r = np.square(self.sd[:rows])
        if self.sd_time_s:
            r += np.square(state.acceleration[:rows] * self.sd_time_s)
        return Innovation(z, h, r)

    def offers(self) -> tuple[VelocityOffer, ...]:
        return (VelocityOffer(self.t_ns, self.v_ned, self.sd, self.lever),)
