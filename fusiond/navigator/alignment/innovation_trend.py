"""Drift of position innovations: a least-squares line against time."""

from __future__ import annotations

import math
from typing import NamedTuple


class Offset(NamedTuple):
    """Innovation of a position, north and east (m), and one sigma of the measurement (m)."""

    north: float
    east: float
    sd: float


class Trend(NamedTuple):
    """Sums for a least-squares line through position innovations (m) over time (s)."""

    n: int = 0
    t: float = 0.0
    tt: float = 0.0
    north: float = 0.0
    east: float = 0.0
    t_north: float = 0.0
    t_east: float = 0.0
    sd: float = 0.0

    def with_one(self, z: Offset, t_s: float) -> Trend:
        """Sums with one more innovation."""
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
    def slope(self) -> tuple[float, float]:
        """Drift rate (m/s), and sigma of one axis; infinite without data."""
        spread = self.tt - self.t * self.t / self.n if self.n else 0.0
        if spread <= 0.0:
            return 0.0, math.inf
        north = (self.t_north - self.t * self.north / self.n) / spread
        east = (self.t_east - self.t * self.east / self.n) / spread
        return math.hypot(north, east), self.sd / math.sqrt(spread)


NO_TREND = Trend()
