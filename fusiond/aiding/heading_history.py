"""Headings and attitudes over time, for a vehicle without an inertial unit.

Between two attitudes the vehicle turns evenly, with an uncertainty of its rate as large as the
rate. After the last one it keeps the attitude, with the same uncertainty. A heading alone implies a
level vehicle, as on a road.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from operator import attrgetter
from typing import NamedTuple

Vector3 = tuple[float, float, float]

HOLDS_NS = 1_000_000_000
"""Time (s) for which a heading is valid: a vehicle in a street corner turns by a fifth of a right
angle, and its speed along the heading is 5 % less."""
KEPT_NS = 12_000_000_000
"""Age beyond which headings are dropped; the timeline rewinds by ten seconds."""
LEVEL_SD_RAD = 0.05
"""One sigma of roll and of pitch on a road: main roads climb by 6 % at most, and bank in bends by
as much (AASHTO, A Policy on Geometric Design of Highways and Streets, 2018, 3.3 and 3.4)."""
CORNER_RAD_S, STEADY_RAD_S = 0.31, math.radians(0.5)
"""One sigma of the turn rate without two attitudes, as in a street corner; and its least value with
them, a sixth of an aircraft's standard turn."""


class KnownHeading(NamedTuple):
    """Heading (rad) at an instant, with its sigma; `lasts` if later ones share its error."""

    t_ns: int
    yaw_rad: float
    sd_rad: float
    lasts: bool = False


class Oriented(NamedTuple):
    """Roll, pitch, yaw (rad) at an instant, with their sigmas; `block` names the model's block of
    their sensor's misalignment, if it has one."""

    t_ns: int
    rpy: Vector3
    sd: Vector3
    block: str = ""

    def turns(self, other: Oriented) -> Vector3:
        """Angles from its attitude to another's."""
        roll, pitch, yaw = (
            (b - a + math.pi) % (2.0 * math.pi) - math.pi
            for a, b in zip(self.rpy, other.rpy, strict=True)
        )
        return roll, pitch, yaw


class HeadingHistory:
    """Received headings, and the lateral velocity (m/s, one sigma) of the vehicle; infinite for one
    that may move in any direction, for which a heading is no constraint."""

    def __init__(self, slips_m_s: float = math.inf) -> None:
        self.slips_m_s = slips_m_s
        self._headings: list[KnownHeading] = []
        self._attitudes: list[Oriented] = []

    @property
    def known(self) -> bool:
        """True if the vehicle goes the way it faces, or backwards."""
        return math.isfinite(self.slips_m_s)

    def add(self, heading: KnownHeading) -> None:
        """Add a heading, in any order."""
        insort(self._headings, heading)
        oldest = KnownHeading(self._headings[-1].t_ns - KEPT_NS, -math.inf, 0.0)
        del self._headings[: bisect_left(self._headings, oldest)]

    def at(self, t_ns: int) -> KnownHeading | None:
        """The last valid heading at or before `t_ns`; None without one."""
        at = bisect_right(self._headings, KnownHeading(t_ns, math.inf, math.inf))
        if not (self.known and at):
            return None
        last = self._headings[at - 1]
        return last if t_ns - last.t_ns <= HOLDS_NS else None

    def orient(self, attitude: Oriented) -> None:
        """Add an attitude, in any order."""
        kept = self._attitudes
        insort(kept, attitude, key=_instant)
        del kept[: bisect_left(kept, kept[-1].t_ns - KEPT_NS, key=_instant)]

    def oriented_at(self, t_ns: int) -> Oriented | None:
        """Attitude at `t_ns`, interpolated, or from the last heading; None where neither is
        valid."""
        kept = self._attitudes
        at = bisect_right(kept, t_ns, key=_instant)
        near = [one for one in kept[max(0, at - 1) : at + 1] if abs(one.t_ns - t_ns) <= HOLDS_NS]
        if not near:
            return self._level_at(t_ns)
        if len(near) == 2:
            return _between(near[0], near[1], t_ns)
        (one,) = near
        pair = kept[at - 2 : at] if at >= 2 and kept[at - 1] is one else []
        rate = _rate(*pair) if pair else CORNER_RAD_S
        return _wider(one, t_ns, one.rpy, rate * abs(t_ns - one.t_ns) * 1e-9)

    def _level_at(self, t_ns: int) -> Oriented | None:
        last = self.at(t_ns)
        if last is None or last.lasts:
            return None
        turned = CORNER_RAD_S * (t_ns - last.t_ns) * 1e-9
        sd = LEVEL_SD_RAD, LEVEL_SD_RAD, math.hypot(last.sd_rad, turned)
        return Oriented(t_ns, (0.0, 0.0, last.yaw_rad), sd)


_instant = attrgetter("t_ns")


def _rate(a: Oriented, b: Oriented) -> float:
    """One sigma (rad/s) of a change of the turn rate between two headings."""
    span_s = (b.t_ns - a.t_ns) * 1e-9
    if not 0.0 < span_s <= HOLDS_NS * 1e-9:
        return CORNER_RAD_S
    return max(STEADY_RAD_S, math.hypot(*a.turns(b)) / span_s)


def _between(a: Oriented, b: Oriented, t_ns: int) -> Oriented:
    """Linear interpolation; a turn rate that changes evenly by r over the span T causes an error of
    r s (T - s) / (2 T) at s."""
    span_s, s = (b.t_ns - a.t_ns) * 1e-9, (t_ns - a.t_ns) * 1e-9
    if span_s == 0.0:
        return a
    roll, pitch, yaw = (x + d * s / span_s for x, d in zip(a.rpy, a.turns(b), strict=True))
    wider = a if max(a.sd) >= max(b.sd) else b
    return _wider(wider, t_ns, (roll, pitch, yaw), _rate(a, b) * s * (span_s - s) / (2.0 * span_s))


def _wider(one: Oriented, t_ns: int, rpy: Vector3, turned_rad: float) -> Oriented:
    roll, pitch, yaw = (math.hypot(sd, turned_rad) for sd in one.sd)
    return Oriented(t_ns, rpy, (roll, pitch, yaw), one.block)
