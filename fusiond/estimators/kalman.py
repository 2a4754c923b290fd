r"""Extended Kalman filter on the error state, closed loop: one filter for all aids.

The error state is estimated, taken out of the navigation state at once and is zero again, so only
its covariance is propagated.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.base import LENT_ROWS, Innovation, Linearised, NotApplicable
from fusiond.estimators.base import THRESHOLDS, ErrorStateFilter, Outcome
from fusiond.estimators.screening import KEPT
from fusiond.estimators.update import Plain, fuse, work
from fusiond.models.model import Model


class KalmanEstimator(ErrorStateFilter):
    """The centralised filter (`fusiond.estimators.base.Estimator`)."""

    def __init__(self, model: Model, gap_s: float, shares: tuple[float, ...] = (1.0,)) -> None:
        super().__init__(model, gap_s, shares)
        self._work = [work(rows, model.width) for rows in range(LENT_ROWS + 1)]
        none = np.empty(0, dtype=np.int64)
        self._plain = Plain(
            *(self.nav, self.xi, self.step, self._cov, self._dx),
            *(model.column_of, model.initial, model.hold_height),
            *(none.reshape(2, 0), none, none, none),
            np.empty(LENT_ROWS * (3 + model.size + model.width)),
        )

    def update(self, aid: Linearised) -> Outcome:
        """Fold one aid in, or name why not."""
        return self._fold_in(aid)

    def plain(self) -> Plain | None:
        """For kernels that do what `update` does; None where it does something else."""
        return None if self._holding else self._plain

    def _fold_in(self, aid: Linearised) -> Outcome:
        innovation = self._linearise(aid)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        if aid.screened:
            return self._update_by_rows(aid, innovation)
        z, h, r = innovation
        degrees = z.shape[0]
        threshold = THRESHOLDS[aid.gate, degrees]
        y, g = self._work[degrees] if degrees <= LENT_ROWS else work(degrees, self.model.width)
        nav, xi, cov, dx = self.nav, self.xi, self._cov, self._dx
        nis = fuse(nav, xi, cov, dx, z, h, r, threshold, self._holding, y, g)
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
        cov[:] = s.cov
        dx[:] = s.dx
        if not self._holding:
            self._feed_back(dx)
            dx[:] = 0.0
        return Outcome("fused", s.nis, kept, tuple(s.y.tolist()), codes)

    def hold(self) -> None:
        """From now on estimate without feedback: errors are carried along with the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back what was carried."""
        self._holding = False
        self._feed_back(self._dx)
        self._dx[:] = 0.0
