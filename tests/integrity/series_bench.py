"""A filter at rest in its own eyes, and what the isolation is told of the series around it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.body_velocity import NonHolonomicAid, WheelSpeedAid
from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.estimators.base import Outcome, gate_threshold
from fusiond.integrity.action import Action
from fusiond.integrity.isolation import Isolation
from fusiond.navigation.earth import meridian_radius, transverse_radius

GATE = 0.9999
S = 1_000_000_000
NAV = np.array([0.53, 1.99, 40.0, 8.0, 3.0, 0.0, 1.0, 0.0, 0.0, 0.0])
LEVER = (0.0, 0.0, 0.0)
SD_M = 1.0
# P before an update over P after it.
TOLD = 1.04


class Bench:
    """A filter that stands at `NAV` and believes its innovations to be of variance one: what the
    isolation is told of a receiver's fixes and velocities. `white`: its fixes are configured to
    share no error. `covariance`: P (9, 9), where the isolation is told of it."""

    def __init__(self, white: bool = False) -> None:
        self.isolation = Isolation()
        self.rng = np.random.default_rng(3)
        self._white = white
        self.covariance: NDArray[np.float64] | None = None
        self.nav = NAV

    def fix(
        self, t_s: float, north_m: float = 0.0, source: str = "gnss", sd_m: float = SD_M
    ) -> Action:
        """A fix `north_m` from the filter, beside its noise."""
        y = self.rng.standard_normal(3)
        y[0] += north_m / sd_m
        lat = float(NAV[0]) - y[0] * sd_m / (meridian_radius(float(NAV[0])) + 40.0)
        sd = (sd_m, sd_m, sd_m)
        lon = float(NAV[1]) - y[1] * sd_m / 5.5e6
        aid = PositionAid(source, round(t_s * S), GATE, lat, lon, 40.0, sd, LEVER)
        return self._judge(replace(aid, shares_nothing=self._white), y)

    def velocity(
        self,
        t_s: float,
        bias: float = 0.0,
        east_m_s: float = 3.0,
        north_m_s: float = 8.0,
        source: str = "gnss",
    ) -> Action:
        """A velocity of the receiver, `bias` sigma off, that says so or so much."""
        y = self.rng.standard_normal(3)
        y[1] += bias
        v = north_m_s, east_m_s, 0.0
        aid = VelocityAid(f"{source}_velocity", round(t_s * S), GATE, v, (0.05,) * 3, LEVER)
        return self._judge(aid, y)

    def moved_fix(self, t_s: float, velocity: tuple[float, float]) -> Action:
        """A fix of a place that moves north and east, which the filter agrees with."""
        y = self.rng.standard_normal(3)
        north, east = (SD_M * n + v * t_s for n, v in zip(y[:2], velocity, strict=True))
        lat = float(NAV[0]) + north / (meridian_radius(float(NAV[0])) + 40.0)
        lon = float(NAV[1]) + east / (
            (transverse_radius(float(NAV[0])) + 40.0) * math.cos(float(NAV[0]))
        )
        sd = (SD_M, SD_M, SD_M)
        aid = PositionAid("gnss", round(t_s * S), GATE, lat, lon, 40.0, sd, LEVER)
        return self.isolation.judge(aid, Outcome("fused", 1.0, 3, tuple(y.tolist())), NAV)

    def wheel(self, t_s: float, speed_m_s: float) -> Action:
        """A wheel's speed that fits."""
        aid = WheelSpeedAid("wheel", round(t_s * S), GATE, speed_m_s, 0.1, LEVER)
        return self.isolation.judge(aid, Outcome("fused", 0.25, 1, (0.5,)), NAV)

    def no_slip(self, t_s: float, *, holds: bool) -> Action:
        """The constraint of no side slip."""
        aid = NonHolonomicAid("non_holonomic", round(t_s * S), GATE, 0.1, 0.1, 1.0, LEVER)
        outcome = Outcome("fused", 0.5, 2, (0.5, 0.5)) if holds else Outcome("gated", 900.0, 2)
        return self.isolation.judge(aid, outcome, NAV)

    def _judge(self, aid: PositionAid | VelocityAid, y: NDArray[np.float64]) -> Action:
        nis = float(y @ y)
        believed = aid.source not in self.isolation.excluded
        fused = nis <= gate_threshold(GATE, 3) and believed
        name = "fused" if fused else "isolated"
        if not fused and believed:
            name = "gated"
        seen = Outcome(name, nis, 3, tuple(y.tolist()))
        if self.covariance is not None:
            self.isolation.correcting(self.nav, TOLD * self.covariance)
        return self.isolation.judge(aid, seen, self.nav, self.covariance)

    def both(self, seconds: range, north_m: float = 0.0) -> set[Action]:
        """Fix and velocity each second."""
        return {a for t in seconds for a in (self.fix(t, north_m), self.velocity(t))}
