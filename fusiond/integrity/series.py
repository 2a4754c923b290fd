"""What is known of one series of innovations.

A series is what one source says of one thing; fusiond.integrity.isolation judges it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

from fusiond.integrity.proof import (
    DRIFT_SD_M_S,
    NO_TREND,
    TREND_SD_M_S,
    Proof,
    Trend,
)

DRIFTS = "drifts"
# Paces of the mean: some 11 and some 59 innovations deep, (2 - a) / a.
PACES = (1.0 / 6.0, 1.0 / 30.0)
# The variance of a mean at each pace, for white innovations of variance one; and what is assumed of
# a series before it has shown its own: successive innovations share a fifth of their variance.
WHITE = tuple(a / (2.0 - a) for a in PACES)
ASSUMED = tuple(white + 0.2 for white in WHITE)
# The variance that a series' means show by themselves is averaged over so many innovations: errors
# that last (orbits, slip of a tyre) are ordinary, and a fault is what stands out of them. What is
# assumed at first weighs as much as half the time that the slow mean looks back.
LEARN_COUNT, ASSUMED_COUNT = 300, 15
# What the means show lately may be the beginning of a fault: it counts once a period as long as it
# has gone by without one. A drift of 0.1 m/s is found within twice this; longer ones hide nothing.
LEARN_NS = 15_000_000_000
# Position repeated to the bit so often while the vehicle moves: receivers print metres to the
# centimetre or finer, so that two alike are chance, three are not.
REPEATED = 2
# Speeds are printed coarser: so rare a run of equal ones is none, by the probability that one
# repeats the one before, as this series has shown it (average of so many).
CHANCE, REPEATS_KEPT = 1e-9, 100.0
# Before any instant that a clock can say.
NEVER_NS = -(2**62)


class Shown(NamedTuple):
    """Sums of the means' squares, by degree of freedom, over so many innovations since an
    instant."""

    since_ns: int
    fast: float = 0.0
    slow: float = 0.0
    n: int = 0


NOTHING_SHOWN = Shown(NEVER_NS)


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
    sd_m_s: float = 0.0
    """Of a velocity, horizontally."""
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
    ran: bool = False
    """While excluded: it was seen to run away, faster than any slow drift."""
    count: int = 0
    fast: tuple[float, ...] = ()
    slow: tuple[float, ...] = ()
    fast_spread: float = ASSUMED[0]
    slow_spread: float = ASSUMED[1]
    learned: int = 0
    """Innovations that the spreads have been learned from."""
    shown: Shown = NOTHING_SHOWN
    """What the means show now, and `waiting` what they did in the period before."""
    waiting: Shown = NOTHING_SHOWN
    value: tuple[float, ...] | None = None
    repeats: int = 0
    repeating: float = 1.0
    """Probability that a value repeats the one before it, as shown so far in motion."""
    proof: Proof | None = None
    """Of a position that came back after an outage: what is seen of it until it is proven."""

    def copied(self) -> Series:
        """A copy for a checkpoint."""
        return Series(*_FIELDS(self))

    def learn(self, t_ns: int, fast: float, slow: float) -> None:
        """Take in the means' squares, by degree of freedom, at an instant."""
        if t_ns - self.shown.since_ns >= LEARN_NS:
            self._believe(self.waiting)
            self.waiting, self.shown = self.shown, Shown(t_ns)
        since_ns, fast_sum, slow_sum, n = self.shown
        fast_sum += max(fast, WHITE[0])
        slow_sum += max(slow, WHITE[1])
        self.shown = Shown(since_ns, fast_sum, slow_sum, n + 1)

    def _believe(self, shown: Shown) -> None:
        """No fault has followed it."""
        if not shown.n:
            return
        share = min(1.0, shown.n / min(ASSUMED_COUNT + self.learned + shown.n, LEARN_COUNT))
        self.fast_spread += share * (shown.fast / shown.n - self.fast_spread)
        self.slow_spread += share * (shown.slow / shown.n - self.slow_spread)
        self.learned = min(self.learned + shown.n, LEARN_COUNT)

    @property
    def least_trend_sd(self) -> float:
        """How well (m/s) it must be known that it does not run away before it comes back."""
        return DRIFT_SD_M_S if self.excluded == DRIFTS and not self.ran else TREND_SD_M_S

    @property
    def colour(self) -> float:
        """By how much (1) the sigma of a mean over many errors is more than if they were white, as
        the series has shown."""
        return math.sqrt(max(1.0, self.slow_spread / WHITE[1]))

    def forget_shown(self) -> None:
        """A fault has followed what the means have shown lately."""
        self.shown = self.waiting = NOTHING_SHOWN

    def repeats_itself(self, value: tuple[float, ...], moving: bool) -> bool:
        """Whether a new value, of a vehicle that may be `moving`, makes so many alike to the bit
        that it is no measurement."""
        same = moving and value == self.value
        self.value, self.repeats = value, self.repeats + 1 if same else 0
        if self.locates:
            return self.repeats >= REPEATED
        if same and self.repeats >= self._most_repeats():
            return True
        if moving:
            self.repeating += (same - self.repeating) / REPEATS_KEPT
        return False

    def _most_repeats(self) -> float:
        return math.log(CHANCE) / math.log(min(max(self.repeating, 0.01), 1.0 - 1e-12))

    @property
    def believed(self) -> bool:
        """Whether its last innovation was fused."""
        return not (self.refused or self.excluded)


_FIELDS = attrgetter(*Series.__slots__)
