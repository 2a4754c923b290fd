r"""Direction of travel: least-squares fit of measured to sensed changes of velocity.

    v(t_k) = v_0 + C_0 a_k + g t_k + C_k (w_k x l) + (C_k (f_k - b_f) + g) tau
    a_k = int C(0, t) (f - b_f) dt

C_0 attitude at the first fix, C(0, t) its change by the gyros (less b_w), l the antenna's lever,
tau the time from the velocities' stamps to their validity. Unknown are v_0, the rotation vector phi
of C_0 = exp(phi) R_z(yaw_0), b_f, b_w and tau, with the data sheet's biases, a road's slope, the
course's sigma and that of the receiver's offset as priors (pulling away by 3 m/s^2 with velocities
that are 0.1 s late gains 0.3 m/s too much, in 5 s a third of a degree of tilt); C(0, t) is
re-integrated with the estimated rate bias, as 3 deg/s turn the axes by a radian in 20 s. At the
last fix the attitude is C_T = C_0 C(0, T), and its error follows from those of C_0 and b_w,

    phi_T = phi + C_0 D db_w,   D = d C(0, T) / d b_w as a rotation vector (3, 3)

so phi_T is estimated in place of phi: a vehicle at rest shows nothing of its yaw rate bias before
it drives off, and a fixed C_0 would turn everything after. Tilt and biases have a common
covariance: straight on, a tilt is known no better than the accelerometers' bias, and the sum of
both far better. The cost J of the best fit is twice the negative log likelihood, up to a constant
that forward (yaw_0 by the course) and backward (half a turn more) share, so that

    ln L_forward - ln L_backward = (J_backward - J_forward) / 2

distinguishes them while the vehicle brakes, accelerates or turns, but not straight on at constant
speed.

With a bias of up to 6 deg/s, which turns the axes by 100 deg in 17 s, Gauss-Newton from zero
sometimes finds another minimum (tilts 39 deg off at a stated 0.7). So the last seconds are fitted
first, then spans of doubled length, each from the fit before; a fit that has not converged starts
no filter.

Source: Wu and Pan, Velocity/position integration formula part I, IEEE T-AES 49 (2013), for the
integral form of an alignment in motion; Groves, 2nd ed., section 5.6.3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.models.blocks import ImuNoise
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.motion_descent import BIASES, DELAY, FIRST, PRIORS, SOUGHT, descend
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigator.alignment.sensed_motion import Measured, Past, Sensed, stretch

Array = NDArray[np.float64]

# One sigma (rad) of how a road and a vehicle's body on it slope: 10 %, beyond which streets are
# signposted.
TILT_SD_RAD = 0.1
# Three sigma of a rate bias turn the axes by so much (rad) over the last fixes, which are fitted
# first: half its square, a tenth, is what a linearisation about no bias leaves out.
FIRST_RAD = 0.5


class Fit(NamedTuple):
    """The best fit under one hypothesis: cost, degrees of freedom, attitude C_nb (3, 3) at the last
    fix, biases (6,) of force and rate, the velocities' offset in time (s), covariance (10, 10) of
    them all. `converged`: the fit is the best; otherwise its cost is an upper bound."""

    cost: float
    degrees: int
    dcm: Array
    biases: Array
    delay_s: float
    covariance: Array
    converged: bool


def fit(
    past: Past,
    f: Sensed,
    m: Measured,
    noise: ImuNoise,
    g: float,
    yaw: float,
    sd_yaw: float,
    sd_delay_s: float = 0.0,
) -> Fit:
    """Best fit from `f`, with `yaw` (rad) at the last fix and its sigma `sd_yaw`.

    Velocities are delayed by 0, to within `sd_delay_s`."""
    force = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    rate = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    # The offset in its sigmas: one that is known has a column of zeros.
    prior = np.array([TILT_SD_RAD] * 2 + [sd_yaw] + [force] * 3 + [rate] * 3 + [1.0])
    asked = Asked(noise, g, yaw, prior, sd_delay_s)
    here = Guess(dcm_from_rpy(0.0, 0.0, yaw), f.biases, 0.0, m.velocity[0])
    for part in _parts(m, rate):
        started = stretch(past, part.instants).sensed(here.biases)
        here = _descend(started, part, asked, here.since(part)).here
    found = _descend(f, m, asked, here.since(m))
    here, scale = found.here, np.array([1.0] * 9 + [sd_delay_s])
    known = np.asarray(np.linalg.inv(found.rows.T @ found.rows), np.float64)[:10, :10]
    return Fit(
        cost=float(found.z @ found.z),
        degrees=max(1, m.velocity.size - 3),
        dcm=here.last,
        biases=here.biases,
        delay_s=sd_delay_s * here.delay,
        covariance=known * np.outer(scale, scale),
        converged=found.converged,
    )


class Asked(NamedTuple):
    """Constants of a fit: IMU noise, gravity, heading (rad) at the last fix, one sigma of the
    priors (10,) and of the velocities' offset in time (s)."""

    noise: ImuNoise
    g: float
    yaw: float
    prior: Array
    sd_delay_s: float

    def packed(self) -> Array:
        """(15,) for `descend`."""
        n, rate = self.noise, STANDARD_GRAVITY_M_S2 * self.noise.rate_noise
        white = [n.force_noise**2, rate**2 / 3.0]
        return np.concatenate([self.prior, [self.yaw, self.g, self.sd_delay_s], white])


