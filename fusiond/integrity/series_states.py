r"""Service of measurement series: one table of states, with named transitions.

A series is all measurements of one kind from one source (`gnss`, `gnss_velocity`).

    nominal      its measurements are fused
    suspected    the last one failed its gate
    out          they are compared with the published solution, not fused
    probation    fused again after an exclusion

    from                  to           when
    nominal               suspected    `gate`: a measurement fails
    suspected             nominal      one passes
    suspected             out          the third in a row fails, and no fault of the inertial unit
                                       explains it
    probation             out          a measurement fails: the fault is back
    any in service        out          a hypothesis that spoils it is `identified`; or it `repeats`
                                       itself bit for bit while the vehicle moves
    out                   probation    `READMIT_COUNT` in a row pass against the published solution,
                                       and the excluding fault is likelier over than not, by the
                                       innovations of all series that it has spoiled; a series that
                                       repeated itself has a new value each time
    probation             nominal      it has been in service for as long as it was out

Three failures of a gate of 0.9999 in a row have a probability of 1e-12; five passes while a fault
of four sigma lasts, one in a thousand. Time alone re-admits no series.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import (
    Candidate,
    PositionCandidate,
    SpeedCandidate,
    VelocityCandidate,
)
from fusiond.estimators.noise_scale import forget_lately, learn, unlearned
from fusiond.integrity.position_velocity_agreement import Agreement

Array = NDArray[np.float64]

REFUSED_IN_A_ROW, READMIT_COUNT = 3, 5
LASTS_S, RETURNS, MOST_EVIDENCE, MOST_SURE = 60.0, 2.0, 12.0, 24.0
"""A fault's mean duration, an engineer's; log odds of its end at which it is believed again, seven
to one; the most (chi-square) that one measurement tells of that; and the most (log likelihood) that
one series does, four such measurements."""
REPEATS, DISAGREES, STILL = "repeats itself", "disagrees", "disagrees though its fault is over"
# Position repeated to the bit so often while the vehicle moves: receivers print metres to the
# centimetre or finer, so that two alike are chance, three are not. Chance of that kind is the fix
# before once more, of a receiver that says what it has oftener than it has something: no
# measurement of its instant.
REPEATED = 2
# Speeds and velocities are printed coarser: so rare a run of equal ones is none, by the probability
# that one repeats the one before, as this series has shown it (average of so many).
CHANCE, REPEATS_KEPT = 1e-9, 100.0
# What has not been heard of for so long (ns) is judged anew.
FORGET_NS = 10_000_000_000


class Service(enum.StrEnum):
    """States of a series."""

    NOMINAL = "nominal"
    SUSPECTED = "suspected"
    OUT = "out"
    PROBATION = "probation"


@dataclass(slots=True)
class Series:
    """Service of one series: state and its start, reason of exclusion, failures and passes in a
    row."""

    source: str
    device: str
    locates: bool
    moves: bool
    state: Service = Service.NOMINAL
    out: bool = False
    """True if the series is excluded: compared, not fused."""
    since_ns: int = 0
    received_ns: int = 0
    reason: str = ""
    failed: int = 0
    passed: int = 0
    out_ns: int = 0
    """Instant (ns) of its last exclusion."""
    proven_ns: int = 0
    """End of probation (ns), which is as long as the exclusion was."""
    over: float = 0.0
    """Log likelihood ratio that the excluding fault is over rather than lasting."""
    sure: float = math.inf
    """Log odds that it is over, at the last comparison."""
    value: object = None
    repeats: int = 0
    """So many values in a row, of a vehicle that moves, were that before them, to the bit."""
    unchanged: bool = False
    """True if the last value repeated the one before it, to the bit."""
    noise: Array = field(default_factory=unlearned)
    repeating: float = 1.0
    """Probability that a value repeats the one before it, as observed in motion."""
    shares: bool = False
    """True for positions with a shared error that the filter estimates."""

    @staticmethod
    def of(measurement: AidingMeasurement) -> Series:
        """New series, for its first measurement."""
        return Series(
            measurement.source,
            measurement.device,
            measurement.locates,
            measurement.moves,
            since_ns=measurement.t_ns,
            shares=any(getattr(each, "bias", ()) for each in measurement.candidates()),
        )

    def copied(self) -> Series:
        """A copy for a checkpoint."""
        other = Series(*_EACH(self))
        other.noise = self.noise.copy()
        return other

    def received(self, t_ns: int) -> None:
        """Record an arrival."""
        if t_ns - self.received_ns > FORGET_NS:
            self.failed = self.passed = self.repeats = 0
            if self.state is Service.SUSPECTED:
                self.state, self.since_ns = Service.NOMINAL, t_ns
        self.received_ns = t_ns

    def exclude(self, t_ns: int, reason: str) -> None:
        """Exclude the series."""
        self.state, self.since_ns, self.reason, self.out_ns = Service.OUT, t_ns, reason, t_ns
        self.out = True
        forget_lately(self.noise)
        self.failed = self.passed = 0
        self.sure = math.inf
        self.over = 0.0  # what was shown of an earlier fault's end says nothing of this one's

    def gated(self, t_ns: int, explained: bool) -> None:
        """Record a gate failure of a series in service; `explained`: by a fault of the inertial
        unit."""
        self.failed += 1
        again = self.state is Service.PROBATION
        if again:  # what was wrong comes again, so it is known why
            self.exclude(t_ns, self.reason)
        elif self.failed >= REFUSED_IN_A_ROW and not explained:
            self.exclude(t_ns, DISAGREES)
        elif self.state is not Service.SUSPECTED:
            self.state, self.since_ns = Service.SUSPECTED, t_ns

    def fused(self, t_ns: int, whitened: tuple[float, ...]) -> None:
        """Record a pass of the gate with the whitened innovation."""
        rows = len(whitened)
        if 0 < rows <= 3:
            y0, y1, y2 = (*whitened, 0.0, 0.0)[:3]
            learn(self.noise, t_ns * 1e-9, y0, y1, y2, rows)
        self.failed = 0
        if t_ns > self.proven_ns and self.state is not Service.NOMINAL:
            self.state, self.since_ns, self.reason = Service.NOMINAL, t_ns, ""

    def looked_at(
        self,
        t_ns: int,
        passes: bool,
        lasting: float = math.nan,
        others: float = 0.0,
        limit: float = math.inf,
    ) -> None:
        """Compare a measurement of an excluded series with the published solution. `lasting`:
        increase of the innovation's chi-square if the excluding fault lasts; NaN if unknown.
        `others`: log likelihood that the fault is over, by its other series. `limit`: chi-square of
        the fault in innovations without noise.

        A fault is over with prior probability 1 - exp(-t / `LASTS_S`), which the innovations
        update. The solution's own error is common to all innovations of a series that is not fused:
        many of them are no more evidence than `limit`.
        """
        if self.unchanged and self.reason == REPEATS:
            passes = False
        self.passed = self.passed + 1 if passes else 0
        if math.isfinite(lasting):
            self.over += 0.5 * max(-MOST_EVIDENCE, min(lasting, MOST_EVIDENCE))
            self.over = max(
                -min(MOST_EVIDENCE, 0.5 * limit), min(self.over, MOST_SURE, 0.5 * limit)
            )
            prior = math.log(math.expm1(max(t_ns - self.since_ns, 1) * 1e-9 / LASTS_S))
            self.sure = self.over + others + prior
            if self.sure < RETURNS:
                return
            if not passes:  # what was wrong is over, and it is not where the filter is
                self.reason = STILL
        if self.passed >= READMIT_COUNT:
            self.readmit(t_ns)

    def readmit(self, t_ns: int) -> None:
        """Return the series to service."""
        self.proven_ns = 2 * t_ns - self.out_ns
        self.state, self.out, self.since_ns = Service.PROBATION, False, t_ns
        self.failed = self.passed = 0

    @property
    def stale(self) -> bool:
        """True if the last position equals the one before."""
        return self.locates and self.repeats > 0

    def went_on(self, t_ns: int, value: object, moved: int) -> None:
        """Record several arrivals of a nominal series, the last at `t_ns`, without repeated values;
        `value` is None for a constraint. The vehicle moved at `moved` of them."""
        self.received_ns = t_ns
        if value is None:
            return
        self.value, self.repeats, self.unchanged = value, 0, False
        for _ in range(0 if self.locates else moved):
            self.repeating += -self.repeating / REPEATS_KEPT

    def repeats_itself(self, value: object, moving: bool) -> bool:
        """True if values repeat bit for bit too often for a `moving` vehicle. At rest values may
        repeat."""
        self.unchanged = value == self.value
        same = moving and self.unchanged
        self.value, self.repeats = value, self.repeats + 1 if same else 0
        if self.locates:
            return self.repeats >= REPEATED
        chance = min(max(self.repeating, 0.01), 1.0 - 1e-12)
        if moving and not same:
            self.repeating += -self.repeating / REPEATS_KEPT
        elif moving:
            self.repeating += (1.0 - self.repeating) / REPEATS_KEPT
        return same and self.repeats >= math.log(CHANCE) / math.log(chance)


_EACH = attrgetter(*(each.name for each in fields(Series)))


class ServiceTable:
    """Series of all sources by name, and the agreement of positions and velocities of each device
    that is or was excluded."""

    def __init__(self) -> None:
        self._series: dict[str, Series] = {}
        self._shared: set[str] = set()
        """Series that a checkpoint has too: copied before they are changed."""
        self._agreement: Mapping[str, Agreement] = {}
        """Agreement of each excluded device; replaced, never changed."""

    @property
    def series(self) -> Mapping[str, Series]:
        """Series by source; read-only."""
        return self._series

    @property
    def excluded(self) -> dict[str, str]:
        """Excluded series with the reason."""
        return {name: s.reason for name, s in self._series.items() if s.out}

    @property
    def positions_out(self) -> bool:
        """True if position series exist and none is in service."""
        positions = [s for s in self._series.values() if s.locates]
        return bool(positions) and all(s.out for s in positions)

    def own(self, measurement: AidingMeasurement) -> Series:
        """Series of a measurement, for a change."""
        one = self._series.get(measurement.source)
        if one is not None and measurement.source not in self._shared:
            return one
        self._shared.discard(measurement.source)
        one = self._series[measurement.source] = (
            Series.of(measurement) if one is None else one.copied()
        )
        return one

    def plain(self, measurement: AidingMeasurement) -> Series | None:
        """Series of a measurement that needs only gate and hypotheses: nominal, with no excluded
        series of its device; else None. The caller may change it."""
        one = self._series.get(measurement.source)
        if one is None or one.state is not Service.NOMINAL or one.failed:
            return None
        if one.device in self._agreement:
            return None
        return self.own(measurement) if measurement.source in self._shared else one

    def _changed(self, name: str) -> Series:
        """A series that may be changed."""
        if name in self._shared:
            self._shared.discard(name)
            self._series[name] = self._series[name].copied()
        return self._series[name]


def value_of(candidates: Sequence[Candidate]) -> tuple[float, ...] | None:
    """Values that a frozen sensor repeats to the bit."""
    for candidate in candidates:
        if isinstance(candidate, PositionCandidate):
            return candidate.lat_rad, candidate.lon_rad
        if isinstance(candidate, VelocityCandidate):
            return candidate.v_ned
        if isinstance(candidate, SpeedCandidate):
            return (candidate.speed_m_s,)
    return None
