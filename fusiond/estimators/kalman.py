r"""Extended Kalman filter on the error state, closed loop: one filter for all measurements.

The error estimate is fed back to the navigation state at once and is zero again, so only its
covariance is propagated.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import LENT_ROWS, Innovation, Linearised, NotApplicable
from fusiond.estimators.base import AS_STATED, THRESHOLDS, Estimator, Outcome
from fusiond.estimators.fault_bank import NO_FAULTS, FaultTable
from fusiond.estimators.fault_update_by_rows import account_for
from fusiond.estimators.gated_update import fold_and_account
from fusiond.estimators.measurement_loop_kernel import AT_H, NO_AXES, Axes
from fusiond.estimators.update import fuse, work
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.models.model import Model

Array = NDArray[np.float64]
OfBank = tuple[Array, NDArray[np.int64], Array, Array, int, int, int, NDArray[np.float32], Array]

_NOTHING = np.zeros(0)
_NO_BANK: OfBank = _NOTHING, *NO_FAULTS[:3], 0, 0, 0, np.zeros(0, dtype=np.float32), _NOTHING


class KalmanEstimator(Estimator):
    """The centralised filter (`fusiond.estimators.base.Estimator`)."""

    packs: ClassVar[bool] = True
    """True if an update is that of fusiond.estimators.measurement_loop_kernel."""

    def __init__(
        self,
        model: Model,
        gap_s: float,
        shares: tuple[float, ...] = (1.0,),
        faults: FaultTable = NO_FAULTS,
    ) -> None:
        super().__init__(model, gap_s, shares, faults)
        self._work = [work(rows, model.width) for rows in range(LENT_ROWS + 1)]
        self._run_by(NO_AXES)

    def _run_by(self, axes: Axes) -> None:
        """Run packed measurements, with the axes of the updates; not for filters without a bank,
        where single updates cost less, or with other updates."""
        bank, model = self.hypotheses, self.model
        if bank is not None and self.packs:
            work = np.zeros(AT_H + LENT_ROWS * (model.size + model.width))
            self._run_with = (
                *(*bank.table[:3], model.column_of, model.initial, *axes),
                *(bank.mounting, work, bank.rows, bank.work, self._knows, bank.found),
            )

    def update(self, measurement: Linearised, noise: Array = AS_STATED) -> Outcome:
        """Fold one measurement in, or name why not; `noise` (3,) times its variances."""
        outcome = self._fold_in(measurement, noise)
        self._leave(measurement, outcome.rows)
        return outcome

    def _fold_in(self, measurement: Linearised, noise: Array) -> Outcome:
        if measurement.screened and measurement.renewal is not None:
            self._renew(measurement.renewal)
        innovation = self._linearise(measurement)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        if measurement.screened:
            return self._update_by_rows(measurement, innovation)
        z, h, r = innovation
        degrees = z.shape[0]
        if noise is not AS_STATED and degrees <= LENT_ROWS:
            r *= noise[:degrees]
        threshold = THRESHOLDS[measurement.gate, degrees]
        y, g = self._work[degrees] if degrees <= LENT_ROWS else work(degrees, self.model.width)
        nav, xi, cov, dx = self.nav, self.xi, self._cov, self._dx
        of_bank = self._of_bank(measurement, degrees)
        if not self._holding:
            nis = fold_and_account(nav, xi, self.step, cov, dx, z, h, r, threshold, y, g, *of_bank)
        else:
            before = cov.copy(), dx.copy()
            nis = fuse(nav, xi, cov, dx, z, h, r, threshold, True, y, g)
            if nis < math.inf and of_bank[0].size:
                kept = np.ones(degrees, dtype=np.bool_)
                fused = bool(nis <= threshold)
                self._account_for(measurement, innovation, before, kept, fused)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()), first=z.item(0))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        return Outcome("gated", nis, degrees)

    def _of_bank(self, measurement: Linearised, rows: int) -> OfBank:
        """Arguments for the bank: its table, the instant, the measures of the rows, and work space;
        empty without a bank, and for more rows than provided."""
        bank = self.hypotheses
        if bank is None or rows > LENT_ROWS:
            return _NO_BANK
        of = bank.of_source.get(measurement.source) or bank.of(measurement)
        return bank.bank, *bank.table[:3], measurement.t_ns, *of, bank.rows, bank.found

    def _update_by_rows(self, measurement: Linearised, rows: Innovation) -> Outcome:
        """Update by all rows, or by none."""
        cov, dx = self._cov, self._dx
        s = self._screen(measurement, rows, cov, dx)
        codes = tuple(s.codes.tolist())
        kept = codes.count(KEPT)
        if not kept:
            return Outcome("gated", s.nis, 0, (), codes)
        if self.hypotheses is not None:
            self._account_for(measurement, rows, (self._cov, self._dx), s.codes == KEPT, True)
        cov[:] = s.cov
        dx[:] = s.dx
        if not self._holding:
            self._feed_back(dx)
            dx[:] = 0.0
        return Outcome("fused", s.nis, kept, tuple(s.y.tolist()), codes)

    def _account_for(
        self,
        measurement: Linearised,
        rows: Innovation,
        before: tuple[Array, Array],
        kept: NDArray[np.bool_],
        fused: bool,
    ) -> None:
        """Update the bank by rows that will be fused or have failed, with P and dx before them."""
        bank = self.hypotheses
        assert bank is not None
        table = bank.table
        account_for(
            *(self.nav, self.step, *before, *rows, kept, fused),
            *(bank.bank, table.ints, table.numbers, table.lanes),
            *(measurement.t_ns, *bank.of(measurement), bank.found),
        )

    def hold(self) -> None:
        """Estimate without feedback from now on; errors propagate beside the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back the held estimate."""
        self._holding = False
        self._feed_back(self._dx)
        self._dx[:] = 0.0
