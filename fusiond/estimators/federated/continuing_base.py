"""Common base of federated filters whose local filters continue after a fusion.

Between updates only the published covariance B and the transition matrix Phi are propagated; at an
update the local filters follow. After it the local filter that was updated is compared with the
others, and the fused estimate is published.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.federated.filter import FederatedFilter
from fusiond.estimators.federated.isolation import DIFFERENCE

Array = NDArray[np.float64]


class CarriedFilter(FederatedFilter):
    """Common part of the filters that keep local filters between fusions.

    `_before` is B at the instant at which the local filters hold, `_phi` Phi since then.
    """

    carries_transition = True

    def _arrange(self, used: NDArray[np.bool_]) -> None:
        super()._arrange(used)
        width = self.model.width
        self._unit: Array = np.eye(width)
        self._before: Array = np.zeros((width, width))

    def _mark(self) -> None:
        """The local filters hold at the present."""
        self._phi[:] = self._unit
        self._before[:] = self._covs[0]

    def _bring_up(self) -> None:
        """Bring the local filters to the present."""
        raise NotImplementedError

    def _fuse(self) -> bool:
        """Fuse the local filters; False if the result is no covariance."""
        raise NotImplementedError

    def _difference(self, k: int) -> float:
        """Statistic d^T cov(d)^-1 d of filter k and the best of all others, on position and
        velocity."""
        raise NotImplementedError

    def _take_over(self, updated: int | None) -> None:
        """Publish the fused estimate."""
        raise NotImplementedError

    def _fuse_all(self, updated: int | None) -> str:
        """Fuse, compare the local filter that was updated, publish; the outcome's name."""
        if not self._fuse():
            return "not_positive_definite"
        if updated is not None and self.options.fault_detection:
            worst = self._worst(updated)
            if worst is not None and self._isolate(worst, DIFFERENCE):
                return "isolated" if worst == updated else "fused"
        self._take_over(updated)
        return "fused"

    def _worst(self, updated: int) -> int | None:
        """Local filter with the largest failed statistic, if the updated one fails at all."""
        believed = self._believed()
        own = self._difference(updated)
        if self._faults.worst(dict.fromkeys(believed, own), self._tested) is None:
            return None
        return self._faults.worst({i: self._difference(i) for i in believed}, self._tested)

    def _shift(self, x: Array) -> None:
        self._bank_dxs -= x

    def release(self) -> None:
        """Feed back the held estimate."""
        self._bring_up()
        super().release()

    def _kept_arrays(self) -> tuple[Array, ...]:
        return *super()._kept_arrays(), self._bank_dxs, self._before, self._phi
