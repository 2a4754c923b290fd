r"""Diagnosis: which hypothesis is identified, and what follows for the filter and its sources.

A hypothesis is identified where

    log odds > DECIDED                              the probability that it is false, 1 in 1,000
    what it leaves unexplained is no more than chance leaves
    log odds - those of every other class > APART   nobody else explains it nearly as well

A fault of the inertial unit is taken out of the state, V b with the covariance V M V^T, and
navigation goes on. One of a source is taken out likewise, from its onset on, and the series that it
spoils leave service (fusiond.integrity.service). Kinds of one class that are nearly as likely are
taken together, by the moments of their mixture. Where two classes explain it nobody is accused, and
what is published covers both.

Source: as of fusiond.estimators.fault_odds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid
from fusiond.estimators.base import Estimator, Outcome, gate_threshold
from fusiond.estimators.fault_bank import DECIDED, RESTARTS
from fusiond.estimators.fault_odds import BEST, BEST_ODDS, RIVAL_ODDS, SENSOR_ODDS
from fusiond.estimators.hypotheses import Hypotheses
from fusiond.integrity.catalogue import OWN, Kind
from fusiond.integrity.service import Series, value_of
from fusiond.navigation.strapdown import STEP_RESTS_S, VE, VN

Array = NDArray[np.float64]

APART = 4.0
"""Log odds between two classes: fifty to one."""
ALIKE = 7.0
"""Kinds of the class that are less likely by more than this count nothing."""
MOVES_SIGMAS, MOVES_M_S = 5.0, 0.5
"""A vehicle moves whose speed is beyond both."""


class Finding(NamedTuple):
    """An identified hypothesis: its kind, when (ns) it was, and since when; its size and one sigma
    of each number in the kind's unit; log odds."""

    kind: Kind
    t_ns: int
    since_s: float
    size: tuple[float, ...]
    sd: tuple[float, ...]
    log_odds: float

    @property
    def text(self) -> str:
        """For people."""
        k = self.kind
        largest = max(range(len(self.size)), key=lambda i: abs(self.size[i]))
        axis = f", {k.axes[largest]}" if k.axes[largest] else ""
        amount = f"{self.size[largest]:.3g} {k.unit}, {self.sd[largest]:.2g} at one sigma{axis}"
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


