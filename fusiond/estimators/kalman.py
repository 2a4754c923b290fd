r"""Extended Kalman filter on the error state, closed loop: one filter for all aids.

The error state is estimated, taken out of the navigation state at once and is zero again, so only
its covariance is propagated.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, Innovation, Linearised, NotApplicable
from fusiond.estimators.base import AS_STATED, THRESHOLDS, ErrorStateFilter, Outcome
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.gated_update import account_for, fold_and_account
from fusiond.estimators.measurement_run import MeasurementRun
from fusiond.estimators.row_kernels import KNOWS, NO_AXES, Axes
from fusiond.estimators.screening import KEPT
from fusiond.estimators.update import fuse, whiten, work
from fusiond.models.model import Model

Array = NDArray[np.float64]


class KalmanEstimator(ErrorStateFilter):
    """The centralised filter (`fusiond.estimators.base.Estimator`)."""

    packs: ClassVar[bool] = True
    """True if an update is that of fusiond.estimators.measurement_run."""

    def __init__(
        self,
        model: Model,
        gap_s: float,
        shares: tuple[float, ...] = (1.0,),
        faults: FaultTable = NO_FAULTS,
    ) -> None:
        super().__init__(model, gap_s, shares, faults)
        self._work = [work(rows, model.width) for rows in range(LENT_ROWS + 1)]
        self.turns = False
        """True if the heading may be far off, and updates are another kind's."""
        self._knows = np.zeros(KNOWS)
        self._runs = self._new_run(NO_AXES)

    def _new_run(self, axes: Axes) -> MeasurementRun | None:
        """Aids in one call, with what updates carry over; None without a bank, whose updates are
        cheap, and of a filter whose updates differ."""
        bank = self.hypotheses
        if bank is None or not self.packs:
            return None
        return MeasurementRun(self, self._memory, self.model, bank, axes, self._knows)

    @property
    def runs(self) -> MeasurementRun | None:
        """Aids in one call; None while an estimate is held, or updates turn."""
        return None if self._holding or self.turns else self._runs

    def update(self, aid: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Fold one aid in, or name why not; `noise` (3,) times its variances."""
        outcome = self._fold_in(aid, noise)
        self._leave(aid, outcome.rows)
        return outcome

    def _fold_in(self, aid: Linearised, noise: Array) -> Outcome:
        if aid.screened and aid.renewal is not None:
            self._renew(aid.renewal)
        innovation = self._linearise(aid)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        if aid.screened:
            return self._update_by_rows(aid, innovation)
        z, h, r = innovation
        degrees = z.shape[0]
        if noise is not AS_STATED and degrees <= LENT_ROWS:
            r *= noise[:degrees]
        threshold = THRESHOLDS[aid.gate, degrees]
        y, g = self._work[degrees] if degrees <= LENT_ROWS else work(degrees, self.model.width)
        nav, xi, cov, dx = self.nav, self.xi, self._cov, self._dx
        bank = self.hypotheses
        if bank is None or degrees > LENT_ROWS:
            nis = fuse(nav, xi, cov, dx, z, h, r, threshold, self._holding, y, g)
        else:
            of, table = bank.of_source.get(aid.source) or bank.of(aid), bank.table
            if not self._holding:
                now = bank.bank, *table[:3], aid.t_ns, *of, bank.rows, bank.found
                nis = fold_and_account(nav, xi, self.step, cov, dx, z, h, r, threshold, y, g, *now)
            else:
                nis = fuse(nav, xi, cov, dx, z, h, r, threshold, True, y, g)
                if nis < math.inf:
                    of_row = bank.bank, *table[:3], aid.t_ns, *of, bank.rows, bank.found
                    account_for(nav, self.step, h, r, y, g, bool(nis <= threshold), *of_row)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        return Outcome("gated", nis, degrees)

    def _update_by_rows(self, aid: Linearised, rows: Innovation) -> Outcome:
        """Rows that pass are folded in, or none."""
        cov, dx = self._cov, self._dx
        s = self._screen(aid, rows, cov, dx)
        codes = tuple(s.codes.tolist())
        kept = codes.count(KEPT)
        if not kept:
            return Outcome("gated", s.nis, 0, (), codes)
        if self.hypotheses is not None:
            self._account_for(aid, rows, s.codes == KEPT, True)
        cov[:] = s.cov
        dx[:] = s.dx
        if not self._holding:
            self._feed_back(dx)
            dx[:] = 0.0
        return Outcome("fused", s.nis, kept, tuple(s.y.tolist()), codes)

    def _account_for(
        self, aid: Linearised, rows: Innovation, kept: NDArray[np.bool_], fused: bool
    ) -> None:
        """Update the bank by rows of an aid that are about to be folded in, or have failed."""
        bank, count = self.hypotheses, int(kept.sum())
        assert bank is not None
        z, h, r = (np.ascontiguousarray(part[kept]) for part in rows)
        y, g = work(count, self.model.width)
        if whiten(self._cov, z - h @ self._dx, h, r, y, g) < math.inf:
            of_row = bank.bank, *bank.table[:3], aid.t_ns, *bank.of(aid)
            space = np.empty(count * bank.columns, dtype=np.float32)
            account_for(self.nav, self.step, h, r, y, g, fused, *of_row, space, bank.found)

    def hold(self) -> None:
        """From now on estimate without feedback: errors are carried along with the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back what was carried."""
        self._holding = False
        self._feed_back(self._dx)
        self._dx[:] = 0.0
