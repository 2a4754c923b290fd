r"""Whether aids correct the tilt more than the filter expects them to: an IMU that has changed.

Each update corrects the tilt by d = K nu (north and east), whose covariance is K S K^T = P- - P+ of
the two: as long as filter and sensors agree, corrections are independent of each other. So with

    c <- f c + d,   V <- f^2 V + (P- - P+),   f = exp(-dt / T)

c^T V^-1 c is chi-square of two. A gyro whose bias has changed, or that has turned in its mounting,
tilts the navigation axes by more each second; gravity makes a velocity of that, and a receiver's
velocity takes it back again and again in the same direction. Each single innovation is small, and
so is their mean, for the filter follows: what it has followed by is what tells.

Where an update turns the heading by psi and P with it (fusiond.estimators.tilt_axes), P+ is taken
back to the axes of P-, and c and V are in those of P+ from then on.

Source: Mehra, Peschon, An innovations approach to fault detection and diagnosis in dynamic systems,
Automatica 7 (1971), section 3.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.strapdown import Q0

Array = NDArray[np.float64]

# How long (s) corrections are added up: within it a bias that is wrong by 0.1 deg/s tilts the axes
# by as many sigma of an aided filter as a longer sum would need to tell.
LASTS_S = 2.0
# Chi-square of two that chance exceeds once in a million. Without a fault it reached 17 in three
# simulated towns, 21 in drive_0708 and 23 in css_164.
LIMIT = 27.6


# Of the sums: the instant (ns, an integer), c (rad) north and east, V (rad^2) nn, ne, ee.
_SINCE, _C, _V, _SIZE = 0, 1, 3, 6


@compiled("void(f8[::1], f8[:, :], f8[::1])")
def remember(nav: Array, covariance: Array, before: Array) -> None:
    """What a filter holds before an update: the state `nav` (10,) and P (n, n)."""
    for i in range(4):
        before[i] = nav[Q0 + i]
    before[4], before[5], before[6] = covariance[0, 0], covariance[0, 1], covariance[1, 1]


@compiled("UniTuple(f8, 3)(f8, f8, f8, f8)")
def _turn(nn: float, ne: float, ee: float, psi: float) -> tuple[float, float, float]:
    """R V R^T of a V (2, 2) for a turn R by `psi` (rad) about down."""
    c, s = math.cos(psi), math.sin(psi)
    across = 2.0 * c * s * ne
    return (
        c * c * nn - across + s * s * ee,
        c * s * (nn - ee) + (c * c - s * s) * ne,
        s * s * nn + across + c * c * ee,
    )


@compiled("b1(f8[::1], i8, f8[::1], f8[::1], f8[:, :], f8)")
def too_far(
    sums: Array, t_ns: int, before: Array, nav: Array, covariance: Array, turned: float
) -> bool:
    """Add that update to `sums`, after which a filter holds these, P in axes that have `turned`
    (rad); whether the corrections do not fit the covariance that they were made with."""
    since_ns = sums[:1].view(np.int64)
    f = math.exp(-max(0, t_ns - since_ns[0]) * 1e-9 / LASTS_S)
    since_ns[0] = t_ns
    w, x, y, z = before[0], before[1], before[2], before[3]
    to_w, to_x, to_y, to_z = nav[Q0], nav[Q0 + 1], nav[Q0 + 2], nav[Q0 + 3]
    # Vector part of after times before's conjugate: half of the small turn.
    way = math.copysign(2.0, w * to_w + x * to_x + y * to_y + z * to_z)
    north = f * sums[_C] + way * (to_x * w - to_w * x - to_y * z + to_z * y)
    east = f * sums[_C + 1] + way * (to_y * w - to_w * y + to_x * z - to_z * x)
    sums[_C], sums[_C + 1] = north, east
    after = _turn(covariance[0, 0], covariance[0, 1], covariance[1, 1], -turned)
    for k in range(3):
        sums[_V + k] = f * f * sums[_V + k] + (before[4 + k] - after[k])
    nn, ne, ee = sums[_V], sums[_V + 1], sums[_V + 2]
    if turned != 0.0:
        c, s = math.cos(turned), math.sin(turned)
        north, east = c * north - s * east, s * north + c * east
        nn, ne, ee = _turn(nn, ne, ee, turned)
        sums[_C], sums[_C + 1] = north, east
        sums[_V], sums[_V + 1], sums[_V + 2] = nn, ne, ee
    determinant = nn * ee - ne * ne
    if nn <= 0.0 or determinant <= 1e-9 * nn * ee:
        return False
    square = ee * north * north + nn * east * east - 2.0 * ne * north * east
    beyond: bool = square > LIMIT * determinant
    return beyond


class Tilting:
    """The `sums` at an instant, and what a filter held `before` the update that comes next."""

    __slots__ = ("before", "sums")

    def __init__(self, sums: Array | None = None) -> None:
        self.sums = np.zeros(_SIZE) if sums is None else sums
        self.before = np.zeros(7)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tilting) and self.sums.tobytes() == other.sums.tobytes()

    __hash__ = None  # type: ignore[assignment]

    def copied(self) -> Tilting:
        """A copy for a checkpoint."""
        return Tilting(self.sums.copy())

    def left(self, covariance: Array | None) -> float:
        """What that update has left of the tilt's variance (1), after which a filter holds P
        (n, n); 1 where that is not known."""
        before = float(self.before[4] + self.before[6])
        if covariance is None or before <= 0.0:
            return 1.0
        return min(float(covariance[0, 0] + covariance[1, 1]) / before, 1.0)
