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

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

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
def _write(q: Array, covariance: Array, out: Array) -> None:
    for i in range(4):
        out[i] = q[i]
    out[4], out[5], out[6] = covariance[0, 0], covariance[0, 1], covariance[1, 1]


def attitude(q: Array, covariance: Array) -> Array:
    """What a filter holds (7,): its quaternion `q` (4,), body to navigation axes, and of P (n, n)
    the tilt's nn, ne and ee (rad^2)."""
    out = np.empty(7)
    _write(q, covariance, out)
    return out


@compiled("b1(f8[::1], i8, f8[::1], f8[::1])")
def _add(sums: Array, t_ns: int, before: Array, after: Array) -> bool:
    """Add an update to `sums`; whether they do not fit the covariance that they were made with."""
    since_ns = sums[:1].view(np.int64)
    f = math.exp(-max(0, t_ns - since_ns[0]) * 1e-9 / LASTS_S)
    since_ns[0] = t_ns
    w, x, y, z = before[0], before[1], before[2], before[3]
    to_w, to_x, to_y, to_z = after[0], after[1], after[2], after[3]
    # Vector part of after times before's conjugate: half of the small turn.
    way = math.copysign(2.0, w * to_w + x * to_x + y * to_y + z * to_z)
    north = f * sums[_C] + way * (to_x * w - to_w * x - to_y * z + to_z * y)
    east = f * sums[_C + 1] + way * (to_y * w - to_w * y + to_x * z - to_z * x)
    sums[_C], sums[_C + 1] = north, east
    for k in range(3):
        sums[_V + k] = f * f * sums[_V + k] + (before[4 + k] - after[4 + k])
    nn, ne, ee = sums[_V], sums[_V + 1], sums[_V + 2]
    determinant = nn * ee - ne * ne
    if nn <= 0.0 or determinant <= 1e-9 * nn * ee:
        return False
    square = ee * north * north + nn * east * east - 2.0 * ne * north * east
    too_far: bool = square > LIMIT * determinant
    return too_far


class Tilting:
    """The sums at an instant. `too_far`: the corrections do not fit the covariance that they were
    made with."""

    __slots__ = ("_sums", "too_far")

    def __init__(self, sums: Array | None = None) -> None:
        self._sums = np.zeros(_SIZE) if sums is None else sums
        self.too_far = False

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tilting) and self._sums.tobytes() == other._sums.tobytes()

    __hash__ = None  # type: ignore[assignment]

    def with_one(self, t_ns: int, before: Array, after: Array) -> Tilting:
        """With one update more: the attitude (7,) before and after it."""
        tilting = Tilting(self._sums.copy())
        tilting.too_far = _add(tilting._sums, t_ns, before, after)
        return tilting


NOT_TILTING = Tilting()
