r"""Whether what goes across is slip, or a heading that has turned.

A vehicle that does not slip faces its velocity. Where the filter has a state for a slip that lasts
(fusiond.aiding.body_velocity) it takes a heading that has turned for one, and the innovations stay
small. Of all that goes across, u, the innovation and that state's estimate, the heading that fits
is the slope against the speed v, with u as seen along the way, be it backward. Slip makes such
slopes too, so that a heading is open by

    max(0, b^2 - 3.84 s / mean(v^2)),   b = mean(u v) / mean(v^2),   s = s_d^2 + r a / (2 - a)

with r the aid's variance and means at both paces a of fusiond.integrity.means. They forget by as
much as is seen of the heading: less where the vehicle goes slower than their v^2.

s_d^2, the variance of a slip that lasts, is that of the filter's state until the vehicle has shown
its own: the slow mean(u v)^2 / mean(v^2), believed `LEARN_NS` later, for lately it may be a fault.

Source: Groves, 2nd ed., section 15.4.1; Bar-Shalom, Li, Kirubarajan (2001), section 3.4 (least
squares).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.means import (
    DOUBTED_COUNT,
    FAST,
    LASTING_COUNT,
    LEARN_NS,
    LIKELY,
    SLOW,
    WHITE_FAST,
    WHITE_SLOW,
)
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

# Of the array that the kernel reads: the means of u v and v^2, at the fast pace and at the slow
# one, what is opened of the heading; sum of slips' squares (m^2/s^2) and their number lately, in
# the period before, and of those that are believed; since when (ns, an integer) lately is.
_OPENED, _LATELY, _WAITING, _BELIEVED, _SINCE, _SIZE = 4, 5, 7, 9, 11, 12


@compiled("f8(f8[::1], i8, f8, f8, f8, f8)")
def take_slip(
    packed: Array, t_ns: int, across: float, drift_sd: float, speed: float, variance: float
) -> float:
    """See `Slip.with_one`; what is opened then."""
    square = speed * speed
    number = DOUBTED_COUNT + packed[_BELIEVED + 1]
    lasting = (DOUBTED_COUNT * (drift_sd * drift_sd) + packed[_BELIEVED]) / number
    opened = shown = 0.0
    for k in range(2):
        most, white = (FAST, WHITE_FAST) if k == 0 else (SLOW, WHITE_SLOW)
        uv, vv = packed[2 * k], packed[2 * k + 1]
        pace = most * min(1.0, square / vv) if vv > 0.0 else most
        uv, vv = uv + pace * (across * speed - uv), vv + pace * (square - vv)
        packed[2 * k], packed[2 * k + 1] = uv, vv
        if vv > 0.0:
            shown = uv * uv / vv
            opened = max(opened, (shown - LIKELY * (lasting + variance * white)) / vv)
    packed[_OPENED] = opened
    since_ns = packed[_SINCE:].view(np.int64)
    if t_ns - since_ns[0] >= LEARN_NS:
        since_ns[0] = t_ns
        # Of no more than `LASTING_COUNT`.
        number = packed[_BELIEVED + 1] + packed[_WAITING + 1]
        share = min(1.0, LASTING_COUNT / number) if number > 0.0 else 1.0
        packed[_BELIEVED] = share * (packed[_BELIEVED] + packed[_WAITING])
        packed[_BELIEVED + 1] = share * number
        for k in range(2):
            packed[_WAITING + k] = packed[_LATELY + k]
            packed[_LATELY + k] = 0.0
    packed[_LATELY] += shown
    packed[_LATELY + 1] += 1.0
    return opened


class Slip:
    """What goes across as a series has shown it."""

    __slots__ = ("packed",)

    def __init__(self, packed: Array | None = None) -> None:
        self.packed = np.zeros(_SIZE) if packed is None else packed
        """What `take_slip` changes, of a series that is nobody else's."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Slip) and self.packed.tobytes() == other.packed.tobytes()

    __hash__ = None  # type: ignore[assignment]

    def copied(self) -> Slip:
        """A copy for a checkpoint."""
        return Slip(self.packed.copy())

    @property
    def opened(self) -> float:
        """Of the heading's variance (rad^2)."""
        return float(self.packed[_OPENED])

    def with_one(
        self, t_ns: int, across: tuple[float, float], speed: float, variance: float
    ) -> Slip:
        """One more: the velocity across and the sigma of slips that is configured (m/s), the speed,
        and the aid's own variance (m^2/s^2)."""
        packed = self.packed.copy()
        take_slip(packed, t_ns, *across, speed, variance)
        return Slip(packed)

    def without_lately(self) -> Slip:
        """Its series is left out: what it has shown lately is a fault's."""
        packed = np.zeros(_SIZE)
        packed[_BELIEVED : _BELIEVED + 2] = self.packed[_BELIEVED : _BELIEVED + 2]
        return Slip(packed)
