"""What goes wrong without anybody having thought of it: an aid that raises, a filter of no numbers.

An exception costs the aid that raised it, never the tick. A filter that has lost its numbers never
gets them back: it is started anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fusiond.estimators.base import Estimator

RAISED_BY_NUMBERS = (ArithmeticError, ValueError)
"""What numerics raise: division by zero and overflow; domain errors and numpy's LinAlgError."""


def broken(estimator: Estimator) -> str | None:
    """What of the filter's state is not finite; None where all is.

    A sum is finite only if every number is, and an update carries a covariance that is none to its
    diagonal: at each tick this costs some microseconds.
    """
    if not math.isfinite(estimator.nav.sum()):
        return "the navigation state is not finite"
    if not math.isfinite(estimator.xi.sum()):
        return "the estimated parameters are not finite"
    if not math.isfinite(np.trace(estimator.covariance)):
        return "the covariance is not finite"
    return None


class FailedAids:
    """Tells once of each source of which an aid raised."""

    def __init__(self, tell: Callable[[str, str], None]) -> None:
        self._tell = tell
        self._known: set[str] = set()

    def tell(self, source: str, error: str) -> None:
        """An aid of `source` is `failed` for `error`."""
        if source not in self._known:
            self._known.add(source)
            self._tell("aid_failed", f"{source} could not be used: {error}")
