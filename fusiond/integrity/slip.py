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

from typing import NamedTuple

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

PACES = (FAST, WHITE_FAST), (SLOW, WHITE_SLOW)


class Shown(NamedTuple):
    """Sum of slips' squares (m^2/s^2) and their number."""

    squares: float = 0.0
    number: float = 0.0


class Slip(NamedTuple):
    """What goes across as a series has shown it; `opened` of the heading's variance (rad^2)."""

    means: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Of u v and v^2, at the fast pace and at the slow one."""
    opened: float = 0.0
    since_ns: int = 0
    lately: Shown = Shown()
    waiting: Shown = Shown()
    """Of the period before."""
    believed: Shown = Shown()

    def with_one(
        self, t_ns: int, across: tuple[float, float], speed: float, variance: float
    ) -> Slip:
        """One more: the velocity across and the sigma of slips that is configured (m/s), the speed,
        and the aid's own variance (m^2/s^2)."""
        u, drift_sd = across
        square = speed * speed
        lasting = self._lasting(drift_sd * drift_sd)
        means: list[float] = []
        opened = shown = 0.0
        for k, (most, white) in enumerate(PACES):
            uv, vv = self.means[2 * k : 2 * k + 2]
            pace = most * min(1.0, square / vv) if vv > 0.0 else most
            uv, vv = uv + pace * (u * speed - uv), vv + pace * (square - vv)
            means += [uv, vv]
            if vv > 0.0:
                shown = uv * uv / vv
                opened = max(opened, (shown - LIKELY * (lasting + variance * white)) / vv)
        s = self
        if t_ns - s.since_ns >= LEARN_NS:
            s = s._replace(
                since_ns=t_ns,
                lately=Shown(),
                waiting=s.lately,
                believed=_sum(s.believed, s.waiting),
            )
        lately = Shown(s.lately.squares + shown, s.lately.number + 1.0)
        return s._replace(means=tuple(means), opened=opened, lately=lately)

    def _lasting(self, configured: float) -> float:
        """Variance of a slip that lasts."""
        told = self.believed
        return (DOUBTED_COUNT * configured + told.squares) / (DOUBTED_COUNT + told.number)

    def without_lately(self) -> Slip:
        """Its series is left out: what it has shown lately is a fault's."""
        return Slip(believed=self.believed)


def _sum(one: Shown, other: Shown) -> Shown:
    """Both, of no more than `LASTING_COUNT`."""
    number = one.number + other.number
    share = min(1.0, LASTING_COUNT / number) if number else 1.0
    return Shown(share * (one.squares + other.squares), share * number)
