r"""Grade of an inertial unit within its class: the factor of its errors.

A class states limits; a unit of class `consumer` may be ten times better. Biases and scale factors
of a drive show the grade of this unit. From the filter's b^ and P and the prior sigma s, the drive
alone gives b~ of variance R,

    1 / R = 1 / P - 1 / s^2,   b~ = b^ R / P,   b~ ~ N(0, g s^2 + R)

g is the grade, a factor on variances, common to all errors of the class. This assumes that a maker
of better sensors also trims and aligns them better; it is needed for the axes' deviation from
square, which no drive shows. The prior of g is uniform by octave of `GRID`; E[g] is used. A state
that was hardly observed (R above s^2) has little weight.

At rest, before the filter starts, the gyros show their biases, and the vertical force that of one
accelerometer (`graded_at_rest`): four values. The grade is needed for the other two accelerometers,
whose bias does not show before the vehicle turns. So there gyros and accelerometers have a grade
each, which differ by `SPREAD`:

    ln g_f = ln g_w + N(0, SPREAD^2)

For units with a fifth and a third of their class's sigmas the mean square of the unseen errors is
then 0.79 and 0.89 of its assumed value, for units exactly of their class 1.18 (tested), where up to
twice the class's sigmas are assumed.

Source: Gelman, Carlin, Stern, Dunson, Vehtari, Rubin, Bayesian Data Analysis, 3rd ed. (2013),
section 5.4 (hierarchical normal model with unknown scale).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.models.model import Model
from fusiond.navigation.error_model import COLUMN_END, RATE_ERROR

Array = NDArray[np.float64]

GRID: Final = 4.0 ** np.arange(-4.0, 1.1, 0.25)
"""Grades: a sixteenth of the sigmas of the class to twice those. The classes are six to ninety
times apart from each other."""
SPREAD: Final = math.log(2.0)
"""One sigma of the logarithm of what the grades of gyros and accelerometers of a unit are apart by:
a factor of 1.4 of their sigmas. That of a class to the next is 2.5 and 10, in gyros 6 and 90."""
AS_ITS_CLASS: Final = np.ones(COLUMN_END - RATE_ERROR + 1)
"""Grades of a unit of which nothing was seen: of rate and force bias, and scale factors of both,
three axes each, and of how far those are out of square."""


class Values(NamedTuple):
    """Observed errors (k,), their variances by the class, and their measurement variances."""

    seen: Array
    prior: Array
    noise: Array

    def log_likelihood(self) -> Array:
        """Log likelihood of each grade of `GRID`, up to a constant."""
        variance = GRID[:, None] * self.prior + self.noise
        found: Array = -0.5 * (np.log(variance) + np.square(self.seen) / variance).sum(axis=1)
        return found


def graded_at_rest(rates: Values, force: Values) -> Array:
    """Grades (13,) as of `AS_ITS_CLASS`: by the rates of all gyros at rest, and by the force along
    the vertical. Axes have the worse grade of the two."""
    of_rates, of_force = rates.log_likelihood(), force.log_likelihood()
    alike = np.exp(-0.5 * np.square(np.log(GRID[:, None] / GRID) / SPREAD))
    alike /= alike.sum(axis=0)
    gyros = _expected(of_rates, alike @ _weights(of_force))
    accelerometers = _expected(of_force, alike @ _weights(of_rates))
    grades = np.repeat([gyros, accelerometers, gyros, accelerometers], 3)
    return np.append(grades, max(gyros, accelerometers))


def _weights(log_likelihood: Array) -> Array:
    weight = np.exp(log_likelihood - log_likelihood.max())
    normalised: Array = weight / weight.sum()
    return normalised


def _expected(log_likelihood: Array, prior: Array) -> float:
    """E[g]."""
    weight = prior * _weights(log_likelihood)
    return float(weight @ GRID / weight.sum())


class UnitGrade:
    """Grade of a unit whose errors are states of `model`."""

    def __init__(self, model: Model) -> None:
        columns = range(RATE_ERROR, COLUMN_END)
        slots = [(s, column - RATE_ERROR) for column in columns for s in model.parameters(column)]
        self._slots, self._column = np.array(slots, dtype=np.int64).reshape(-1, 2).T.copy()
        self._sheet = np.square(model.initial[self._slots])
        self._class = self._prior = self._sheet
        """Variances of the class, and those that the filter has begun with."""

    def begin(self, grades: Array) -> None:
        """Start with grades (13,) of the unobserved errors; a unit worse than its class has the
        class that it fits."""
        self._prior = self._sheet * grades[self._column]
        self._class = self._sheet * np.maximum(grades, 1.0)[self._column]

    def of(self, xi: Array, covariance: Array) -> float:
        """E[g] from parameters (n,) and P (n, n), at most that of the class."""
        p = covariance[self._slots, self._slots]
        shown = (p > 0.0) & (p < self._prior)
        p, prior = p[shown], self._prior[shown]
        r = p * prior / (prior - p)
        estimate = xi[self._slots][shown] * r / p
        log_likelihood = Values(estimate, self._class[shown], r).log_likelihood()
        return min(_expected(log_likelihood, np.ones(len(GRID))), 1.0)
