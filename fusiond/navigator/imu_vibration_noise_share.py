r"""Share of the IMU noise that integrates into attitude and velocity, estimated from predictions.

Vibration in the samples bounds the noise of a sensor (fusiond.navigation.vibration). Part of it is
real motion, and part averages out over longer times than the bound uses. Neither the samples nor
single innovations show how much, as a filter that follows its fixes hides it. So a second filter
propagates the state for `EVERY_NS` without measurements. Its covariance is A without sample noise,
A + B with the assumed noise; P is that of the filter, which uses the measurements:

    d = v_predicted - v,   var(d) = A + (g / g_0) B - P,        P' - P of estimates that are optimal

g is the share to be estimated and g_0 the one in use, each forward, to the right and down: the
noise of the pitch gyro acts forward, and road and springs pitch a vehicle differently than they
roll it. Log likelihoods of predictions that do not overlap are summed on a grid of g with a uniform
prior; E[g] is used. Noise of the data sheet always counts.

A prediction is no evidence if the filter itself had no measurements, P above `KNOWN` of A + B. It
uses data older than `SETTLES_NS`, before which nothing arrives any more, so the order of arrival
does not matter.

Source: Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Trans. AC 15
(1970), for predictions over several steps; Magill, Optimal adaptive estimation of sampled
stochastic processes, IEEE Trans. AC 10 (1965), for the weights of a grid of models.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.fix_error_correlation import SETTLES_NS
from fusiond.estimators.base import Estimator
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.model import Model
from fusiond.navigation.error_model import DV, PHI
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import Q0, VN

Array = NDArray[np.float64]

EVERY_NS = 10_000_000_000
"""Length of a prediction. After ten seconds the noise of a shaken gyro is most of what a velocity
is wrong by."""
COUNTS_NS = SETTLES_NS + EVERY_NS
"""Delay after a prediction's end from which its result counts for samples: many of them may have
arrived when it is judged, and another prediction needs one share throughout."""
GRID: Final = 2.0 ** -np.arange(0.0, 10.5, 0.5)
"""Shares of the density: all of it, down to a thirtieth of the sigma."""
KNOWN = 0.25
"""Share of a predicted variance: no more may be left of the velocity's with measurements."""
HEADING_SD_RAD = math.radians(5.0)
"""Largest heading sigma for which velocity errors are linear in the heading."""
FORGETS = 60.0
"""Predictions after which old ones are forgotten, ten minutes: streets and loads change."""
FIRST = 2.0
"""Prior weight of full noise, in predictions: a filter that was too sure of its tilt once stays so.
"""
RARE = 25.0
"""Five sigma: what is beyond is no noise."""
_NOTHING = 1e18
"""Share of negligible noise."""
_VELOCITY = slice(DV, DV + 3)
_SHOWN_BY = ((0, 1), (1, 0), (5, 2))
"""Sensor (of rates and forces) and velocity axis, forward, right or down, that reveal its noise:
gravity acts forward with a pitch and to the right with a roll. Other sensors' noise is small beside
it and keeps its full value."""


class _Predictor(KalmanEstimator):
    """Two covariances along one state: without noise, and with the assumed noise."""

    def __init__(self, model: Model, gap_s: float) -> None:
        super().__init__(model, gap_s, (_NOTHING, 1.0))

    def begin(self, e: Estimator) -> None:
        """Start from another estimator's state."""
        self.initialise(e.t_ns, e.sample, e.nav, e.xi, e.covariance)
        self.step[:] = e.state.step
        n = self.model.size
        self._covs[:, :n, :n] = e.covariance

    @property
    def of_velocity(self) -> Array:
        """Covariance of the velocity without noise and with it (2, 3, 3)."""
        return self._covs[:, _VELOCITY, _VELOCITY]


