r"""A position that is believed again, and may be off still.

A receiver that was left out comes back when the filter's own bound, grown meanwhile, allows it
(fusiond.integrity.isolation), or is what navigation begins anew with. Either its fault is over, or
it lasts and the bound has grown over it: a step of two metres is inside what an IMU keeps for a
quarter of a minute, and of one receiver nobody can tell. From then on innovations are small, for
the filter follows. With d what the two were apart, P the filter's own variance then, and T the time
for which it had been left out, what is published of the position is wider than P by

    (d^2 + P) T / (T + t)

in each axis, t after the return. How long a fault lasts has no scale: what has lasted for T goes on
for t more in T / (T + t) of the cases (the prior 1 / T of a duration that nothing is known of).
Of a first fix after an outage of T, which nothing has contradicted, it is what d^2 is beyond 3.84 S
(fusiond.integrity.returns); and of the tilt what the filter makes of that, by its regression on the
position, P_ix / P_xx: ten metres that were the receiver's tilted it by 0.2 deg at a stated 0.03.
What ends it sooner is another device's position that could tell: `TELLS` times as fine as what is
open, and within half of it; a coarse one tells nothing of a drift, which its sigma may hide.

A velocity that had parted from the filter, and is believed again because the filter has followed
the receiver, is no different: the filter was wrong, or position and velocity drift away together.
With u what the two were apart then, and T the time until the operator is told that all is well,
velocity and position are open by

    u^2 T / (T + t)                 u^2 (T + t)^2 T / (T + t)

and a vehicle's heading, which follows a velocity across, by the angle that u makes of its speed. A
drift may go on for ever and take the position anywhere: what is left after 19 T is one case in
twenty, and is left out.

A position that no velocity goes with, and that is believed still though the filter was put in doubt
by a mean d of its innovations, has gone that far while the mean looks back: u is d by that time. So
it is of one whose mean is no chance (fusiond.integrity.lately) and is not told: the filter follows.

Source: Jeffreys, Theory of Probability, 3rd ed. (1961), section 3.1 (the prior of a scale); Gott,
Nature 363 (1993), 315 (a duration of which no more is known than for how long it has lasted).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.proof import Trend
from fusiond.navigation.error_model import DR

Array = NDArray[np.float64]

# A device says which of two places is the right one, if they are five of its sigmas apart: its fix
# is then on the nearer side of the middle but for six cases in a thousand.
TELLS = 5.0
# A position of this sigma (m) sees within seconds what a wrong velocity does to the filter.
FINE_M = 3.0
# A hundredth of P's variance is half a percent of sigma.
LEAST = 0.01
# What goes on in fewer cases than one in twenty is not likely, as everywhere (means.LIKELY).
UNLIKELY = 0.05
# A step of a velocity is known by its mean when that shows all of it or, of one that the gate just
# lets pass, a third: so many times what it shows is in the middle.
SHOWN_OF_STEP = 2.0
# Once the motion was in doubt nothing is vouched for for so long (ns).
VOUCHED_NS = 10_000_000_000


class Witness(Protocol):
    """What is known of another device's positions or velocities."""

    device: str
    locates: bool
    moves: bool
    fused_ns: int
    sd_m: float
    away_m: float
    sd_m_s: float
    moved: Moved | None
    parted: Parted | None

    @property
    def believed(self) -> bool: ...


class Returned(Protocol):
    """What is known of a series of positions that was left out from `refused_ns` on."""

    device: str
    refused_ns: int
    passes: int
    rise_m: float
    trend: Trend
    moved: Moved | None


