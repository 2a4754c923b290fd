r"""Federated filter with a reset after each fusion: `fusion_reset` and `zero_reset`.

After a fusion, and as all are propagated alike, until the next,

    x_i = x_g,   P_i = P_g / beta_i

so a local filter need not be kept: it is made from the master when its measurement comes, updated,
and fused with what the others know together, (1 - beta_i) P_g^-1. A measurement that is common to
all adds R / beta_i to each, which is R to the master. The result is the centralised filter's but
for rounding, whatever the factors are. In `zero_reset` the master has all: beta_i = 0. A local
filter that begins with no information holds, after its measurement, that of the measurement, H^T
R^-1 H, and the master that adds it makes a measurement update: so that is what is done.

The difference of a local filter and the others is its last innovation again, so that the difference
test has nothing to say here, and what a fault has done before it was noticed is in the master.

Source: Carlson, IEEE Trans. AES 26 (1990), 517.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation
from fusiond.estimators.federated.bank import publish
from fusiond.estimators.federated.filter import FederatedFilter

Array = NDArray[np.float64]

UPDATED, OTHERS = 0, 1


class ResetFilter(FederatedFilter):
    """`fusion_reset` and `zero_reset` (`fusiond.estimators.base.Estimator`)."""

    @property
    def _estimates(self) -> int:
        return 2

    def _fold(self, local: int | None, i: Innovation) -> str:
        if local is None or self.options.mode == "zero_reset":
            self._fuse_into(self._covs[0], self._dxs[0], i)
            self._feed_back_published()
            if local is not None:
                self._faults.received(local, self.t_ns)
            return "fused"
        share = float(self._factors[local])
        self._bank[UPDATED] = self._covs[0] / share
        self._bank[OTHERS] = self._covs[0]
        self._bank_dxs[:] = self._dxs[0]
        self._weight[:] = 1.0, 1.0 - share
        self._fuse_into(self._bank[UPDATED], self._bank_dxs[UPDATED], i)
        if not self._combine():
            return "not_positive_definite"
        self._faults.received(local, self.t_ns)
        if self.options.adaptive and share < 1.0:
            trace = self._trace[OTHERS] / self._factors
            trace[local] = self._trace[UPDATED]
            self._adapt(trace)
        publish(self._covs[0], self._dxs[0], self._order, self._fused, self._estimate)
        self._feed_back_published()
        return "fused"

    def _share_out(self, parts: Array) -> None:
        super()._share_out(parts)
        if self.options.mode == "zero_reset":
            self._factors[:] = 0.0

    def _take_back(self, local: int) -> None:
        self._share_out(self._nominal)

    def _leave_out(self, local: int) -> None:
        """Do nothing: the published estimate took no part in this update."""
