"""Unexpected failures: a measurement that raises, a filter with values that are not finite.

An exception costs the measurement that raised it, never the tick. A filter with values that are not
finite is restarted, as it cannot recover.
"""

from __future__ import annotations

from collections.abc import Callable

from fusiond.estimators.base import Estimator
from fusiond.estimators.finite_check import first_not_finite

_STATE = "the navigation state is", "the estimated parameters are", "the covariance is"
RAISED_BY_NUMBERS = (ArithmeticError, ValueError)
"""Exceptions of numerics: division by zero and overflow; domain errors and numpy's LinAlgError."""


def broken(estimator: Estimator) -> str:
    """Name of the first part of the filter's state that is not finite.

    An update spreads an invalid covariance to its diagonal, which is checked.
    """
    what = first_not_finite(estimator.nav, estimator.xi, estimator.covariance)
    return f"{_STATE[what]} not finite"


class FailedMeasurements:
    """Reporter of sources with a measurement that raised an exception, once each."""

    def __init__(self, report: Callable[[str, str], None]) -> None:
        self._report = report
        self._known: set[str] = set()

    def report(self, source: str, error: str) -> None:
        """Report a measurement of `source` that `failed` with `error`."""
        if source not in self._known:
            self._known.add(source)
            self._report("measurement_failed", f"{source} could not be used: {error}")
