r"""Zero-velocity and zero-rate updates, once the vehicle is confirmed at rest.

    z = v^ - 0 = dv + v
    z = mean of w^ over the window - C^T w_ie = e + C^T (w_ie x phi) + v

e is the error of the gyros. At rest the navigation equations have phi' = -(C e + w_ie x phi) = -C
z, without the heading. A row with e alone would take the Earth's rate on level gyros for their
error; the level, which turns with it, would then show a false heading for any gyro, 5 deg to 4.4 in
200 s. With the column of phi only independent information on e shows a heading, as in
gyrocompassing: sigma_e / (w_ie cos lat), 6 deg for 1 deg/h.

The mean rate is that of a window in which the sensor was quiet (fusiond.navigation.standstill). A
quiet window alone is no rest: a smooth ride is as quiet. Rest, v = 0 and w = 0, is a hypothesis
that each of these may refute (`Rest.doubt`):

    |v^| > v_max,  or  v^T P_vv^-1 v^ > chi2(0.9999)        `moving`    the filter's own velocity
    the mean of measured speeds is not zero, whatever
    drifts, in the run of windows or in this one          `moving`    (fusiond.aiding.rest_evidence)
    |mean w - b^ - C^T w_ie| > 3 sqrt(P_bb + (s_n^2 + s_r^2) / k)   `turning`    unless the speed is
                                                                    known to be zero
    the same mean is not zero, if nothing drifts          `moving`
    the ride is smooth, and neither sqrt(P_vv) nor the
    sigma of a mean of measured speeds is below s_v       `quiet_at_speed`

The tests are in this order: a wheel that may have drifted prevents a claim of rest, but not the
test of the gyros. v_max is the largest speed of a vehicle that creeps, s_v the sigma of the zero
velocity, s_r of the rate of a vehicle at rest, all configured; s_n the gyro's noise in a window, k
the number of windows in a row (one, and up to ten). The bias's P is at the start that of the data
sheet: a turn within it cannot be distinguished from a bias. Once quiet windows have occurred at
speed, the last test requires evidence as good as the measurement's claim.

A vehicle that passes the tests may still creep, at a speed of sigma s_v, and in a bend: its rate
about the down axis has sigma s_v / R at most, R the least radius of a car. A creep is not uniform:
as a first-order process of correlation time T it scatters over k windows of a second by

    E S^2 = sigma^2 (1 - c),   c = 2 / (k (k - 1)) sum_d (k - d) exp(-d / T)

so that a run with scatter S turns with sigma^2 = S^2 / (1 - c) (k - 1) / q at most, q the 5 %
quantile of chi-square of k - 1. The lesser of the two adds to the variance of the zero rate: with
unknown speed it dominates in the first window, and vanishes after five seconds at rest.

Source: Groves, 2nd ed., section 15.3.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.base import (
    AidingMeasurement,
    Innovation,
    NotApplicable,
    State,
    Vector3,
    rate_columns,
)
from fusiond.aiding.rest_evidence import Measured, RestEvidence
from fusiond.navigation.chi_square import quantile
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.error_model import PHI
from fusiond.navigation.rotation import skew
from fusiond.navigation.standstill import Window
from fusiond.navigation.strapdown import LAT, VN

Array = NDArray[np.float64]

# Against the filter's own velocity: rest is refused once in ten thousand windows.
VELOCITY_PROBABILITY = 1e-4
# Against the bias's sigma, each axis.
RATE_SIGMAS = 3.0
TURNING = "turning"
# The least turning radius of a car (m), and how long (s) a rate of turn lasts in a car that creeps.
LEAST_RADIUS_M = 5.0
CREEP_LASTS_S = 3.0
# A run scatters by less than its turn would make it once in twenty.
SCATTERS = 0.95


def _earth_rate(state: State) -> Array:
    """w_ie (3,), north, east, down."""
    lat = state.nav[LAT]
    return EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])


def _rate_error(state: State, mean_rate: Array) -> Array:
    """Mean rates (3,) or (k, 3) minus the estimated bias and the Earth's rate."""
    bias = np.array([sum(state.xi[s] for s in state.model.parameters(9 + j)) for j in range(3)])
    error: Array = mean_rate - bias - state.dcm.T @ _earth_rate(state)
    return error


def _normalised(v: list[float], p: list[list[float]], least: float) -> float:
    """v^T (P + least I)^-1 v of a few axes, by elimination; a tenth of the time of numpy's solver.
    Overwrites its input."""
    square = 0.0
    for k, row in enumerate(p):
        pivot = row[k] + least
        square += v[k] ** 2 / pivot
        for i in range(k + 1, len(p)):
            share = p[i][k] / pivot
            v[i] -= share * v[k]
            for j in range(k + 1, len(p)):
                p[i][j] -= share * row[j]
    return square


@lru_cache(maxsize=64)
def _evenly(windows: int, window_s: float) -> float:
    """Ratio of the mean scatter of a creep's windows to the variance of its turn, at most."""
    lags = range(1, windows)
    alike = sum((windows - d) * math.exp(-d * window_s / CREEP_LASTS_S) for d in lags)
    alike *= 2.0 / (windows * (windows - 1))
    return (windows - 1) / quantile(windows - 1, SCATTERS) / (1.0 - alike)