class Descent(NamedTuple):
    """State of Gauss-Newton: the guess, its slopes (3 k + 10, 13) and its residuals (3 k + 10,), in
    sigmas."""

    here: Guess
    rows: Array
    z: Array
    converged: bool


def _parts(m: Measured, rate_sd: float) -> list[Measured]:
    """Last fixes over spans that double.

    The first span is one in which a rate bias turns the axes by `FIRST_RAD` at most; the last is
    shorter than that of all."""
    found: list[Measured] = []
    span_s = FIRST_RAD / (3.0 * rate_sd) if rate_sd > 0.0 else math.inf
    since_s = (m.instants[-1] - m.instants) * 1e-9
    while span_s < since_s[0]:
        rows = since_s <= span_s
        if rows.sum() > 1:
            found.append(Measured(*(column[rows] for column in m)))
        span_s *= 2.0
    return found


def _descend(f: Sensed, m: Measured, asked: Asked, here: Guess) -> Descent:
    """Minimise by Gauss-Newton from a guess with fit `f`."""
    of, rows = f.of, 3 * len(m.velocity) + PRIORS
    z, slopes, guess = np.empty(rows), np.empty((rows, SOUGHT)), here.packed()
    converged = descend(
        *(of.times, of.samples, of.counts, of.t_s, of.means),
        *(f.gained, f.turned, f.slopes, f.biases),
        *(m.velocity, m.sd, m.levers),
        *(asked.packed(), guess, z, slopes),
    )
    return Descent(Guess.of(guess), slopes, z, converged)


class Guess(NamedTuple):
    """Guess: attitude C_nb (3, 3) at the last fix, biases (6,) of force and rate, offset in time in
    sigmas, velocity (3,) at the first fix."""

    last: Array
    biases: Array
    delay: float
    first: Array

    def since(self, m: Measured) -> Guess:
        """Guess for a span that starts at the first of `m`."""
        return self._replace(first=m.velocity[0])

    def packed(self) -> Array:
        """(19,) for `descend`."""
        return np.concatenate([self.last.ravel(), self.biases, [self.delay], self.first])

    @staticmethod
    def of(packed: Array) -> Guess:
        """Unpack a guess."""
        delay = float(packed[DELAY])
        return Guess(packed[:BIASES].reshape(3, 3), packed[BIASES:DELAY], delay, packed[FIRST:])