class Moved(NamedTuple):
    """A `device` that is back since `since_ns` after `lasted_ns` without it, and what it may be off
    by (m^2): north, east, down; may go on to run away with (m^2/s^2): north, east; and has tilted
    the filter by (rad^2)."""

    device: str
    since_ns: int
    lasted_ns: int
    squares: tuple[float, float, float]
    speeds: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0

    def leaves_open(self, t_ns: int, speed: float = math.inf) -> Array:
        """Variances (9,) that what is published is wider by, at that speed (m/s)."""
        elapsed_ns = self.lasted_ns + max(0, t_ns - self.since_ns)
        share = self.lasted_ns / elapsed_ns
        wider = np.zeros(9)
        wider[:3], wider[6:8] = self.squares, self.tilt
        if share >= UNLIKELY:
            wider[3:5] = self.speeds
            wider[:2] += wider[3:5] * (elapsed_ns * 1e-9) ** 2
            runs = sum(self.speeds)
            if runs:
                wider[8] = runs / max(speed * speed, TELLS * TELLS * runs)
        wider *= share
        return wider

    def joined(self, before: Moved | None) -> Moved:
        """With what was open of it `before` as well; it fades as the longer of both."""
        if before is None:
            return self
        opened = before.leaves_open(self.since_ns)
        north, east, down = (np.array(self.squares) + opened[:3]).tolist()
        runs_n, runs_e = np.maximum(self.speeds, opened[3:5]).tolist()
        return self._replace(
            lasted_ns=max(self.lasted_ns, before.lasted_ns),
            squares=(north, east, down),
            speeds=(runs_n, runs_e),
            tilt=self.tilt + float(opened[6]),
        )

    def told(self, series: Collection[Witness]) -> bool:
        """Whether one of another device that was fused since has told that it is not off. A device
        that may be off itself does not tell: both may be carried off together."""
        open_too = {self.device, *(r.device for r in series if r.moved or r.parted)}
        fused = [
            r
            for r in series
            if r.device not in open_too and r.believed and r.fused_ns > self.since_ns
        ]
        runs = math.sqrt(sum(self.speeds))
        return any(
            self._told_by(r) if r.locates else r.moves and 0.0 < r.sd_m_s * TELLS <= runs
            for r in fused
        )

    def _told_by(self, position: Witness) -> bool:
        if any(self.speeds) and position.sd_m > FINE_M:
            return False  # how fast it goes is not known, and may be what its sigma hides
        way_s = (self.lasted_ns + max(0, position.fused_ns - self.since_ns)) * 1e-9
        apart = math.sqrt(sum(self.squares[:2]) + sum(self.speeds) * way_s * way_s)
        return 0.0 < position.sd_m * TELLS <= apart and position.away_m <= 0.5 * apart


class Parted(NamedTuple):
    """By how much (m/s), north and east, a velocity had parted from the filter from `since_ns` on,
    when the motion was doubted for it."""

    since_ns: int
    north: float
    east: float

    @staticmethod
    def shown(t_ns: int, by: Sequence[float]) -> Parted:
        """As a mean that is beyond chance shows it (m/s)."""
        return Parted(t_ns, SHOWN_OF_STEP * by[0], SHOWN_OF_STEP * by[1])

    def followed(self, device: str, t_ns: int) -> Moved:
        """It is believed again, or still, at `t_ns`."""
        lasted_ns = max(t_ns - self.since_ns, VOUCHED_NS)
        speeds = self.north**2, self.east**2
        return Moved(device, self.since_ns + lasted_ns, lasted_ns, (0.0, 0.0, 0.0), speeds)


def left(device: str, t_ns: int, lasted_ns: int, away_m: float, alone: bool = False) -> Moved:
    """Of a navigation that begins anew with a device that had left the one before it by `away_m`,
    in which axes is not known any more. If it sends positions `alone`, it may go on as fast."""
    square = 0.5 * away_m * away_m
    squares = square, square, square
    if not alone or not lasted_ns:
        return Moved(device, t_ns, lasted_ns, squares)
    runs = square / (lasted_ns * 1e-9) ** 2
    return Moved(device, t_ns, max(lasted_ns, VOUCHED_NS), squares, (runs, runs))


def back(returned: Returned, t_ns: int, covariance: Array) -> Moved:
    """Of what is believed again, by the means of what has passed and P (n, n) of the filter; what
    was open of it before it was left out stays."""
    trend = returned.trend
    squares = covariance.diagonal()[DR : DR + 3].copy()
    squares[0] += (trend.north / trend.n) ** 2
    squares[1] += (trend.east / trend.n) ** 2
    squares[2] += (returned.rise_m / returned.passes) ** 2
    north, east, down = squares.tolist()
    out_ns = t_ns - returned.refused_ns
    return Moved(returned.device, t_ns, out_ns, (north, east, down)).joined(returned.moved)
