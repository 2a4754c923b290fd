"""The bank of one filter as the rest of the code sees it: kernels of fusiond.estimators.fault_bank
and fusiond.estimators.fault_odds on its part of the filter's memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, Linearised
from fusiond.estimators.fault_bank import (
    EXPLAINED,
    GROUP,
    GROUPS,
    LOG_ODDS,
    MOVES,
    NOTHING,
    ONSET,
    OTHER,
    PLACES,
    RESTARTS,
    ROLLS,
    SENSITIVITIES,
    UNEXPLAINED,
    WEIGHT,
    FaultTable,
    chunks_of,
)
from fusiond.estimators.fault_odds import FOUND, estimate, judge, mixture
from fusiond.estimators.fault_onsets import begin_again, begin_all
from fusiond.estimators.fault_rows import signature
from fusiond.models.model import Model

Array = NDArray[np.float64]


class Estimated(NamedTuple):
    """A hypothesis as it stands: number of its kind, onset (s), log odds against nothing wrong, log
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
    """A bank of `table` in `bank`, beside a filter of `model`."""

    def __init__(self, bank: Array, table: FaultTable, model: Model) -> None:
        self.bank, self.table = bank, table
        self.n, self.width = model.size, model.width
        kinds = table.ints.shape[0]
        self.found = np.full(FOUND, -np.inf)
        """What the last `judge` has found."""
        self.columns = chunks_of(table.columns, model.width) * model.width
        self.work = np.zeros(LENT_ROWS * self.columns)
        self._groups = bank[GROUPS : GROUPS + RESTARTS * kinds * GROUP].reshape(
            kinds, RESTARTS, GROUP
        )
        n, w, v = self.n, self.width, bank[int(bank[SENSITIVITIES]) :]
        self.sensitivities = v.reshape(-1, n, w)
        """V, a block (n, w) of columns after another."""
        self._nine = np.zeros((9, 9))
        self._of_source: dict[str, tuple[int, int]] = {}

    def of(self, aid: Linearised) -> tuple[int, int]:
        """What an aid's rows are, as of fusiond.estimators.fault_bank, and the number of its
        device; -1 where no kind is of it."""
        known = self._of_source.get(aid.source)
        if known is None:
            devices = self.table.devices
            device = devices.index(aid.device) if aid.device in devices else -1
            known = self._of_source[aid.source] = _measures(aid, device >= 0), device
        return known

    def begin(self, t_ns: int, nav: Array, step: Array) -> None:
        """Begin all hypotheses anew at `t_ns`, of a filter with that state (10,) and last step."""
        begin_all(self.bank, self.table.ints, self.n, self.width, t_ns, nav, step)

    def adds(self, aid: Linearised, kind: int, b: Array, age_s: float, nav: Array) -> Array:
        """D b (3,): what a fault of size `b`, of such an age, does to an aid's rows."""
        ints, numbers, (measures, device) = *self.table[:2], self.of(aid)
        found = np.zeros(3)
        for row in range(3):
            for c, size in enumerate(b):
                at = (kind, measures, device, aid.t_ns * 1e-9, age_s, nav, row, c)
                found[row] += size * signature(self.bank, ints, numbers, *at)
        return found

    def begin_again(self, aid: Linearised, nav: Array, step: Array) -> None:
        """An aid's series returns to service: what was shown of it before is why it was out, and
        its hypotheses begin anew."""
        n, width = self.n, self.width
        begin_again(self.bank, self.table.ints, n, width, *self.of(aid), aid.t_ns, nav, step)

    def judge(self, t_ns: int) -> Array:
        """Odds of all at the epoch of a measurement; what they come to, `found` (5,)."""
        table = self.table
        judge(self.bank, table.ints, table.numbers, t_ns * 1e-9, self.found)
        return self.found

    def opened(self) -> Array:
        """What the weighed hypotheses leave open of attitude, velocity, position (9, 9); written
        anew by the next call."""
        mixture(self.bank, *self.table[:2], self.n, self.width, self._nine)
        return self._nine

    def opened_of_all(self) -> Array:
        """The same of all states (n, n)."""
        out = np.zeros((self.n, self.n))
        mixture(self.bank, *self.table[:2], self.n, self.width, out)
        return out

    def estimated(self, number: int) -> Estimated:
        """The hypothesis of a group."""
        kind = number // RESTARTS
        group = self._groups[kind, number % RESTARTS]
        found, effect = np.zeros(12), np.zeros((1 + self.n, self.n))
        estimate(self.bank, *self.table[:2], self.n, self.width, number, found, effect)
        p = int(self.table.ints[kind, 2])
        return Estimated(
            kind,
            float(group[ONSET]),
            float(group[LOG_ODDS]),
            0.5 * float(group[EXPLAINED]),
            found[:p],
            found[3:].reshape(3, 3)[:p, :p],
            effect[0],
            effect[1:],
        )

    @property
    def log_odds(self) -> Array:
        """Log odds (k, restarts) of the last `judge`."""
        return self._groups[:, :, LOG_ODDS]

    @property
    def log_likelihood(self) -> Array:
        """Log of the largest likelihood ratios (k, restarts), of the last `judge`."""
        return 0.5 * self._groups[:, :, EXPLAINED]

    @property
    def explains(self) -> NDArray[np.bool_]:
        """(k, restarts): no more is left than chance leaves."""
        found: NDArray[np.bool_] = self._groups[:, :, UNEXPLAINED] <= 0.0
        return found

    @property
    def weights(self) -> Array:
        """Posterior probabilities (k, restarts) of the last `judge`."""
        return self._groups[:, :, WEIGHT]


def _measures(aid: Linearised, known: bool) -> int:
    if aid.constraint and not (aid.no_slip or known):
        return NOTHING
    if aid.screened:  # its rows are ranges
        return OTHER
    if aid.locates:
        return PLACES
    if aid.moves:
        return MOVES
    return ROLLS if aid.rolls else OTHER
