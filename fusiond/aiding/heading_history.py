"""Headings of a vehicle that has no inertial unit, by their instants: the way that it faces."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from typing import NamedTuple

HOLDS_NS = 1_000_000_000
"""For so long a heading counts: a vehicle in a street's corner turns by a fifth of a right angle
meanwhile, and its speed along the heading is 5 % less."""
KEPT_NS = 12_000_000_000
"""Older ones are too old for the timeline, which goes back by ten seconds."""


class KnownHeading(NamedTuple):
    """A heading (rad) at an instant, with its sigma."""

    t_ns: int
    yaw_rad: float
    sd_rad: float


class HeadingHistory:
    """Headings that have come, and how fast (m/s, one sigma) the vehicle slides sideways; infinite
    for one that need not go the way it faces, of which a heading says nothing."""

    def __init__(self, slips_m_s: float = math.inf) -> None:
        self.slips_m_s = slips_m_s
        self._headings: list[KnownHeading] = []

    @property
    def known(self) -> bool:
        """True if the vehicle goes the way it faces, or backwards."""
        return math.isfinite(self.slips_m_s)

    def add(self, heading: KnownHeading) -> None:
        """A heading has come, in whatever order."""
        insort(self._headings, heading)
        oldest = KnownHeading(self._headings[-1].t_ns - KEPT_NS, -math.inf, 0.0)
        del self._headings[: bisect_left(self._headings, oldest)]

    def at(self, t_ns: int) -> KnownHeading | None:
        """The last heading at `t_ns` or before that still counts; None where there is none."""
        at = bisect_right(self._headings, KnownHeading(t_ns, math.inf, math.inf))
        if not (self.known and at):
            return None
        last = self._headings[at - 1]
        return last if t_ns - last.t_ns <= HOLDS_NS else None
