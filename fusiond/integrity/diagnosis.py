r"""Diagnosis: which hypothesis is identified, and what follows for the filter and its sources.

A hypothesis is identified where

    log odds > DECIDED for a second                 the probability that it is false, 1 in 1,000
    what it leaves unexplained is no more than chance leaves
    log odds - those of every other class > APART   nobody else explains it nearly as well

A fault that is a step of states (the inertial unit's, a clock's) is taken out of the state, V b
with the covariance V M V^T, and navigation goes on. One of a source is taken out likewise, from its
onset on, and the series that it spoils leave service (fusiond.integrity.service). Hypotheses of one
class and device that are nearly as likely are taken together, by the moments of their mixture:
kinds as well as onsets. Where two classes explain it nobody is accused, and what is published
covers both.

Where positions and velocities of a device fit each other and both are out, it is the filter that is
wrong, by more than any hypothesis says: after `FITS_NS` where nothing has explained why they are
out, after `FITS_AGAINST_NS` against a hypothesis that has.

Source: as of fusiond.estimators.fault_odds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.estimators.base import Estimator, Outcome, gate_threshold
from fusiond.estimators.fault_bank import (
    CARRIED,
    DECIDED,
    POSITION,
    POSITION_RAMP,
    RESTARTS,
    VELOCITY,
    VELOCITY_RAMP,
)
from fusiond.estimators.fault_odds import APART, BEST, BEST_ODDS, EXPLAINS, identified
from fusiond.estimators.hypotheses import Estimated, Hypotheses
from fusiond.integrity.agreement import Agreement
from fusiond.integrity.catalogue import Kind
from fusiond.integrity.service import DISAGREES, REPEATS, Series, value_of
from fusiond.navigation.strapdown import STEP_RESTS_S, VE, VN

Array = NDArray[np.float64]

ALIKE = 7.0
"""Hypotheses of the class that are less likely by more than this count nothing."""
GROWS: dict[int, tuple[int | None, int | None]] = {
    POSITION: (0, None),
    POSITION_RAMP: (1, None),
    VELOCITY: (None, 0),
    VELOCITY_RAMP: (None, 1),
    CARRIED: (1, 0),
}
"""With which power of its age a fault grows in positions and in velocities."""
MOVES_SIGMAS, MOVES_M_S = 5.0, 0.5
"""A vehicle moves whose speed is beyond both."""
FITS_NS, FITS_AGAINST_NS = 5_000_000_000, 60_000_000_000
"""Five fixes of a receiver that sends each second; a minute is what a vehicle's MEMS unit keeps to
within a hundred metres."""


class Finding(NamedTuple):
    """An identified hypothesis: its kind, when (ns) it was, and since when (s); its size and one
    sigma of each number in the kind's unit; log odds."""

    kind: Kind
    t_ns: int
    since_s: float
    size: tuple[float, ...]
    sd: tuple[float, ...]
    log_odds: float

    @property
    def largest(self) -> int:
        """Which number is most."""
        return max(range(len(self.size)), key=lambda i: abs(self.size[i]))

    @property
    def text(self) -> str:
        """For people."""
        k, row = self.kind, self.largest
        axis = f", {k.axes[row]}" if k.axes[row] else ""
        amount = f"{self.size[row]:.3g} {k.unit}, {self.sd[row]:.2g} at one sigma{axis}"
        done = "corrected" if k.corrected else "left out"
        return f"{k.text} by {amount}, since {self.t_ns * 1e-9 - self.since_s:.0f} s: {done}"


class Correction(NamedTuple):
    """What to take out of the error state, mean (n,), and its covariance (n, n)."""

    mean: Array
    spread: Array


class Memory(NamedTuple):
    """All that a later restore needs."""

    series: dict[str, Series]
    findings: tuple[Finding, ...]
    agreement: Mapping[str, Agreement]
    lasting: Mapping[str, Finding]