class Diagnosis:
    """Judges each aid once it has been looked at; a function of the aids in order alone."""

    def __init__(self, kinds: Sequence[Kind] = ()) -> None:
        self._kinds = tuple(kinds)
        self._series: dict[str, Series] = {}
        self._shared: set[str] = set()
        """Series that a checkpoint has too: copied before they are changed."""
        self.findings: tuple[Finding, ...] = ()
        """What has been identified since the start, the last of each kind."""

    def snapshot(self) -> Memory:
        """A copy of everything."""
        self._shared = set(self._series)
        return Memory(self._series.copy(), self.findings)

    def restore(self, memory: Memory) -> None:
        """Back to a snapshot."""
        self._series, self.findings = memory.series.copy(), memory.findings
        self._shared = set(self._series)

    def reset(self) -> None:
        """The filter starts anew."""
        self._series, self._shared, self.findings = {}, set(), ()

    @property
    def series(self) -> dict[str, Series]:
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
        """The device whose positions and velocities agree with each other and not with the filter;
        None where there is none."""
        return None

    def own(self, aid: Aid) -> Series:
        """The series of an aid that is about to be judged."""
        one = self._series.get(aid.source)
        if one is None:
            one = Series.of(aid)
        elif aid.source in self._shared:
            one = one.copied()
        else:
            return one
        self._shared.discard(aid.source)
        self._series[aid.source] = one
        return one

    def comes(self, aid: Aid, estimator: Estimator) -> Series:
        """The series of an aid, before it is folded in; one that repeats itself leaves service."""
        one = self.own(aid)
        one.hear(aid.t_ns)
        if not aid.constraint and (value := value_of(aid.offers())) is not None:
            if one.repeats_itself(value, _moves(estimator)) and not one.out:
                self._exclude(aid.device, aid.t_ns, "repeats itself", lambda s: True)
        return one

    def judge(
        self, aid: Aid, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Take in how an aid ended; what to take out of the filter's state, if anything."""
        bank = estimator.hypotheses
        found, t_ns = None, aid.t_ns
        if bank is not None and not (one.out or aid.constraint):
            found = bank.judge(t_ns)
        if one.out:
            passes = outcome.nis <= gate_threshold(aid.gate, max(outcome.degrees, 1))
            one.looked_at(t_ns, passes and one.repeats == 0)
            if bank is not None:
                self._publish(bank, estimator)
            return None
        correction = None
        if found is not None and bank is not None:
            correction = self._decide(t_ns, bank, found)
        if outcome.name == "fused":
            one.fused(t_ns, () if aid.constraint else outcome.whitened)
        elif outcome.name == "gated" and not one.out and (not aid.constraint or aid.no_slip):
            explained = found is not None and found.item(SENSOR_ODDS) > DECIDED - APART
            one.gated(t_ns, explained)
        if correction is None and bank is not None:
            self._publish(bank, estimator)
        return correction

    def _decide(self, t_ns: int, bank: Hypotheses, found: Array) -> Correction | None:
        best, odds, rival = found.item(BEST), found.item(BEST_ODDS), found.item(RIVAL_ODDS)
        if not (odds > DECIDED and odds - rival > APART):
            return None
        kind = self._kinds[int(best) // RESTARTS]
        alike = [
            row
            for row, each in enumerate(self._kinds)
            if each.of == kind.of and each.device == kind.device
        ]
        taken, explains, log_odds = [], bank.explains, bank.log_odds
        for row in alike:
            for restart in range(RESTARTS):
                if explains[row, restart] and log_odds[row, restart] > odds - ALIKE:
                    taken.append(bank.estimated(RESTARTS * row + restart))
        weights = np.exp([each.log_odds - odds for each in taken])
        weights /= weights.sum()
        mean = sum(w * each.mean for w, each in zip(weights, taken, strict=True))
        spread = np.zeros((bank.n, bank.n))
        for w, each in zip(weights, taken, strict=True):
            apart = each.mean - mean
            spread += w * (each.spread + np.outer(apart, apart))
        told = max(taken, key=lambda each: each.log_odds)
        kind = self._kinds[told.kind]
        per = kind.per_unit * (kind.lag_s or 1.0)
        sd = np.sqrt(np.diagonal(told.covariance)) * per
        size = tuple((told.size * per).tolist())
        finding = Finding(kind, t_ns, told.onset_s, size, tuple(sd.tolist()), told.log_odds)
        others = [f for f in self.findings if f.kind.text != kind.text]
        self.findings = (*others, finding)
        if not kind.corrected:
            self._exclude(kind.device, t_ns, finding.text, lambda s: _spoils(kind, s))
        return Correction(np.asarray(mean), spread)

    def _exclude(self, device, t_ns, reason, spoiled) -> None:
        for name in list(self._series):
            s = self._series[name]
            if s.device == device and spoiled(s) and not s.out:
                if name in self._shared:
                    self._shared.discard(name)
                    s = self._series[name] = s.copied()
                s.exclude(t_ns, reason)

    def _publish(self, bank: Hypotheses, estimator: Estimator) -> None:
        """What is published is as wide as the mixture."""
        opened = bank.opened()
        wider = estimator.wider
        nav = estimator.nav
        for i in range(3):
            wider[i], wider[3 + i] = opened[6 + i, 6 + i], opened[3 + i, 3 + i]
        w, x, y, z = nav[6:10].tolist()
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        c, s = math.cos(yaw), math.sin(yaw)
        a, b, d = opened[0, 0], opened[1, 1], opened[0, 1]
        wider[6] = c * c * a + s * s * b + 2.0 * c * s * d
        wider[7] = s * s * a + c * c * b - 2.0 * c * s * d
        wider[8] = opened[2, 2]


def _spoils(kind: Kind, one: Series) -> bool:
    if kind.of == OWN:
        return True
    return (kind.locates and one.locates) or (kind.moves and one.moves)


def _moves(estimator: Estimator) -> bool:
    """Whether the vehicle surely moves, by the filter's own speed and its sigma."""
    if estimator.step.item(STEP_RESTS_S) > 0.0:
        return False
    nav, sd = estimator.nav, estimator.sigmas()
    speed = math.hypot(nav.item(VN), nav.item(VE))
    return speed > max(MOVES_M_S, MOVES_SIGMAS * math.hypot(sd.item(3), sd.item(4)))
