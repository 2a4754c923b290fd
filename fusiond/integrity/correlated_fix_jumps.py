r"""Jumps of positions within a receiver's shared error, distinguished from faults.

Successive fixes share an error s b, b ~ N(0, S) of a Gauss-Markov process, which the filter
estimates (fusiond.aiding.position). A drift too slow to be detected, or a change of satellites,
moves b^ far from zero; when it ends, the fixes jump. A jump of j +- M is either a fault of any
size, j ~ N(0, S_0), or b has restarted from its prior:

    o = s b^ + j ~ N(0, C),   C = s S s + P + M          P of the position

    log odds = (log det S_0 - log det C - o^T C^-1 o) / 2

of the restart against the fault; both start equally often. A fault of positions may be a drift,
which explains the fixes better than any jump while it lasts; the restart is less likely by that
ratio. If the restart is likelier, no source is excluded: b^ becomes zero with covariance S. Its
former correlations remain in P, so that the position learns less from the next fixes than it could.

Source: a Bayes factor of two models of the same jump, as of fusiond.estimators.fault_odds.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import PositionCandidate
from fusiond.estimators.base import Estimator
from fusiond.estimators.fault_bank_interface import Estimated
from fusiond.integrity.catalogue import POSITION_SD_M

PLACE = slice(6, 9)
"""Slots of the position in the error state."""


def renewed_slots(
    measurement: AidingMeasurement, estimator: Estimator, step: Estimated, less: float
) -> list[int]:
    """Slots of a shared error that has been renewed.

    Empty unless a restart is likelier than a fault of positions. `less`: log likelihood of the best
    such fault minus that of a `step`."""
    place = next((c for c in measurement.candidates() if isinstance(c, PositionCandidate)), None)
    if place is None:
        return []
    model = estimator.model
    slots = [slot for name in place.bias for slot in model.slots_of(name)]
    if len(slots) != len(step.size):
        return []
    share, p = np.array(place.bias_share), estimator.covariance[PLACE, PLACE]
    offset = share @ estimator.xi[slots] + step.size
    c = p + step.covariance + (share * model.noise[2, slots]) @ share.T
    gained = sum(math.log(sd) for sd in POSITION_SD_M) - 0.5 * math.log(np.linalg.det(c)) - less
    gained -= 0.5 * float(offset @ np.linalg.solve(c, offset))
    return slots if gained > 0.0 else []