@immutable()
class Rest:
    """The hypothesis that the vehicle stood in a quiet window; sigmas of the module's text."""

    window: Window
    rest_evidence: RestEvidence
    max_speed_m_s: float
    velocity_sd_m_s: float
    rate_sd_rad_s: float
    noise_sd_rad_s: float
    window_s: float = 1.0

    def doubt(self, state: State) -> str | None:
        """Name of the refutation of rest; None without one."""
        p, w = state.covariance, self.window
        if p is None:
            return "moving" if state.speed > self.max_speed_m_s else None
        rows = 2 if state.model.hold_height else 3
        v, p_v = state.nav[VN : VN + rows], p[3 : 3 + rows, 3 : 3 + rows]
        sd = math.sqrt(max(p_v[0, 0], p_v[1, 1]))
        self.rest_evidence.quiet_at_speed(w.end_ns, state.speed - 3.0 * sd > self.max_speed_m_s)
        if state.speed > self.max_speed_m_s:
            return "moving"
        # A tenth of the sigma that the measurement claims, beside P: a filter that is surer is not.
        least = (0.1 * self.velocity_sd_m_s) ** 2
        square = _normalised(v.tolist(), p_v.tolist(), least)
        measured = self._measured(w.run)
        # A vehicle that turns back has a mean of nothing; the last window alone has not.
        lately = self._measured(1)
        surely = measured.surely or lately.surely
        if square > quantile(rows, VELOCITY_PROBABILITY) or surely:
            return "moving"
        known = min(sd, measured.sd) <= self.velocity_sd_m_s
        # Where the speed is known to be zero a turn is the gyros': their rows say so.
        if not known and self._turns(state, p):
            return TURNING
        if measured.contradicts or lately.contradicts:
            return "moving"
        if not known and self.rest_evidence.smooth_ride(w.end_ns):
            return "quiet_at_speed"
        return None

    def _measured(self, windows: int) -> Measured:
        """Number of windows in the last measurement."""
        end_ns = self.window.end_ns
        return self.rest_evidence.measured(end_ns - round(windows * self.window_s * 1e9), end_ns)

    def creeps(self, state: State) -> Array:
        """Variances (3,), rad^2/s^2, of a possible slow turn although rest is not refuted."""
        p, w = state.covariance, self.window
        if p is None:
            return np.zeros(3)
        sd = min(math.sqrt(max(p[3, 3], p[4, 4])), self._measured(w.run).sd)
        turns = (sd / LEAST_RADIUS_M) ** 2
        down = np.square(state.dcm[2])
        if w.run > 1:
            turns = min(turns, float(w.scatter @ down) * _evenly(w.run, self.window_s))
        creeps: Array = turns * down
        return creeps

    def _turns(self, state: State, p: Array) -> bool:
        """True if an axis has turned in the window, or in the run of windows, by more than bias and
        noise allow."""
        w, free = self.window, self.rate_sd_rad_s**2 + self.noise_sd_rad_s**2
        errors = _rate_error(state, np.array((w.mean_rate, w.run_rate))).tolist()
        for axis in range(3):
            slots, variance = state.model.parameters(9 + axis), 0.0
            for i in slots:
                for j in slots:
                    variance += float(p[i, j])
            for error, count in zip(errors, (1, w.run), strict=True):
                if error[axis] ** 2 > RATE_SIGMAS**2 * (variance + free / count):
                    return True
        return False


@immutable()
class ZeroVelocityUpdate(AidingMeasurement):
    """Zero velocity with `sd_m_s`."""

    constraint: ClassVar[bool] = True

    sd_m_s: float
    rest: Rest

    @property
    def rests_s(self) -> float:
        """Duration (s) of proven rest: to the next window, with half a window's tolerance."""
        return 1.5 * self.rest.window_s

    def innovation(self, state: State) -> Innovation | NotApplicable:
        doubt = self.rest.doubt(state)
        if doubt is not None:
            return NotApplicable(doubt)
        rows = 2 if state.model.hold_height else 3
        h = np.zeros((rows, state.model.size))
        for i in range(rows):
            h[i, 3 + i] = 1.0
        return Innovation(state.nav[VN : VN + rows].copy(), h, np.full(rows, self.sd_m_s**2))


@immutable()
class ZeroAngularRateUpdate(AidingMeasurement):
    """Raw mean rate (rad/s, body axes) of a quiet window; `sd_rad_s`: sigma of the vehicle's own
    turn."""

    constraint: ClassVar[bool] = True

    mean_rate: Vector3
    sd_rad_s: float
    rest: Rest

    def innovation(self, state: State) -> Innovation | NotApplicable:
        doubt = self.rest.doubt(state)
        if doubt is not None:
            return NotApplicable(doubt)
        model = state.model
        h = np.zeros((3, model.size))
        rate_columns(h, slice(None), model, np.eye(3))
        h[:, PHI : PHI + 3] = state.dcm.T @ skew(_earth_rate(state))
        z = _rate_error(state, np.array(self.mean_rate))
        return Innovation(z, h, self.sd_rad_s**2 + self.rest.creeps(state))
