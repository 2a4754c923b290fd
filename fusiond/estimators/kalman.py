r"""Extended Kalman filter on the error state, closed loop: one filter for all aids.

The error state is estimated, taken out of the navigation state at once and is zero again, so only
its covariance is propagated.

Source: Groves, 2nd ed., sections 3.2.6 and 14.1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation, Linearised, NotApplicable
from fusiond.estimators.base import ErrorStateFilter, Outcome, gate_threshold
from fusiond.estimators.screening import KEPT
from fusiond.estimators.update import fuse

Array = NDArray[np.float64]


class KalmanEstimator(ErrorStateFilter):
    """The centralised filter (`fusiond.estimators.base.Estimator`)."""

    def update(self, aid: Linearised, inflate: bool = False) -> Outcome:
        """Fold one aid in, or name why not. With `inflate`, a failed gate widens P and passes."""
        innovation = self._linearise(aid)
        if isinstance(innovation, NotApplicable):
            return Outcome(innovation.outcome)
        cov, dx = self._covs[0], self._dxs[0]
        if aid.screened:
            return self._update_by_rows(aid, innovation, inflate)
        z, h, r = innovation
        degrees = z.shape[0]
        threshold = gate_threshold(aid.gate, degrees)
        y = np.zeros(degrees)
        nis = fuse(self.nav, self.xi, cov, dx, z, h, r, threshold, self._holding, y)
        if nis <= threshold:
            return Outcome("fused", nis, degrees, tuple(y.tolist()))
        if not math.isfinite(nis):
            return Outcome("not_finite", nis, degrees)
        if not inflate:
            return Outcome("gated", nis, degrees)
        self._widen(cov, z - h @ dx, h)
        fuse(self.nav, self.xi, cov, dx, z, h, r, math.inf, self._holding, y)
        return Outcome("fused", nis, degrees)

    def _update_by_rows(self, aid: Linearised, rows: Innovation, inflate: bool) -> Outcome:
        """Rows that pass are folded in; none, or with `inflate` as many as a wider P lets."""
        cov, dx = self._covs[0], self._dxs[0]
        s = self._screen(aid, rows, cov, dx)
        kept = s.codes == KEPT
        if inflate and 2 * int(kept.sum()) < len(kept):
            self._widen(cov, rows.z - rows.h @ dx, rows.h)
            s = self._screen(aid, rows, cov, dx)
            kept = s.codes == KEPT
        codes = tuple(s.codes.tolist())
        if not kept.any():
            return Outcome("gated", s.nis, 0, (), codes)
        cov[:] = s.cov
        dx[:] = s.dx
        if not self._holding:
            self._feed_back(dx)
            dx[:] = 0.0
        return Outcome("fused", s.nis, int(kept.sum()), tuple(s.y.tolist()), codes)

    def _linearise(self, aid: Linearised) -> Innovation | NotApplicable:
        """The aid's innovation, linear in the error state."""
        return aid.innovation(self.state)

    def hold(self) -> None:
        """From now on estimate without feedback: errors are carried along with the state."""
        self._holding = True

    def release(self) -> None:
        """Feed back what was carried."""
        self._holding = False
        self._feed_back(self._dxs[0])
        self._dxs[0] = 0.0
