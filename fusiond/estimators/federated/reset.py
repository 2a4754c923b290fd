r"""Federated filter with a reset after each fusion: `fusion_reset` and `zero_reset`.

After a fusion, and until the next one, as all are propagated alike,

    x_i = x_g,   P_i = P_g / beta_i

so a local filter need not be stored: it is made from the master when its measurement comes,
updated, and fused with the information of all others, (1 - beta_i) P_g^-1. A common measurement is
applied with R / beta_i to each, which is R to the master. The result is that of the centralised
filter, to rounding, for any factors. In `zero_reset` the master has all information: beta_i = 0. A
local filter that starts without information holds H^T R^-1 H after its measurement; adding it to
the master is a measurement update, which is what this filter does.

The difference of a local filter from the others is its last innovation again, so the difference
test gives nothing here, and the effect of a fault before its detection is in the master.

Source: Carlson, IEEE Trans. AES 26 (1990), 517.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Innovation
from fusiond.estimators.federated.filter import FederatedFilter
from fusiond.estimators.federated.fusion_kernels import publish

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
