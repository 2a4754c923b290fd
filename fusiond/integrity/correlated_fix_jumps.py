r"""Jumps of positions within a receiver's shared error, which are not a fault.

Successive fixes share an error s b, b ~ N(0, S) of a Gauss-Markov process, which the filter
estimates (fusiond.aiding.position). A drift that is too slow to be told, or other satellites than
before, brings b^ far from zero; when that is over the fixes jump. A jump of j +- M can be a fault
of any size, j ~ N(0, S_0), or b has begun anew and is as it may be:

    o = s b^ + j ~ N(0, C),   C = s S s + P + M          P of the position

    log odds = (log det S_0 - log det C - o^T C^-1 o) / 2

of the second against the first; both begin equally often. A fault of positions may be a drift,
which explains the fixes better than any jump does while it goes on: by so much less likely is the
second. If it is the likelier, nobody is left out: b^ is zero, and open by S once more. What it was
correlated with remains in P, so that the position learns less from the next fixes than it might.

Source: a Bayes factor of two models of the same jump, as of fusiond.estimators.fault_odds.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation import PositionCandidate
from fusiond.estimators.base import Estimator
from fusiond.estimators.fault_bank_interface import Estimated
from fusiond.integrity.catalogue import POSITION_SD_M

PLACE = slice(6, 9)
"""Slots of the position in the error state."""


def renewed_slots(
    measurement: AidingMeasurement, estimator: Estimator, step: Estimated, less: float
) -> list[int]:
    """Slots of a shared error that has been renewed.

    None, unless that is likelier than a fault of positions, which a `step` of them explains by so
    much `less` (log likelihood) than the best of such faults does."""
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
