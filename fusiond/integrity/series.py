"""What is known of one series of innovations.

A series is what one source says of one thing; fusiond.integrity.isolation judges it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import attrgetter

from fusiond.aiding.offers import Offer, PositionOffer, SpeedOffer, VelocityOffer
from fusiond.estimators.base import gate_threshold
from fusiond.integrity.lately import NOT_YET, Apart, Lately, goes_on, refused
from fusiond.integrity.means import Means
from fusiond.integrity.moved import Moved, Parted
from fusiond.integrity.proof import (
    DRIFT_SD_M_S,
    NO_TREND,
    SLOWEST_M_S,
    TREND_SD_M_S,
    Offset,
    Proof,
    Trend,
)
from fusiond.integrity.punctual import Punctual
from fusiond.integrity.slip import Slip

DRIFTS, REPEATS, DENIED = "drifts", "repeats itself", "wheels deny it"
# Position repeated to the bit so often while the vehicle moves: receivers print metres to the
# centimetre or finer, so that two alike are chance, three are not.
REPEATED = 2
# Speeds are printed coarser: so rare a run of equal ones is none, by the probability that one
# repeats the one before, as this series has shown it (average of so many).
CHANCE, REPEATS_KEPT = 1e-9, 100.0
# Five in a row that pass a gate of 0.9999 while a fault of four sigma lasts: one case in 1000; and
# over three seconds, so that no burst of a wrong stream is let in by its number.
READMIT_COUNT, READMIT_NS = 5, 3_000_000_000
# Before any instant that a clock can say.
NEVER_NS = -(2**62)


@dataclass(slots=True)
class Series:
    """What is known of one series: when it was heard and fused last, how it fails, its means."""

    device: str
    locates: bool
    moves: bool
    heard_ns: int
    no_slip: bool = False
    fused_ns: int = NEVER_NS
    sd_m: float = 0.0
    away_m: float = 0.0
    """Horizontally, of a position: its last innovation."""
    above_m: float = 0.0
    """Of a position that was not fused: how far it was above the filter."""
    sd_m_s: float = 0.0
    """Of a velocity, horizontally."""
    refused: int = 0
    """Failures of the gate in a row, the first at `refused_ns`."""
    refused_ns: int = 0
    off: tuple[float, float] = (0.0, 0.0)
    """North and east (m/s): what a velocity was off by in their mean."""
    jumped: bool = False
    """The first of them left the filter faster than the IMU can err; or it is wrong for itself."""
    excluded: str = ""
    passes: int = 0
    """While excluded: innovations in a row that passed, the first at `passing_ns`."""
    passing_ns: int = 0
    rise_m: float = 0.0
    """Of those that passed: the sum of how far they were above the filter."""
    trend: Trend = NO_TREND
    ran: bool = False
    """While excluded: it was seen to run away, faster than any slow drift."""
    back_ns: int = NEVER_NS
    """When it was believed again last."""
    means: Means = field(default_factory=Means)
    """Of its innovations that were fused, or passed while it is left out."""
    lately: Lately = NOT_YET
    """Of a velocity that is fused: the last innovations."""
    apart: Apart | None = None
    """What several of those, or a position's means, have left open."""
    value: tuple[float, ...] | None = None
    alike: int = 0
    """How many before the last value were the same, moving or not."""
    repeats: int = 0
    repeating: float = 1.0
    """Probability that a value repeats the one before it, as shown so far in motion."""
    proof: Proof | None = None
    """Of a position that came back after an outage: what is seen of it until it is proven."""
    punctual: Punctual | None = None
    """Of one that came back, or that a filter was started from: until it would have shown that it
    is late."""
    moved: Moved | None = None
    """Of a position that is believed again, while it may be off still."""
    parted: Parted | None = None
    """Of a velocity that is left out, where the motion was doubted for it."""
    every_ns: int = 0
    """From the one before to the last that was heard."""
    slip: Slip = field(default_factory=Slip)
    """Of what is said not to slip."""

    def copied(self) -> Series:
        """A copy for a checkpoint."""
        copy = Series(*_FIELDS(self))
        copy.means = self.means.copied()
        if self.no_slip:
            copy.slip = self.slip.copied()
        return copy

    def forget(self) -> None:
        """It has not been heard of for long: it is judged anew, though not believed again."""
        self.repeats = self.passes = 0
        self.means.restart()
        self.lately, self.apart = NOT_YET, None
        if not self.excluded:
            self.refused, self.jumped = 0, False

    def parts(self, by: tuple[float, float], nis: float) -> None:
        """A velocity is refused that is off `by` (m/s, north and east)."""
        (north, east), share = self.off if self.refused else by, 1.0 / (self.refused + 1)
        self.lately = NOT_YET
        self.apart = goes_on(self.apart, self.heard_ns, self.every_ns, refused(by, nis))
        self.off = north + share * (by[0] - north), east + share * (by[1] - east)

    def exclude(self, since_ns: int, reason: str, *, jumped: bool) -> None:
        """It is left out from an instant on; `jumped`: for itself, and not for the motion."""
        self.excluded, self.refused_ns, self.jumped = reason, since_ns, jumped
        self.passes, self.ran, self.slip = 0, False, self.slip.without_lately()
        self.apart = None
        self.means.restart()

    def look(
        self,
        t_ns: int,
        passed: bool,
        whitened: tuple[float, ...],
        offset: Offset | None,
        own: float,
        probability: float,
    ) -> None:
        """An innovation while it is left out: what may bring it back. `own` of its variance is the
        filter's; means are tested with that `probability`."""
        if not passed:
            self.passes = 0
            self.means.restart()
            return
        if not self.passes:
            self.passing_ns, self.trend, self.rise_m = t_ns, NO_TREND, 0.0
        self.passes += 1
        self.rise_m += self.above_m
        if whitened:
            self.means.add(whitened)
        if offset is not None:
            self.trend = self.trend.with_one(offset, (t_ns - self.passing_ns) * 1e-9)
            self.ran = self.ran or self.trend.runs_away
        means, degrees = self.means, self.means.degrees
        if (
            self.passes >= READMIT_COUNT
            and t_ns - self.passing_ns >= READMIT_NS
            and (offset is None or self.steady)
            and not (degrees and means.biased(t_ns, gate_threshold(probability, degrees), own))
        ):
            self.excluded, self.fused_ns, self.back_ns = "", t_ns, t_ns
            self.refused, self.jumped, self.proof = 0, False, None
            self.means.restart()

    @property
    def quiet(self) -> bool:
        """Whether it is believed, and nothing is open of it."""
        return not (self.excluded or self.refused or self.proof or self.punctual or self.moved)

    @property
    def drifted(self) -> bool:
        """While excluded: whether it was for a drift that may be as slow as any."""
        return self.excluded == DRIFTS and not self.ran

    @property
    def least_trend_sd(self) -> float:
        """How well (m/s) it must be known that it does not run away before it comes back."""
        return DRIFT_SD_M_S if self.drifted else TREND_SD_M_S

    @property
    def steady(self) -> bool:
        """While excluded: whether it is known not to run away any more. What was left out because
        it drifted may drift still, as slowly as a drift is told."""
        slowest = SLOWEST_M_S if self.drifted else math.inf
        return self.trend.steady(self.least_trend_sd, slowest)

    def repeats_itself(self, value: tuple[float, ...], moving: bool) -> bool:
        """Whether a new value, of a vehicle that may be `moving`, makes so many alike to the bit
        that it is no measurement."""
        alike = value == self.value
        same = moving and alike
        self.value, self.alike = value, self.alike + 1 if alike else 0
        self.repeats = self.repeats + 1 if same else 0
        if self.locates:
            return self.repeats >= REPEATED
        if same and self.repeats >= self._most_repeats():
            return True
        if moving:
            self.repeating += (same - self.repeating) / REPEATS_KEPT
        return False

    @property
    def may_repeat(self) -> bool:
        """Of a speed, which is printed coarsely: whether one more of the same is no fault."""
        return self.repeats + 1 < self._most_repeats()

    def _most_repeats(self) -> float:
        return math.log(CHANCE) / math.log(min(max(self.repeating, 0.01), 1.0 - 1e-12))

    @property
    def returning(self) -> bool:
        """While excluded: whether it passes, and cannot be known to run away or not as yet."""
        slope, sd = self.trend.slope
        return self.passes > 0 and sd > self.least_trend_sd and slope <= 3.0 * sd

    @property
    def believed(self) -> bool:
        """Whether its last innovation was fused."""
        return not (self.refused or self.excluded)


_FIELDS = attrgetter(*Series.__slots__)


Said = tuple[PositionOffer | None, VelocityOffer | None, tuple[float, ...] | None]
"""What an aid says of position and velocity, and what a sensor that hangs repeats to the bit."""


def said(offers: Sequence[Offer]) -> Said:
    """Of an aid, by what it offers."""
    position = velocity = value = None
    for offer in offers:
        said: tuple[float, ...] | None = None
        if isinstance(offer, PositionOffer):
            position, said = offer, (offer.lat_rad, offer.lon_rad)
        elif isinstance(offer, VelocityOffer):
            velocity, said = offer, offer.v_ned
        elif isinstance(offer, SpeedOffer):
            said = (offer.speed_m_s,)
        if value is None:
            value = said
    return position, velocity, value


def parts_by(velocity: VelocityOffer, north: float, east: float) -> tuple[float, float]:
    """What a measured velocity and the filter's differ by, north and east (m/s); a lever arm that
    turns is left to the sigma."""
    return velocity.v_ned[0] - north, velocity.v_ned[1] - east
