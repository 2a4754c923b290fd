r"""Whether aids correct the tilt more than the filter expects them to: an IMU that has changed.

Each update corrects the tilt by d = K nu (north and east), whose covariance is K S K^T = P- - P+ of
the two: as long as filter and sensors agree, corrections are independent of each other. So with

    c <- f c + d,   V <- f^2 V + (P- - P+),   f = exp(-dt / T)

c^T V^-1 c is chi-square of two. A gyro whose bias has changed, or that has turned in its mounting,
tilts the navigation axes by more each second; gravity makes a velocity of that, and a receiver's
velocity takes it back again and again in the same direction. Each single innovation is small, and
so is their mean, for the filter follows: what it has followed by is what tells.

Source: Mehra, Peschon, An innovations approach to fault detection and diagnosis in dynamic systems,
Automatica 7 (1971), section 3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# How long (s) corrections are added up: within it a bias that is wrong by 0.1 deg/s tilts the axes
# by as many sigma of an aided filter as a longer sum would need to tell.
LASTS_S = 2.0
# Chi-square of two that chance exceeds once in a million. Without a fault it reached 17 in three
# simulated towns, 21 in drive_0708 and 23 in css_164.
LIMIT = 27.6


class Attitude(NamedTuple):
    """Attitude quaternion (4), body to navigation axes, and P of the tilt north and east, rad^2."""

    q: list[float]
    nn: float
    ne: float
    ee: float

    @staticmethod
    def of(q: Array, covariance: Array) -> Attitude:
        """Of what a filter holds: a quaternion (4,) and P, whose first two rows are the tilt's."""
        element = covariance.item
        return Attitude(q.tolist(), element(0, 0), element(0, 1), element(1, 1))


class Tilting(NamedTuple):
    """The sums c (rad) and V (rad^2) at an instant (ns)."""

    t_ns: int = 0
    north: float = 0.0
    east: float = 0.0
    nn: float = 0.0
    ne: float = 0.0
    ee: float = 0.0

    def with_one(self, t_ns: int, before: Attitude, after: Attitude) -> Tilting:
        """With one update more: the attitude before and after it."""
        f = math.exp(-max(0, t_ns - self.t_ns) * 1e-9 / LASTS_S)
        w, x, y, z = before.q
        to_w, to_x, to_y, to_z = after.q
        # Vector part of after times before's conjugate: half of the small turn.
        way = math.copysign(2.0, w * to_w + x * to_x + y * to_y + z * to_z)
        return Tilting(
            t_ns,
            f * self.north + way * (to_x * w - to_w * x - to_y * z + to_z * y),
            f * self.east + way * (to_y * w - to_w * y + to_x * z - to_z * x),
            f * f * self.nn + (before.nn - after.nn),
            f * f * self.ne + (before.ne - after.ne),
            f * f * self.ee + (before.ee - after.ee),
        )

    @property
    def too_far(self) -> bool:
        """Whether the corrections do not fit the covariance that they were made with."""
        determinant = self.nn * self.ee - self.ne * self.ne
        if self.nn <= 0.0 or determinant <= 1e-9 * self.nn * self.ee:
            return False
        square = self.ee * self.north**2 + self.nn * self.east**2
        square -= 2.0 * self.ne * self.north * self.east
        return square > LIMIT * determinant


NOT_TILTING = Tilting()
