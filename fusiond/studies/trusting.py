"""A timeline without isolation, for experiments on filters that are wrong by design."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Aid, State
from fusiond.estimators.base import Outcome
from fusiond.integrity.action import Action
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.series import Said
from fusiond.models.model import Model

Array = NDArray[np.float64]


class Trusting(Isolation):
    """Leaves all to the filter: its gate, and what detects faults in a federated one."""

    def judge(
        self,
        aid: Aid,
        outcome: Outcome,
        nav: Array,
        covariance: Array | None = None,
        state: State | None = None,
        says: Said | None = None,
    ) -> Action:
        """Nobody is ever suspected."""
        return Action.NONE

    def corrected(self, t_ns: int, nav: Array, covariance: Array, turned: float = 0.0) -> Action:
        """Nor is the IMU."""
        return Action.NONE

    def ordinary(self, aid: Aid, model: Model, tilts: bool) -> None:
        """None is judged as it is folded in."""
        return None
