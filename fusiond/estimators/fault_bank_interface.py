"""Interface of one filter's fault bank to the rest of the code: kernels of
fusiond.estimators.fault_bank and fusiond.estimators.fault_odds on its part of the filter's memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, Linearised
from fusiond.estimators.fault_bank import (
    ALL,
    BEGINS_AT,
    BY_CHANCE,
    COUNTS_BY,
    E_ROWS,
    EXPLAINED,
    J_AT,
    L_ROWS,
    LAST_MEASURED,
    LOG_ODDS,
    MEAN,
    MOVES,
    N_AT,
    NOTHING,
    ONSET,
    OTHER,
    PLACES,
    PRIOR,
    RESTARTED,
    RESTARTS,
    ROLLS,
    SAT_AT,
    SENSITIVITIES,
    SIZE,
    SLOTS_OF,
    SUSPECTS,
    TURNED_BY,
    UNEXPLAINED,
    UNJUDGED,
    UNWEIGHED,
    WAITS,
    WEIGHT,
    FaultTable,
    column_of,
    columns_of,
    group_at,
    is_evidence,
    turned_by,
)
from fusiond.estimators.fault_mixture import estimate, mixture
from fusiond.estimators.fault_odds import FOUND, judge
from fusiond.estimators.fault_onsets import begin_again, begin_all
from fusiond.estimators.fault_prescreen import judge_what_waits
from fusiond.estimators.fault_sizes import OPENED_WORK, RARE, judge_and_widen, widen_by_faults
from fusiond.estimators.fault_update import keep_fed_back, rows_of_fault
from fusiond.models.model import Model
from fusiond.models.vehicle_parameter_blocks import MOUNTING

Array = NDArray[np.float64]


UNLIKELY = 1e3
"""Log odds that no rate and no evidence at an onset make up for."""


class Estimated(NamedTuple):
    """Hypothesis with its estimate: number of its kind, onset (s), log odds against no fault, log
    of the largest likelihood ratio, size b (p,), M (p, p), and its effect on the error state: V b
    (n,), V M V^T (n, n)."""

    kind: int
    onset_s: float
    log_odds: float
    log_likelihood: float
    size: Array
    covariance: Array
    mean: Array
    spread: Array


class Hypotheses:
    """A bank of `table` in `bank`, beside a filter of `model`: `of` are its state (10,), parameters
    (n,), last step (28,) and axes and clock of publication (3,), and `wider` (9,) the variances
    that the published solution has beyond P.

    Rows of one instant are judged once, together, unless one fails its gate or a likely hypothesis
    may be identified.
    """

    def __init__(
        self,
        bank: Array,
        table: FaultTable,
        model: Model,
        of: tuple[Array, Array, Array, Array],
        wider: Array,
    ) -> None:
        self.bank, self.table = bank, table
        self.n, self.width = model.size, model.width
        self.found = np.full(FOUND, -np.inf)
        """Result of the last `judge`, as of fusiond.estimators.fault_odds."""
        self.mounting = np.full((2, 2), -1.0)
        """Slots of pitch and yaw of the mounting, and the random part of their squares."""
        for k, slot in enumerate(model.slots_of(MOUNTING)[:2]):
            self.mounting[k] = slot, RARE * float(model.initial[slot]) ** 2
        self.columns = columns_of(table)
        self.rows = np.zeros(LENT_ROWS * self.columns, dtype=np.float32)
        self.work = np.zeros(OPENED_WORK)
        self._judged = bank, table.ints, table.numbers, table.lanes, self.n
        self._widened = *of, self.mounting, self.work, wider, self.found
        """Arguments of `judge_and_widen` before and behind an epoch."""
        numbers = range(int(bank[ALL]))
        self._at = np.array([group_at(bank, number) for number in numbers]).reshape(-1, RESTARTS)
        self.sensitivities = bank[int(bank[SENSITIVITIES]) :].view(np.float32).reshape(self.n, -1)
        """Sensitivities V (n, columns)."""
        self._nine = np.zeros((9, 9))
        self.of_source: dict[str, tuple[int, int]] = {}

    def of(self, measurement: Linearised) -> tuple[int, int]:
        """Measures of a measurement's rows, as in fusiond.estimators.fault_bank, and its device
        number; -1 if no kind affects it."""
        known = self.of_source.get(measurement.source)
        if known is None:
            devices = self.table.devices
            device = devices.index(measurement.device) if measurement.device in devices else -1
            known = self.of_source[measurement.source] = _measures(measurement, device >= 0), device
        return known

    def is_evidence(self, measurement: Linearised, used: bool) -> bool:
        """True if hypotheses are judged at a measurement, `used` or not."""
        measures = self.of(measurement)[0] if used else NOTHING
        measured = used and not measurement.constraint
        return bool(is_evidence(self.bank, measures, measurement.t_ns * 1e-9, measured))

    @property
    def waits(self) -> bool:
        """True if V has not been propagated since the last measurement."""
        return self.bank.item(WAITS) != 0.0

    def begin(self, t_ns: int, nav: Array, step: Array) -> None:
        """Restart all hypotheses at a start at `t_ns`, with the filter's state (10,) and last
        step."""
        for k, (_, by_chance) in enumerate(self.mounting.tolist()):
            self.bank[TURNED_BY + k] = self.bank[SAT_AT + k] = 0.0
            self.bank[BY_CHANCE + k] = by_chance
        self._begin(t_ns, nav, step)

    def decided(
        self, t_ns: int, nav: Array, step: Array, mean: Array, xi: Array, cov: Array
    ) -> None:
        """Restart all hypotheses before removal of a fault's `mean` (n,) from the parameters (n,).

        A change of the mounting in it is a turn, and so is what the filter has found since the last
        decision and P did not allow it then; `cov` is P of now.
        """
        for k, slot in enumerate(self.mounting[:, 0].astype(int).tolist()):
            if slot >= 0:
                turned = turned_by(self.bank, k, xi.item(slot)) + mean.item(slot)
                self.bank[TURNED_BY + k] = turned
                self.bank[SAT_AT + k] = xi.item(slot) + mean.item(slot)
                by_chance = min(self.bank.item(BY_CHANCE + k), RARE * cov.item(slot, slot))
                self.bank[BY_CHANCE + k] = by_chance
        self._begin(t_ns, nav, step)

    def _begin(self, t_ns: int, nav: Array, step: Array) -> None:
        self.bank[LAST_MEASURED] = t_ns * 1e-9
        begin_all(self.bank, self.table.ints, self.n, self.width, t_ns, nav, step)

    def begin_again(self, measurement: Linearised, nav: Array, step: Array) -> None:
        """Restart the hypotheses on a series that returns to service, as earlier evidence belongs
        to its exclusion."""
        begin_again(
            self.bank, self.table.ints, self.n, *self.of(measurement), measurement.t_ns, nav, step
        )

    def begin_lasting(
        self, t_ns: int, kind: int, onset_s: float, b: Array, sd: Array, log_odds: float
    ) -> None:
        """Start a hypothesis that a fault of size `b` with `sd` (p,) has lasted since `onset_s`,
        with these odds: the restart of longest remaining time gets L = M^-1 - S^-1."""
        level = len(SLOTS_OF) - 1
        turn = int(self.bank[RESTARTED + level])
        at, p = self._at[kind, BEGINS_AT[level] + turn % SLOTS_OF[level]], len(b)
        numbers = self.table.numbers[kind]
        prior = numbers[PRIOR : PRIOR + p] ** -2.0
        known = np.maximum(sd**-2.0 - prior, 0.0)
        e = known * b + prior * (b - numbers[MEAN] * (p == 1))
        self.bank[at + L_ROWS[:p, :p]], self.bank[at + E_ROWS[:p]] = np.diag(known), e
        self.bank[at + J_AT], self.bank[at + N_AT] = (e * e / (known + prior)).sum(), p
        self.bank[at + ONSET], self.bank[at + COUNTS_BY] = onset_s, -UNLIKELY
        self.judge(t_ns)
        self.bank[at + COUNTS_BY] += log_odds - self.bank[at + LOG_ODDS]
        self.judge(t_ns)

    def keep_fed_back(self, dx: Array) -> None:
        """Subtract an error (n,), removed from the filter's state, from the stored path."""
        keep_fed_back(self.bank, dx)

    def adds(self, measurement: Linearised, kind: int, b: Array, age_s: float, nav: Array) -> Array:
        """D b (3,): effect of a fault of size `b` and given age on a measurement's rows."""
        out, table = np.empty(3), self.table
        of = kind, *self.of(measurement)
        rows_of_fault(self.bank, *table[:2], *of, measurement.t_ns * 1e-9, age_s, nav, b, out)
        return out

    def judge(self, t_ns: int) -> Array:
        """Compute the odds of all hypotheses at a measurement's epoch; the result `found` (5,)."""
        table = self.table
        judge(self.bank, *table[:3], t_ns * 1e-9, self.found)
        return self.found

    def take(self, t_ns: int, measured: bool, used: bool, fused: bool) -> Array | None:
        """Update after rows of a measurement: the result `found` if they were `measured` and
        `used`; unless a hypothesis is identified, the covariance that the weighted hypotheses add
        is written to `wider`. None if `fused` rows allow deferring all to `conclude`."""
        if fused and measured and used and self.bank.item(SUSPECTS) == 0.0:
            self.bank[UNJUDGED] = t_ns * 1e-9
            return None
        judge_and_widen(*self._judged, t_ns * 1e-9, measured, used, *self._widened)
        return self.found

    def conclude(self) -> None:
        """Compute the deferred odds."""
        if self.bank.item(UNWEIGHED) < math.inf:
            judge_what_waits(self.bank, *self.table[:3], self.found)
        epoch_s = self.bank.item(UNJUDGED)
        if epoch_s < math.inf:
            judge_and_widen(*self._judged, epoch_s, True, True, *self._widened)

    def widen(self, nav: Array, step: Array, time_slot: int, wider: Array) -> None:
        """Write `wider` (9,): variances that the weighted hypotheses add to the published ones."""
        of = self.n, nav, step, time_slot
        widen_by_faults(self.bank, self.table.lanes, *of, self.work, wider)

    def opened(self) -> Array:
        """Covariance that the weighed hypotheses add to attitude, velocity, position (9, 9);
        written anew by the next call."""
        self.conclude()
        mixture(self.bank, self.table.numbers, self.n, self._nine)
        return self._nine

    def opened_of_all(self) -> Array:
        """Added covariance of all states (n, n)."""
        self.conclude()
        out = np.zeros((self.n, self.n))
        mixture(self.bank, self.table.numbers, self.n, out)
        return out

    def estimated(self, number: int) -> Estimated:
        """The hypothesis of a group."""
        kind = number // RESTARTS
        at = self._at[kind, number % RESTARTS]
        found, effect = np.zeros(12), np.zeros((1 + self.n, self.n))
        estimate(self.bank, self.table.numbers, self.n, number, found, effect)
        p = int(self.table.ints[kind, SIZE])
        return Estimated(
            kind,
            float(self.bank[at + ONSET]),
            float(self.bank[at + LOG_ODDS]),
            0.5 * float(self.bank[at + EXPLAINED]),
            found[:p],
            found[3:].reshape(3, 3)[:p, :p],
            effect[0],
            effect[1:],
        )

    def each(self, which: int) -> Array:
        """One number of all groups (k, restarts), as in fusiond.estimators.fault_bank."""
        found: Array = self.bank[self._at + which]
        return found

    def effect(self, number: int) -> Array:
        """V of a group (n, p)."""
        count = int(self.table.ints[number // RESTARTS, SIZE])
        columns = [column_of(self.bank, number, c) for c in range(count)]
        return self.sensitivities[:, columns].astype(np.float64)

    @property
    def log_odds(self) -> Array:
        """Log odds (k, restarts) of the last `judge`."""
        return self.each(LOG_ODDS)

    @property
    def log_likelihood(self) -> Array:
        """Log of the largest likelihood ratios (k, restarts), of the last `judge`."""
        found: Array = 0.5 * self.each(EXPLAINED)
        return found

    @property
    def explains(self) -> NDArray[np.bool_]:
        """True (k, restarts) if the unexplained rest is within chance."""
        found: NDArray[np.bool_] = self.each(UNEXPLAINED) <= 0.0
        return found

    @property
    def weights(self) -> Array:
        """Posterior probabilities (k, restarts) of the last `judge`."""
        return self.each(WEIGHT)


def _measures(measurement: Linearised, known: bool) -> int:
    if measurement.constraint and not (measurement.no_slip or known):
        return NOTHING
    if measurement.screened:  # its rows are ranges
        return OTHER
    if measurement.locates:
        return PLACES
    if measurement.moves:
        return MOVES
    return ROLLS if measurement.rolls else OTHER