class NoiseShares:
    """Noise shares of one unit, by predictions of `EVERY_NS`."""

    def __init__(self, model: Model, gap_s: float) -> None:
        self._predictor = _Predictor(model, gap_s)
        self._log = np.zeros((3, len(GRID)))
        self._count = 0.0
        self._counted = [(0, np.ones(3))]
        """Start (ns) of each share's validity, while predictions may need it."""
        self._begins_ns = -1
        """Begin of the prediction that is under way; -1 where none is."""

    @property
    def shown(self) -> tuple[float, tuple[float, ...]]:
        """Number of predictions, and log likelihoods of `GRID` of each axis, for the next start."""
        log = self._log - self._log.max(axis=1, keepdims=True)
        return self._count, tuple(log.ravel().tolist())

    def take_up(self, predictions: float, log_likelihoods: tuple[float, ...]) -> Array:
        """Resume with another drive's result; the shares (6,) in force."""
        self._count = predictions
        self._log = np.array(log_likelihoods).reshape(3, -1)
        shares = self._shares()
        self._counted = [(0, shares)]
        return _of_sensors(shares)

    def restart(self) -> None:
        """Restart with the filter; the present prediction is dropped."""
        self._begins_ns = -1

    def begin(self, e: Estimator) -> None:
        """Start a prediction from the filter's state, if the heading is known."""
        known = bool(e.covariance[PHI + 2, PHI + 2] < HEADING_SD_RAD**2)
        self._begins_ns = e.t_ns if known else -1
        if known:
            self._predictor.begin(e)

    def carry(self, imu: ImuBuffer, t_ns: int) -> None:
        """Propagate the prediction to an instant."""
        if self._begins_ns >= 0:
            self._predictor.propagate(imu, t_ns)

    def end(self, e: Estimator) -> Array | None:
        """Compare the prediction with the filter's state at its end; return the shares (6,) to use
        after `COUNTS_NS`, None without a result."""
        p, since_ns = self._predictor, self._begins_ns
        self._begins_ns = -1
        if since_ns < 0 or e.t_ns - since_ns != EVERY_NS or p.t_ns != e.t_ns:
            return None
        level = _level_axes(e.nav)
        error = level @ (p.nav[VN : VN + 3] - e.nav[VN : VN + 3])
        known, without, whole = (
            np.diagonal(level @ each @ level.T)
            for each in (e.covariance[_VELOCITY, _VELOCITY], *p.of_velocity)
        )
        if known.sum() > KNOWN * whole.sum():
            return None
        counted = next(shares for at, shares in reversed(self._counted) if at <= since_ns)
        of_noise = (whole - without) / counted
        variance = (without - known)[:, None] + of_noise[:, None] * GRID
        variance = np.maximum(variance, known[:, None])
        kept = 1.0 - 1.0 / FORGETS
        self._log *= kept
        squares = np.minimum(error[:, None] ** 2 / variance, RARE)
        self._log -= 0.5 * (np.log(variance) + squares)
        self._count = kept * self._count + 1.0
        shares = self._shares()
        self._counted = [*self._counted[-3:], (e.t_ns + COUNTS_NS, shares)]
        return _of_sensors(shares)

    def _shares(self) -> Array:
        """Shares of noise that acts forward, to the right and down."""
        weight = np.exp(self._log - self._log.max(axis=1, keepdims=True))
        mean = weight @ GRID / weight.sum(axis=1)
        found: Array = (self._count * mean + FIRST) / (self._count + FIRST)
        return found


def _of_sensors(shares: Array) -> Array:
    """Shares of rates and forces (6,)."""
    found = np.ones(6)
    for sensor, axis in _SHOWN_BY:
        found[sensor] = shares[axis]
    return found


def _level_axes(nav: Array) -> Array:
    """Rows forward, right and down of a level vehicle, in north, east, down (3, 3)."""
    w, x, y, z = nav[Q0 : Q0 + 4].tolist()
    along, across = 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
    size = math.hypot(along, across)
    c, s = (along / size, across / size) if size > 0.0 else (1.0, 0.0)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
