"""What is known of one series of innovations, and of a position that was left out.

A series is what one source says of one thing; fusiond.integrity.isolation judges it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

# A position comes back once its innovations are known not to run away by three times this (m/s):
# a drift of 0.2 m/s is what a filter with an honest velocity still tells from its own.
TREND_SD_M_S = 0.07
# Paces of the mean: some 11 and some 59 innovations deep, (2 - a) / a.
PACES = (1.0 / 6.0, 1.0 / 30.0)
# The variance of a mean at each pace, for white innovations of variance one; and what is assumed of
# a series before it has shown its own: successive innovations share a fifth of their variance.
WHITE = tuple(a / (2.0 - a) for a in PACES)
ASSUMED = tuple(white + 0.2 for white in WHITE)
# Before any instant that a clock can say.
NEVER_NS = -(2**62)


class Offset(NamedTuple):
    """How far a filter is from a position that was measured, north and east (m), and one sigma of
    the measurement (m)."""

    north: float
    east: float
    sd: float


class Trend(NamedTuple):
    """Sums over innovations of a position (m) against time (s): does it still run away?"""

    n: int = 0
    t: float = 0.0
    tt: float = 0.0
    north: float = 0.0
    east: float = 0.0
    t_north: float = 0.0
    t_east: float = 0.0
    sd: float = 0.0

    def with_one(self, z: Offset, t_s: float) -> Trend:
        """With one innovation more."""
        return Trend(
            self.n + 1,
            self.t + t_s,
            self.tt + t_s * t_s,
            self.north + z.north,
            self.east + z.east,
            self.t_north + t_s * z.north,
            self.t_east + t_s * z.east,
            max(self.sd, z.sd),
        )

    @property
    def steady(self) -> bool:
        """Whether the slope of a line through them is known to `TREND_SD_M_S`, and zero."""
        spread = self.tt - self.t * self.t / self.n
        if spread <= 0.0 or self.sd > TREND_SD_M_S * math.sqrt(spread):
            return False
        north = (self.t_north - self.t * self.north / self.n) / spread
        east = (self.t_east - self.t * self.east / self.n) / spread
        return math.hypot(north, east) <= 3.0 * TREND_SD_M_S


NO_TREND = Trend()


@dataclass(slots=True)
class Series:
    """What is known of one series: when it was heard and fused last, how it fails, its means."""

    device: str
    locates: bool
    moves: bool
    heard_ns: int
    fused_ns: int = NEVER_NS
    sd_m: float = 0.0
    refused: int = 0
    """Failures of the gate in a row, the first at `refused_ns`."""
    refused_ns: int = 0
    jumped: bool = False
    """The first of them left the filter faster than the IMU can err."""
    excluded: str = ""
    passes: int = 0
    """While excluded: innovations in a row that passed, the first at `passing_ns`."""
    passing_ns: int = 0
    trend: Trend = NO_TREND
    count: int = 0
    fast: tuple[float, ...] = ()
    slow: tuple[float, ...] = ()
    fast_spread: float = ASSUMED[0]
    slow_spread: float = ASSUMED[1]
    value: tuple[float, ...] | None = None
    repeats: int = 0

    def copied(self) -> Series:
        """A copy for a checkpoint."""
        return Series(*[getattr(self, name) for name in Series.__slots__])

    @property
    def believed(self) -> bool:
        """Whether its last innovation was fused."""
        return not (self.refused or self.excluded)