class Diagnosis:
    """Judges each aid once it has been looked at; a function of the aids in order alone."""

    def __init__(self, kinds: Sequence[Kind] = ()) -> None:
        self._kinds = tuple(kinds)
        self._series: dict[str, Series] = {}
        self._shared: set[str] = set()
        """Series that a checkpoint has too: copied before they are changed."""
        self._agreement: Mapping[str, Agreement] = {}
        """By device that is out; replaced, never changed."""
        self._lasting: Mapping[str, Finding] = {}
        """By series, why it left service last; replaced, never changed."""
        self.findings: tuple[Finding, ...] = ()
        """What has been identified since the start, the last of each kind and device."""

    def snapshot(self) -> Memory:
        """A copy of everything."""
        self._shared = set(self._series)
        return Memory(self._series.copy(), self.findings, self._agreement, self._lasting)

    def restore(self, memory: Memory) -> None:
        """Back to a snapshot."""
        self._series, self.findings = memory.series.copy(), memory.findings
        self._shared, self._agreement = set(self._series), memory.agreement
        self._lasting = memory.lasting

    def reset(self) -> None:
        """The filter starts anew."""
        self._series, self._shared, self.findings = {}, set(), ()
        self._agreement, self._lasting = {}, {}

    # ------------------------------------------------------------------ what others ask

    @property
    def series(self) -> Mapping[str, Series]:
        """By source, as they are; not to be changed."""
        return self._series

    @property
    def excluded(self) -> dict[str, str]:
        """Series that are out, and why."""
        return {name: s.reason for name, s in self._series.items() if s.out}

    @property
    def positions_out(self) -> bool:
        """Whether there are positions, and none is in service."""
        positions = [s for s in self._series.values() if s.locates]
        return bool(positions) and all(s.out for s in positions)

    @property
    def contradicts(self) -> str | None:
        """The device whose positions and velocities fit each other and not the filter; None where
        there is none."""
        if not self.positions_out:
            return None
        for device, agreement in self._agreement.items():
            out = [s for s in self._series.values() if s.device == device and s.out]
            unexplained = all(s.reason == DISAGREES for s in out)
            if agreement.lasted_ns > (FITS_NS if unexplained else FITS_AGAINST_NS):
                return device
        return None

    # ------------------------------------------------------------------ judgement

    def own(self, aid: Aid) -> Series:
        """The series of an aid, which may be changed."""
        one = self._series.get(aid.source)
        if one is not None and aid.source not in self._shared:
            return one
        self._shared.discard(aid.source)
        one = self._series[aid.source] = Series.of(aid) if one is None else one.copied()
        return one

    def comes(self, aid: Aid, estimator: Estimator) -> Series:
        """The series of an aid, before it is folded in; one that repeats itself leaves service,
        with all of its device."""
        one = self.own(aid)
        one.hear(aid.t_ns)
        if aid.constraint or (value := value_of(aid.offers())) is None:
            return one
        # A position that differs repeats nothing, whether it moves or not.
        moving = (value == one.value or not one.locates) and _moves(estimator)
        if one.repeats_itself(value, moving) and not one.out:
            self._exclude(aid.t_ns, REPEATS, lambda s: s.device == aid.device)
        return self._series[aid.source]

    def judge(
        self, aid: Aid, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Take in how an aid ended; what to take out of the filter's state, if anything."""
        e, t_ns, correction, explained = estimator, aid.t_ns, None, False
        bank, measured, used = e.hypotheses, not aid.constraint, not one.out
        if bank is not None:
            found = bank.take(t_ns, measured, used, e.xi, e.step, e.wider)
            if measured and used:
                if identified(found):
                    correction = self._decide(t_ns, bank, found)
                explained = found.item(EXPLAINS) > DECIDED - APART
                one = self._series[aid.source]
        if not used:
            passes = outcome.nis <= gate_threshold(aid.gate, max(outcome.degrees, 1))
            one.looked_at(t_ns, passes and one.repeats == 0, outcome.lasting - outcome.nis)
            self._agrees(aid, one)
        elif outcome.name == "fused":
            one.fused(t_ns, () if aid.constraint else outcome.whitened)
        elif outcome.name == "gated" and not one.out and (not aid.constraint or aid.no_slip):
            one.gated(t_ns, explained)
        return correction

    def _decide(self, t_ns: int, bank: Hypotheses, found: Array) -> Correction:
        """What is identified."""
        best, odds = found.item(BEST), found.item(BEST_ODDS)
        taken = self._alike(bank, self._kinds[int(best) // RESTARTS], odds)
        weights = np.exp([each.log_odds - odds for each in taken])
        weights /= weights.sum()
        mean, spread = np.zeros(bank.n), np.zeros((bank.n, bank.n))
        for w, each in zip(weights, taken, strict=True):
            mean += w * each.mean
        for w, each in zip(weights, taken, strict=True):
            apart = each.mean - mean
            spread += w * (each.spread + np.outer(apart, apart))
        told = max(taken, key=lambda each: each.log_odds)
        kind = self._kinds[told.kind]
        per = kind.per_unit * (kind.lag_s or 1.0)
        size = tuple((told.size * per).tolist())
        sd = tuple((np.sqrt(np.diagonal(told.covariance)) * per).tolist())
        finding = Finding(kind, t_ns, told.onset_s, size, sd, told.log_odds)
        others = [f for f in self.findings if f.kind.text != kind.text]
        self.findings = (*others, finding)
        if not kind.corrected:
            self._exclude(t_ns, finding.text, lambda s: kind.spoils(s.device, s.locates, s.moves))
            out = [n for n, s in self._series.items() if s.out and s.reason == finding.text]
            self._lasting = {**self._lasting, **dict.fromkeys(out, finding)}
        return Correction(mean, spread)

    def lasting(self, aid: Aid, one: Series) -> Array | None:
        """What the fault for which a series is out adds to its innovation (3,), if it lasts; None
        where none is known."""
        finding = self._lasting.get(one.source)
        if finding is None:
            return None
        kind, b = finding.kind, np.array(finding.size) / finding.kind.per_unit
        age_s = aid.t_ns * 1e-9 - finding.since_s
        if len(b) != 3 or kind.signature not in GROWS:
            return None
        grows = GROWS[kind.signature][0 if one.locates else 1]
        return None if grows is None else -b * age_s**grows

    def _alike(self, bank: Hypotheses, kind: Kind, odds: float) -> list[Estimated]:
        """Those of the class and device of a kind that explain it nearly as well."""
        explains, log_odds = bank.explains, bank.log_odds
        return [
            bank.estimated(RESTARTS * row + restart)
            for row, each in enumerate(self._kinds)
            if each.of == kind.of and each.device == kind.device
            for restart in range(RESTARTS)
            if explains[row, restart] and log_odds[row, restart] > odds - ALIKE
        ]

    def _exclude(self, t_ns: int, reason: str, spoiled: Callable[[Series], bool]) -> None:
        """What is spoiled leaves service."""
        for name in [n for n, s in self._series.items() if not s.out and spoiled(s)]:
            if name in self._shared:
                self._shared.discard(name)
                self._series[name] = self._series[name].copied()
            self._series[name].exclude(t_ns, reason)

    def _agrees(self, aid: Aid, one: Series) -> None:
        """One that is out has come: does its device fit itself?"""
        if not (one.locates or one.moves) or aid.screened:
            return
        known = self._agreement.get(aid.device, Agreement())
        self._agreement = {**self._agreement, aid.device: known.with_aid(aid)}


def _moves(estimator: Estimator) -> bool:
    """Whether the vehicle surely moves, by the filter's own speed and its sigma."""
    if estimator.step.item(STEP_RESTS_S) > 0.0:
        return False
    nav = estimator.nav
    speed = math.hypot(nav.item(VN), nav.item(VE))
    if speed <= MOVES_M_S:
        return False
    return speed > MOVES_SIGMAS * estimator.speed_sigma()
