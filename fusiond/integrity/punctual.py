r"""Whether it would have shown by now that the fixes of a receiver are late since it came back.

Fixes that are late by tau lie where the vehicle was, p(t - tau). Of a motion of constant
acceleration a that is another one with the same acceleration, p(t) - tau v + tau^2 a / 2, which
goes with all that an IMU feels: after an outage it is believed as far as the outage's sigma
allows, and each fix makes the filter surer of it. What tells is by how much the velocity has left
a straight line in time, w(t): there fixes and motion differ by tau w, and after n fixes of sigma s

    sigma_tau = s / sqrt(sum |w|^2)

But an outage has made tilt and heading less certain, too, and these take part of w for their own:
with way(t) the way since the first fix,

    fix - filter = p_0 + v_0 t + a t^2 / 2 + psi (-way_e, way_n) - tau v(t)

the a as far as g sigma_tilt allows and psi as far as sigma_yaw, both as the first fix met them, and
sum |w|^2 is what all of them together leave of v (`left`). The first fix itself says something of
tau, whose sigma is that of the outage over the speed.

Until a lateness of `LATE_S` is beyond `TOLD` of this, nobody can tell. A receiver that came back
where the filter was is believed; of one whose first fix lies behind it by more than is likely
(fusiond.integrity.isolation) the mode says so meanwhile.

But an outage may allow many metres: 0.8 s of 10 m/s were 8 m within 33, and 33 of the centimetres
that fixes by carrier phase soon make of it. tau is not known better than sigma_tau, and with it
neither position nor velocity, along v and a: they are published no surer than

    sigma_tau v,    sigma_tau a        sigma_tau <= MOST_LATE_S / MOST_SIGMAS

(fusiond.integrity.hedge). An error of k sigma_tau v is told when it is k sigma, no later, and none
that is not refused is more than five. It is over once sigma_tau v is less than s.

So of one whose fixes a filter was started from after a failure: nothing is known of it but those
fixes, and braking evenly goes with late ones as well as with good ones. The heading of such a start
is theirs too, and in an even bend late fixes are a heading: there only the speed tells.

Source: least squares; as of fusiond.navigator.alignment.lateness, which finds tau itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The filter has a state for a lateness of 0.1 s (`time_offset_sd_s`); three of that it does not
# hold.
LATE_S = 0.3
# Fixes that are later (s) are refused as too old or found by the clock, whose envelope is as wide.
MOST_LATE_S = 3.0
# What is beyond so many of a stated sigma is a lie.
MOST_SIGMAS = 5.0
# What is told with a false alarm in a million, in half of the cases (sqrt of 27.6).
TOLD = 5.25
# Faster than this (m/s) the vehicle moves: what is measured of it changes.
MOVING_M_S = 1.0
# Unknowns of the equation above: p_0, v_0, a, psi, tau; scaled (s, m) to be alike after a minute.
UNKNOWNS, TIME_S, WAY_M = 8, 10.0, 100.0
# Below this part of the largest an eigenvalue is rounding.
ROUNDING = 1e-13
_NONE = np.zeros((UNKNOWNS, UNKNOWNS))


class Before(NamedTuple):
    """What was known as the first fix came: one sigma of what it said of a lateness (s), of the
    acceleration (m/s^2) and of the heading (rad)."""

    late_s: float = math.inf
    acceleration: float = 0.0
    yaw: float = 0.0


class Punctual(NamedTuple):
    """Of fixes since the first at `begin_ns`, the last of `n` at `t_ns`: their normal equations;
    what of the filter's velocity is `left` (m^2/s^2); `sd` (m) the largest sigma of an axis."""

    begin_ns: int
    started: bool = False
    """The filter was started from them: only the speed counts."""
    expected: bool = False
    """The first of them lay no farther behind the filter than is likely: it is vouched for."""
    before: Before = Before()
    n: int = 0
    t_ns: int = 0
    normal: Array = _NONE
    left: float = 0.0
    sd: float = 0.0
    way: tuple[float, float] = (0.0, 0.0)
    velocity: tuple[float, float] = (0.0, 0.0)
    acceleration: tuple[float, float] = (0.0, 0.0)
    """North and east: m since the first, and at the last m/s and m/s^2."""

    @property
    def speed(self) -> float:
        """At the last of them (m/s)."""
        return math.hypot(*self.velocity)

    @property
    def matters(self) -> bool:
        """Whether it is not vouched for: a lateness would not have shown yet, and would be worse
        than a fix. Of a start it would not where it moves it by less than what one fix is good to;
        of what came back, where the vehicle stands."""
        if self.told or self.expected:
            return False
        least_m_s = self.sd / LATE_S if self.started else MOVING_M_S
        return self.speed > least_m_s

    def with_one(self, t_ns: int, north: float, east: float, sd: float) -> Punctual:
        """With one fix more at `t_ns`, of sigma `sd` (m), of a filter with that velocity (m/s)."""
        t_s, velocity = (t_ns - self.begin_ns) * 1e-9, (north, east)
        way, acceleration = self._moved(t_ns, velocity)
        if self.started:
            north, east = math.hypot(north, east), 0.0
        t, d_n, d_e = t_s / TIME_S, way[0] / WAY_M, way[1] / WAY_M
        rows = np.array(
            [
                [1.0, 0.0, t, 0.0, 0.5 * t * t, 0.0, -d_e, north],
                [0.0, 1.0, 0.0, t, 0.0, 0.5 * t * t, d_n, east],
            ]
        )
        normal, sd = self.normal + rows.T @ rows, max(self.sd, sd)
        return self._replace(
            n=self.n + 1,
            t_ns=t_ns,
            normal=normal,
            left=_left(normal, sd, self.before),
            sd=sd,
            way=way,
            velocity=velocity,
            acceleration=acceleration,
        )

    def _moved(
        self, t_ns: int, velocity: tuple[float, float]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """The way until then, and the acceleration, as a mean over `LATE_S`."""
        if not self.n or t_ns <= self.t_ns:
            return self.way, self.acceleration
        step_s = (t_ns - self.t_ns) * 1e-9
        share = 1.0 / (step_s + LATE_S)
        each = zip(self.way, self.acceleration, self.velocity, velocity, strict=True)
        way, acceleration = zip(
            *(
                (d + 0.5 * step_s * (v + now), a + share * (now - v - step_s * a))
                for d, a, v, now in each
            ),
            strict=True,
        )
        return way, acceleration

    @property
    def told(self) -> bool:
        """Whether a lateness would have shown."""
        return LATE_S * math.sqrt(self.left) >= TOLD * self.sd > 0.0

    @property
    def over(self) -> bool:
        """Whether it would have, before it is worse than a fix."""
        return self.told and (self.started or self.left >= self.speed**2)

    @property
    def sd_s(self) -> float:
        """One sigma of what is known of a lateness (s), and no more than of all that come."""
        known = self.before.late_s**-2
        if self.sd > 0.0:
            known += self.left / self.sd**2
        most = MOST_LATE_S / MOST_SIGMAS
        return min(most, 1.0 / math.sqrt(known)) if known else most

    @property
    def leaves_open(self) -> Array:
        """What of position (m^2) and velocity (m^2/s^2), north, east and down, may be a lateness
        (6,)."""
        return np.square(self.sd_s * np.array([*self.velocity, 0.0, *self.acceleration, 0.0]))


def _left(normal: Array, sd: float, before: Before) -> float:
    """sum |w|^2 (m^2/s^2) of fixes of sigma `sd`: what is left of the velocity beside what is not
    known."""
    free = [0, 1, 2, 3]
    prior = [0.0] * len(free)
    if before.acceleration > 0.0:
        free += [4, 5]
        prior += [(sd / (before.acceleration * TIME_S * TIME_S)) ** 2] * 2
    if before.yaw > 0.0:
        free.append(6)
        prior.append((sd / (before.yaw * WAY_M)) ** 2)
    across = normal[free, -1]
    known = normal[np.ix_(free, free)] + np.diag(prior)
    values, axes = np.linalg.eigh(known)
    told = values > ROUNDING * values[-1]
    taken = np.square(across @ axes)[told] / values[told]
    return max(0.0, float(normal[-1, -1] - taken.sum()))
