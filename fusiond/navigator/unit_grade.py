r"""Grade of an inertial unit within its class: the factor of its errors.

A class is wide: sheets state limits, and a unit that somebody calls `consumer` may be ten times
better. What a drive shows of biases and scale factors tells how good this one is. With b^ and P as
the filter has them and s their prior sigma, the drive alone says b~ of variance R,

    1 / R = 1 / P - 1 / s^2,   b~ = b^ R / P,   b~ ~ N(0, g s^2 + R)

g the grade, of variances, alike for all that the class says: who makes a better sensor trims it
better, and aligns it better. That is an assumption, and what it is for is what no drive shows: by
how much axes are out of square. g is as likely at first in each octave of `GRID`; what counts is
E[g]. What a state has hardly shown (R above s^2) weighs by itself little.

At rest, before there is a filter, the gyros show their biases, and the force along the vertical
that of one accelerometer (`graded_at_rest`). That is four values, and what counts of them is the
bias of the other two accelerometers, which nothing shows before the vehicle turns. So there gyros
and accelerometers have a grade each, which lie apart by `SPREAD`:

    ln g_f = ln g_w + N(0, SPREAD^2)

Of units of a fifth and a third of their class's sigmas the square of what is not seen is then 0.79
and 0.89 of what it counts as in the mean, of those that are just as their class says 1.18 (tested):
there up to twice its sigmas count.

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
    """Errors as they are seen (k,), the class's variances of them, and those of what they are seen
    with."""

    seen: Array
    prior: Array
    noise: Array

    def log_likelihood(self) -> Array:
        """Of each grade of `GRID`, up to a constant."""
        variance = GRID[:, None] * self.prior + self.noise
        found: Array = -0.5 * (np.log(variance) + np.square(self.seen) / variance).sum(axis=1)
        return found


def graded_at_rest(rates: Values, force: Values) -> Array:
    """Grades (13,) as of `AS_ITS_CLASS`: by the rates of all gyros at rest, and by the force along
    the vertical. Axes are as good as what is worse of the two."""
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
        """The filter has begun with these grades (13,) of what it does not know by anything else;
        what is worse than its class is of the one that it is as bad as."""
        self._prior = self._sheet * grades[self._column]
        self._class = self._sheet * np.maximum(grades, 1.0)[self._column]

    def of(self, xi: Array, covariance: Array) -> float:
        """E[g] by parameters (n,) and P (n, n); no unit is taken to be worse than its class."""
        p = covariance[self._slots, self._slots]
        shown = (p > 0.0) & (p < self._prior)
        p, prior = p[shown], self._prior[shown]
        r = p * prior / (prior - p)
        estimate = xi[self._slots][shown] * r / p
        log_likelihood = Values(estimate, self._class[shown], r).log_likelihood()
        return min(_expected(log_likelihood, np.ones(len(GRID))), 1.0)
