r"""Diagnosis: the identified hypothesis, and its consequences for filter and sources.

A hypothesis is identified where

    log odds > DECIDED for a second                 the probability that it is false, 1 in 1,000
    the unexplained rest is no more than chance
    log odds and log likelihood - those of every other class > APART
                                                    no other class explains it nearly as well

A fault that is a step of states (of the inertial unit, of a clock) is removed from the state, V b
with the covariance V M V^T, and navigation continues. A source's fault is removed likewise, from
its onset on, and the affected series leave service (fusiond.integrity.series_states). Hypotheses of
one class and device with similar odds are combined by the moments of their mixture, kinds as well
as onsets, weighted by their fit alone: an estimated rate and size must not decide between them. If
two classes explain the evidence, no source is excluded, and the published covariance includes both.

If positions and velocities of a device agree with each other and both are excluded, the filter is
wrong by more than any hypothesis covers: after `FITS_NS` if no hypothesis explains the exclusion,
else after `FITS_AGAINST_NS`.

Source: as of fusiond.estimators.fault_odds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.estimators.base import Estimator, Outcome, gate_threshold
from fusiond.estimators.fault_bank import DECIDED, DELAY, POSITION, RESTARTS
from fusiond.estimators.fault_bank_interface import Estimated, Hypotheses
from fusiond.estimators.fault_odds import APART, BEST, EXPLAINS, identified
from fusiond.integrity.catalogue import MOTION, PLACE, Kind, changed_kind
from fusiond.integrity.correlated_fix_jumps import renewed_slots
from fusiond.integrity.fault_correction import Correction, mixed, somewhere_else
from fusiond.integrity.fault_findings import Finding, Lasting
from fusiond.integrity.position_velocity_agreement import LONGEST_NS, Agreement
from fusiond.integrity.series_states import (
    DISAGREES,
    FORGET_NS,
    MOST_SURE,
    READMIT_COUNT,
    REPEATS,
    RETURNS,
    STILL,
    Series,
    ServiceTable,
    value_of,
)

Array = NDArray[np.float64]

ALIKE = 7.0
"""Log likelihood difference beyond which another hypothesis of the class is ignored."""
FITS_NS, FITS_AGAINST_NS = 5_000_000_000, 60_000_000_000
"""Five fixes of a receiver that sends each second; a minute is what a vehicle's MEMS unit keeps to
within a hundred metres."""


class Memory(NamedTuple):
    """State for a later restore."""

    series: dict[str, Series]
    findings: tuple[Finding, ...]
    agreement: Mapping[str, Agreement]
    lasting: Mapping[str, Lasting]


class Diagnosis(ServiceTable):
    """Diagnosis after each measurement's innovation; a function of the measurements in their
    order."""

    def __init__(self, kinds: Sequence[Kind] = ()) -> None:
        super().__init__()
        self._kinds = tuple(kinds)
        self._lasting: Mapping[str, Lasting] = {}
        """Last reason of exclusion by series; replaced, never changed."""
        self.findings: tuple[Finding, ...] = ()
        """Identified faults since the start, the last of each kind and device."""

    def snapshot(self) -> Memory:
        """Copy of the state, for `restore`."""
        self._shared = set(self._series)
        return Memory(self._series.copy(), self.findings, self._agreement, self._lasting)

    def restore(self, memory: Memory) -> None:
        """Restore a snapshot."""
        self._series, self.findings = memory.series.copy(), memory.findings
        self._shared, self._agreement = set(self._series), memory.agreement
        self._lasting = memory.lasting

    def reset(self) -> None:
        """Restart with the filter."""
        self._series, self._shared, self.findings = {}, set(), ()
        self._agreement, self._lasting = {}, {}

    # ------------------------------------------------------------------ what others ask

    @property
    def contradicts(self) -> str | None:
        """Device whose positions and velocities agree with each other and contradict the filter;
        None without one. Velocities that agree with the filter's do not: only the place differs."""
        if not self.positions_out:
            return None
        for device, agreement in self._agreement.items():
            own = [s for s in self._series.values() if s.device == device]
            if not all(s.out for s in own) or _velocities_passed(own, 1):
                continue
            unexplained = all(s.reason in (DISAGREES, STILL) for s in own)
            if agreement.lasted_ns > (FITS_NS if unexplained else FITS_AGAINST_NS):
                return device
        return None

    # ------------------------------------------------------------------ judgement

    def comes(self, measurement: AidingMeasurement, estimator: Estimator) -> Series:
        """Series of a measurement, before its update. A series that repeats itself leaves service,
        with all series of its device."""
        # By its class: one that stands for another has its own offers.
        one, shown = self._series.get(measurement.source), getattr(type(measurement), "shown", None)
        if one is None or measurement.source in self._shared:
            one = self.own(measurement)
        if measurement.t_ns - one.received_ns > FORGET_NS:
            one.received(measurement.t_ns)
        one.received_ns = measurement.t_ns
        if measurement.constraint:
            if estimator.hypotheses is not None:  # it is no evidence of what waits to be judged
                estimator.hypotheses.conclude()
            return one
        value = value_of(measurement.candidates()) if shown is None else shown(measurement)
        if value is None:
            return one
        # A position that differs repeats nothing, whether it moves or not. How often others do in
        # motion is counted by the filter's own sigma.
        same = value == one.value
        moving = (same or not one.locates) and estimator.surely_moves(published=same)
        if one.repeats_itself(value, moving) and not one.out:
            self._exclude(measurement.t_ns, REPEATS, lambda s: s.device == measurement.device)
            one = self._series[measurement.source]
        return one

    def judge(
        self, measurement: AidingMeasurement, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Process the outcome of a measurement; return the correction of the filter's state, or
        None."""
        e, t_ns, correction, explained = estimator, measurement.t_ns, None, False
        bank, used = e.hypotheses, not one.out
        if one.out or one.device in self._agreement:
            self._agrees(measurement, one)
        if bank is not None:
            evidence = bank.is_evidence(measurement, used)
            measured = evidence or not measurement.constraint
            fails = used and not measured and outcome.name == "gated"
            if fails:  # before it excludes itself, the bank is asked
                bank.judge(t_ns)
            found = bank.take(t_ns, measured, used, outcome.name == "fused")
            if found is not None and evidence:
                if identified(found) and self._can_decide(measurement, found):
                    correction = self._decide(measurement, e, bank, found)
                one = self._series[measurement.source]
            if found is not None and (evidence or fails):
                explained = found.item(EXPLAINS) > DECIDED - APART
        if not used:
            correction = self._looked_at(measurement, one, outcome, estimator)
        elif one.out:  # by that decision
            return correction
        elif outcome.name == "fused":
            one.fused(t_ns, () if measurement.constraint else outcome.whitened)
        elif outcome.name == "gated" and (not measurement.constraint or measurement.no_slip):
            one.gated(t_ns, explained)
            if one.out and one.reason == DISAGREES:
                self._lasting = {**self._lasting, one.source: Lasting()}
        return correction

    def _looked_at(
        self, measurement: AidingMeasurement, one: Series, outcome: Outcome, estimator: Estimator
    ) -> Correction | None:
        """Judge an excluded source by its innovation against the published solution."""
        correction, t_ns, bank = None, measurement.t_ns, estimator.hypotheses
        passes = outcome.nis <= gate_threshold(measurement.gate, max(outcome.degrees, 1))
        if outcome.lasting:
            known = self._lasting[one.source].judged(outcome.lasting)
            self._lasting = {**self._lasting, one.source: known}
        lasts, limit = min(
            zip(outcome.lasting, outcome.evidence_limits, strict=True),
            default=(math.nan, math.inf),
        )
        others = self._over_by_others(one)
        one.looked_at(t_ns, passes and one.repeats == 0, lasts - outcome.nis, others, limit)
        if self._goes_its_own_way(one):
            correction = somewhere_else(measurement, estimator)
            one.readmit(t_ns)
        if not one.out:
            known = self._is_over(one)
            if bank is not None:
                bank.begin_again(measurement, estimator.nav, estimator.step)
                self._may_last(t_ns, one, known, bank)
        return correction

    def _may_last(self, t_ns: int, one: Series, known: Lasting, bank: Hypotheses) -> None:
        """Start a hypothesis that a returning series' fault lasts, with its probability."""
        for finding, share in zip(known.findings, known.shares, strict=True):
            kind, per_unit = self._kinds.index(finding.kind), finding.kind.per_unit
            b, sd = np.array(finding.size) / per_unit, np.array(finding.sd) / per_unit
            odds = math.log(share) - max(RETURNS, min(one.sure, MOST_SURE))
            bank.begin_lasting(t_ns, kind, finding.since_s, b, sd, odds)

    def _can_decide(self, measurement: AidingMeasurement, found: Array) -> bool:
        """False before the position of an epoch has arrived, for a fault that it may tell from
        others: of the device whose velocity came first, and of a place that may be the shared error
        (fusiond.integrity.correlated_fix_jumps)."""
        if measurement.locates:
            return True
        kind = self._kinds[int(found.item(BEST)) // RESTARTS]
        places = [s for s in self._series.values() if s.device == kind.device and s.locates]
        if kind.of == MOTION and measurement.moves and measurement.device == kind.device:
            since_ns = measurement.t_ns - LONGEST_NS
            if any(s.received_ns > since_ns for s in places if not s.out):
                return False
        return kind.of != PLACE or not any(s.shares for s in places)

    def _decide(
        self, measurement: AidingMeasurement, estimator: Estimator, bank: Hypotheses, found: Array
    ) -> Correction:
        """Faults that are identified."""
        taken = self._alike(bank, int(found.item(BEST)))
        correction, best_fit = mixed(taken), max(each.log_likelihood for each in taken)
        finding = self._finding(measurement.t_ns, max(taken, key=lambda each: each.log_odds))
        steps = [each for each in taken if self._kinds[each.kind].signature == POSITION]
        if steps:
            step = max(steps, key=lambda each: each.log_likelihood)
            less = best_fit - step.log_likelihood
            if slots := renewed_slots(measurement, estimator, step, less):
                sd = tuple(np.sqrt(np.diagonal(step.covariance)).tolist())
                kind = changed_kind(finding.kind.device)
                finding = finding._replace(kind=kind, size=tuple(step.size.tolist()), sd=sd)
                correction.mean[slots] = -estimator.xi[slots]
                correction.spread[slots, slots] += estimator.model.noise[2, slots]
        others = [f for f in self.findings if f.kind.text != finding.kind.text]
        self.findings = (*others, finding)
        if not finding.kind.corrected:
            self._leave_out(finding, bank, best_fit)
        return correction

    def _finding(self, t_ns: int, told: Estimated) -> Finding:
        kind = self._kinds[told.kind]
        size = tuple((told.size * kind.per_unit).tolist())
        sd = tuple((np.sqrt(np.diagonal(told.covariance)) * kind.per_unit).tolist())
        return Finding(kind, t_ns, told.onset_s, size, sd, told.log_odds)

    def _leave_out(self, finding: Finding, bank: Hypotheses, fit: float) -> None:
        """Exclude the series that a fault affects, and those of similarly likely faults of its
        device: none of them is trusted before the faults are distinguished. A fix that is 60 m
        behind on a straight may have an offset, or a delay that affects the velocity, too."""
        fits = bank.explains & (bank.log_odds > max(0.0, finding.log_odds - DECIDED))
        fits &= bank.log_likelihood >= fit - APART
        found = []
        for row in np.flatnonzero(fits.any(axis=1)).tolist():
            kind = self._kinds[row]
            if kind.device == finding.kind.device and not (kind.corrected or kind.opens):
                restart = int(np.argmax(np.where(fits[row], bank.log_odds[row], -np.inf)))
                told = bank.estimated(RESTARTS * row + restart)
                found.append(self._finding(finding.t_ns, told))
        self._exclude(
            finding.t_ns,
            finding.text,
            lambda s: any(f.kind.spoils(s.device, s.locates, s.moves) for f in found),
        )
        lasting = dict(self._lasting)
        for name, s in self._series.items():
            if s.out and s.reason == finding.text:
                of = (f for f in found if f.kind.spoils(s.device, s.locates, s.moves))
                lasting[name] = Lasting.of(of)
        self._lasting = lasting

    def _over_by_others(self, one: Series) -> float:
        """Log likelihood that the fault which excluded a series is over, by the other series that
        it affects: a fault ends for all at once."""
        known = set(self._lasting.get(one.source, Lasting()).findings)
        others = [s for n, s in self._series.items() if s.out and n != one.source]
        return sum(
            s.over for s in others if known & set(self._lasting.get(s.source, Lasting()).findings)
        )

    def _is_over(self, one: Series) -> Lasting:
        """End all faults that had excluded a series which has returned, for other series, too;
        return these series."""
        over = self._lasting.get(one.source, Lasting())
        lasting = {one.source: over}  # which comes again if it fails on probation
        for name, known in self._lasting.items():
            if name == one.source:
                continue
            left = lasting[name] = known.without(over)
            if known.findings and not left.findings and self._series[name].out:
                self._changed(name).reason = STILL
        self._lasting = lasting
        return over

    def lasting(
        self, measurement: AidingMeasurement, one: Series, estimator: Estimator
    ) -> Array | None:
        """Terms (k, 3) of each lasting fault in the innovation of an excluded series; None if
        unknown."""
        bank, added = estimator.hypotheses, []
        if bank is None:
            return None
        for f in self._lasting.get(one.source, Lasting()).findings:
            b, age_s = np.array(f.size) / f.kind.per_unit, measurement.t_ns * 1e-9 - f.since_s
            added.append(bank.adds(measurement, self._kinds.index(f.kind), b, age_s, estimator.nav))
        return np.array(added) if added else None

    def _alike(self, bank: Hypotheses, best: int) -> list[Estimated]:
        """Hypotheses of the class and device of the group `best` with nearly its likelihood."""
        explains, fit, kind = bank.explains, bank.log_likelihood, self._kinds[best // RESTARTS]
        least = fit.flat[best] - ALIKE
        return [
            bank.estimated(RESTARTS * row + restart)
            for row, each in enumerate(self._kinds)
            if each.of == kind.of and each.device == kind.device and not each.opens
            for restart in range(RESTARTS)
            if explains[row, restart] and fit[row, restart] > least
        ]

    def _exclude(self, t_ns: int, reason: str, spoiled: Callable[[Series], bool]) -> None:
        """Exclude the series that faults affect."""
        for name in [n for n, s in self._series.items() if not s.out and spoiled(s)]:
            self._changed(name).exclude(t_ns, reason)
            self._lasting = {**self._lasting, name: Lasting()}

    def _goes_its_own_way(self, one: Series) -> bool:
        """True if the position of the filter, not of the device, is wrong.

        The device's positions have agreed for a minute with its velocity, which is that of the
        filter: it is in service, and the position's fault is over, or it passes while all series
        are excluded. Those of a delayed device agree with each other, too."""
        if not (one.out and one.locates):
            return False
        known = self._agreement.get(one.device)
        if known is None or known.lasted_ns <= FITS_AGAINST_NS:
            return False
        own = [s for s in self._series.values() if s.device == one.device]
        if all(s.out for s in own):
            delays = [f.kind for f in self.findings if f.kind.signature == DELAY]
            delayed = any(kind.spoils(one.device, locates=True, moves=True) for kind in delays)
            return not delayed and _velocities_passed(own, READMIT_COUNT)
        moves = [s for s in own if s.moves]
        unexplained = one.reason in (DISAGREES, STILL)
        return unexplained and bool(moves) and not any(s.out for s in moves)

    def _agrees(self, measurement: AidingMeasurement, one: Series) -> None:
        """Update the agreement of a device that is or was excluded. A value that repeats while the
        vehicle moves is no evidence."""
        if not (one.locates or one.moves) or measurement.screened or one.repeats > 0:
            return
        known = self._agreement.get(measurement.device, Agreement())
        self._agreement = {
            **self._agreement,
            measurement.device: known.with_measurement(measurement),
        }


def _velocities_passed(own: Sequence[Series], count: int) -> bool:
    """True if the last `count` velocities of an excluded device were those of the filter."""
    moves = [s for s in own if s.moves]
    return bool(moves) and all(s.passed >= count for s in moves)
