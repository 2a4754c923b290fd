r"""Whether it would have shown by now that the fixes of a receiver are late since it came back.

Fixes that are late by tau lie where the vehicle was, p(t - tau). Of a motion of constant
acceleration a that is another one with the same acceleration, p(t) - tau v + tau^2 a / 2, which
goes with all that an IMU feels: after an outage it is believed as far as the outage's sigma
allows, and each fix makes the filter surer of it. What tells is by how much the velocity has left
a straight line in time, w(t): there fixes and motion differ by tau w, and after n fixes of sigma s

    sigma_tau = s / sqrt(sum |w|^2)

Until a lateness of `LATE_S` is beyond `TOLD` of this, nobody can tell. A receiver that came back
where the filter was is believed; of one whose first fix lies behind it by more than is likely
(fusiond.integrity.isolation) the mode says so meanwhile. Sigma does not: it would have to be tau v.

So of one whose fixes a filter was started from after a failure: nothing is known of it but those
fixes, and braking evenly goes with late ones as well as with good ones. The heading of such a start
is theirs too, and in an even bend late fixes are a heading: there only the speed tells.

Source: least squares; as of fusiond.navigator.alignment.lateness, which finds tau itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

# The filter has a state for a lateness of 0.1 s (`time_offset_sd_s`); three of that it does not
# hold.
LATE_S = 0.3
# What is told with a false alarm in a million, in half of the cases (sqrt of 27.6).
TOLD = 5.25
# Faster than this (m/s) the vehicle moves: what is measured of it changes.
MOVING_M_S = 1.0


class Punctual(NamedTuple):
    """Sums over fixes: of time (s) since the first at `begin_ns`, and of the filter's velocity
    (m/s, north and east), by time and squared; `sd` (m) the largest sigma of an axis."""

    begin_ns: int
    n: int = 0
    t: float = 0.0
    tt: float = 0.0
    north: float = 0.0
    east: float = 0.0
    t_north: float = 0.0
    t_east: float = 0.0
    square: float = 0.0
    sd: float = 0.0
    speed: float = 0.0
    """At the last of them (m/s)."""
    started: bool = False
    """The filter was started from them: only the speed counts."""

    @property
    def matters(self) -> bool:
        """Whether a lateness would be worse than a fix: of a start, or it moves it by less than
        what one fix is good to; of what came back, whether the vehicle moves at all."""
        least_m_s = self.sd / LATE_S if self.started else MOVING_M_S
        return self.speed > least_m_s

    def with_one(self, t_ns: int, north: float, east: float, sd: float) -> Punctual:
        """With one fix more at `t_ns`, of sigma `sd` (m), of a filter with that velocity (m/s)."""
        t_s, speed = (t_ns - self.begin_ns) * 1e-9, math.hypot(north, east)
        if self.started:
            north, east = speed, 0.0
        return Punctual(
            self.begin_ns,
            self.n + 1,
            self.t + t_s,
            self.tt + t_s * t_s,
            self.north + north,
            self.east + east,
            self.t_north + t_s * north,
            self.t_east + t_s * east,
            self.square + north * north + east * east,
            max(self.sd, sd),
            speed,
            self.started,
        )

    @property
    def left(self) -> float:
        """sum |w|^2 (m^2/s^2): of what the velocity is beside its line in time."""
        n = self.n
        spread = self.tt - self.t * self.t / n if n else 0.0
        if spread <= 0.0:
            return 0.0
        north = self.t_north - self.t * self.north / n
        east = self.t_east - self.t * self.east / n
        about = self.square - (self.north * self.north + self.east * self.east) / n
        return max(0.0, about - (north * north + east * east) / spread)

    @property
    def told(self) -> bool:
        """Whether a lateness would have shown."""
        return LATE_S * math.sqrt(self.left) >= TOLD * self.sd > 0.0
