r"""Grade of an inertial unit within its class: the factor of its errors.

A class is wide: sheets state limits, and a unit that somebody calls `consumer` may be ten times
better. What a drive shows of biases and scale factors tells how good this one is. With b^ and P as
the filter has them and s their prior sigma, the drive alone says b~ of variance R,

    1 / R = 1 / P - 1 / s^2,   b~ = b^ R / P,   b~ ~ N(0, g s^2 + R)

g the grade, of variances, alike for all that the class says: who makes a better sensor trims it
better, and aligns it better. That is an assumption, and what it is for is what no drive shows: by
how much axes are out of square. g is as likely at first in each octave of `GRID`; what counts is
E[g]. What a state has hardly shown (R above s^2) weighs by itself little.

Source: Gelman, Carlin, Stern, Dunson, Vehtari, Rubin, Bayesian Data Analysis, 3rd ed. (2013),
section 5.4 (hierarchical normal model with unknown scale).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.navigation.error_model import COLUMN_END, RATE_ERROR

Array = NDArray[np.float64]

GRID: Final = 4.0 ** np.arange(-4.0, 1.1, 0.25)
"""Grades: from a sixteenth to twice the sigmas of the class. Classes differ by factors of six to
ninety."""


class UnitGrade:
    """Grade of a unit whose errors are states of `model`."""

    def __init__(self, model: Model) -> None:
        slots = [s for column in range(RATE_ERROR, COLUMN_END) for s in model.parameters(column)]
        self._slots = np.array(slots, dtype=np.int64)
        self._prior = np.square(model.initial[self._slots])

    def of(self, xi: Array, covariance: Array) -> float:
        """E[g] by parameters (n,) and P (n, n); no unit is taken to be worse than its class."""
        p = covariance[self._slots, self._slots]
        shown = (p > 0.0) & (p < self._prior)
        p, prior = p[shown], self._prior[shown]
        r = p * prior / (prior - p)
        estimate = xi[self._slots][shown] * r / p
        variance = GRID[:, None] * prior + r
        log = -0.5 * (np.log(variance) + estimate**2 / variance).sum(axis=1)
        weight = np.exp(log - log.max())
        return min(float(weight @ GRID / weight.sum()), 1.0)
