r"""Which way a moving vehicle faces: felt against measured changes of velocity, by least squares.

    v(t_k) = v_0 + C_0 a_k + g t_k + C_k (w_k x l) + (C_k (f_k - b_f) + g) tau
    a_k = int C(0, t) (f - b_f) dt

C_0 attitude at the first fix, C(0, t) its change by the gyros (less b_w), l the antenna's lever,
tau how much later than their stamps the velocities are valid. v_0, the rotation vector phi of
C_0 = exp(phi) R_z(yaw_0), b_f, b_w and tau are sought, with the data sheet's biases, a road's
slope, the course's sigma and that of the receiver's offset as priors (pulling away by 3 m/s^2 with
velocities that are 0.1 s late gains 0.3 m/s too much, in 5 s a third of a degree of tilt); C(0, t)
is integrated anew with the rate bias found, for 3 deg/s turn the axes by a radian in 20 s. At the
last fix the attitude is C_T = C_0 C(0, T), and its error follows from those of C_0 and b_w,

    phi_T = phi + C_0 D db_w,   D = d C(0, T) / d b_w as a rotation vector (3, 3)

so what is sought is phi_T in place of phi: a vehicle that stood before it drove off tells nothing
of its yaw rate's bias until then, and a C_0 that is held would turn all that came after. Tilt and
biases come with the covariance that they share: straight on, a tilt is known no better than the
accelerometers' bias, and the sum of both far better. The cost J of the best fit is twice
the negative log likelihood, up to a constant that forward (yaw_0 by the course) and backward (half
a turn more) share, so that

    ln L_forward - ln L_backward = (J_backward - J_forward) / 2

tells them apart: braking, accelerating and bends do; straight on at constant speed does not.

Source: Wu and Pan, Velocity/position integration formula part I, IEEE T-AES 49 (2013), for the
integral form of an alignment in motion; Groves, 2nd ed., section 5.6.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.offers import VelocityOffer
from fusiond.models.blocks import ImuNoise
from fusiond.navigation.alignment import integrate_felt
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    rotation_vector_to_quaternion,
    wrap_angle,
)
from fusiond.navigator.alignment.start import velocity_of

Array = NDArray[np.float64]

# One sigma (rad) of how a road and a vehicle's body on it slope: 10 %, beyond which streets are
# signposted.
TILT_SD_RAD = 0.1
# Steps of Gauss-Newton at most, and the one, in sigmas, that ends them.
ITERATIONS, CONVERGED = 16, 0.1
# The integrals are made anew where the rate bias found would turn the axes by more (rad) than those
# that they were made with: what is left out is half its square, 0.3 %.
BENT_RAD = 0.08
# (a x b)_i = CROSS_ijk a_j b_k.
CROSS = np.zeros((3, 3, 3))
CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0
# A rate or a force at an instant is the mean of so much (ns) to each side.
AROUND_NS = 100_000_000
# A velocity below so many of its sigmas is none.
STILL_SIGMAS = 3.0
MOST_FIXES = 20
"""Of the fixes, evenly: more add little, for their changes are alike."""


class Past(Protocol):
    """IMU samples of some seconds: times (m,) ns, rate and force (m, 6), the row of the first
    later than an instant."""

    @property
    def times(self) -> NDArray[np.int64]: ...

    @property
    def samples(self) -> Array: ...

    def index_after(self, t_ns: int) -> int: ...


@dataclass(frozen=True, slots=True)
class Span:
    """A `Past` that stays as it is."""

    times: NDArray[np.int64]
    samples: Array

    def index_after(self, t_ns: int) -> int:
        """Row of the first sample later than `t_ns`."""
        return int(np.searchsorted(self.times, t_ns, side="right"))


class Measured(NamedTuple):
    """Velocities of k fixes: instants (k,) ns, NED (k, 3), one sigma (k, 3), levers (k, 3)."""

    instants: NDArray[np.int64]
    velocity: Array
    sd: Array
    levers: Array


class Felt(NamedTuple):
    """Integrals from the first fix to each of k, with a rate bias (3,) taken off: times (k,) s,
    gained velocity (k, 3) and attitude (k, 3, 3) in the axes of the first, slopes of the velocity
    by force and rate bias (k, 3, 6), rates and forces at the fixes (k, 3)."""

    t_s: Array
    gained: Array
    turned: Array
    slopes: Array
    rates: Array
    forces: Array
    bias: Array

    @property
    def turns(self) -> Array:
        """Slopes (3, 3) of the last attitude, a rotation vector in the axes of the first, by rate
        bias: those of the velocity by force bias."""
        turns: Array = self.slopes[-1][:, :3]
        return turns


class Fit(NamedTuple):
    """The best fit under one hypothesis: cost, degrees of freedom, attitude C_nb (3, 3) at the last
    fix, biases (6,) of force and rate, the velocities' offset in time (s), covariance (10, 10) of
    them all."""

    cost: float
    degrees: int
    dcm: Array
    biases: Array
    late_s: float
    covariance: Array


def span_since(imu: ImuBuffer, t_ns: int) -> Span:
    """A copy of the samples from an instant on, and of what `rate_at` it looks at."""
    first = max(0, imu.index_after(t_ns - AROUND_NS) - 1)
    return Span(imu.times[first : imu.end].copy(), imu.samples[first : imu.end].copy())


def measured(fixes: Sequence[VelocityOffer]) -> Measured:
    """What some fixes say."""
    found = [velocity_of(x) for x in fixes]
    return Measured(
        np.array([x.t_ns for x in fixes]),
        np.array([v for v, _ in found]),
        np.array([sd for _, sd in found]),
        np.array([x.lever for x in fixes]),
    )


def rate_before_motion(past: Past, m: Measured) -> Array:
    """Mean rate (3,) over the first of the fixes, as long as they say that it stands: what a
    linearisation about no bias would have to find in the dark, 60 deg of turning for 3 deg/s in
    20 s. Nothing if it never stood."""
    beyond = np.abs(m.velocity) > STILL_SIGMAS * m.sd
    moves = beyond[:, 0] | beyond[:, 1]
    stood = int(np.argmax(moves)) if moves.any() else len(moves)
    first, end = past.index_after(int(m.instants[0])), past.index_after(int(m.instants[stood - 1]))
    if stood < 2 or end <= first:
        return np.zeros(3)
    mean: Array = past.samples[first:end, :3].mean(axis=0)
    return mean


def rate_at(past: Past, t_ns: int) -> Array:
    """Mean rate (3,) around an instant."""
    return samples_at(past, t_ns)[:3]


def samples_at(past: Past, t_ns: int) -> Array:
    """Mean (6,) of the samples around an instant, as many as there are."""
    first = max(0, past.index_after(t_ns - AROUND_NS) - 1)
    end = max(first + 1, past.index_after(t_ns + AROUND_NS))
    mean: Array = past.samples[first:end].mean(axis=0)
    return mean


def felt(past: Past, instants: NDArray[np.int64], bias: Array) -> Felt:
    """What the IMU felt from the first of instants (k,) to each, less a rate bias (3,)."""
    first, end = past.index_after(int(instants[0])), past.index_after(int(instants[-1]))
    times = np.concatenate((instants[:1], past.times[first:end]))
    at = np.searchsorted(times[1:], instants, side="right")
    gained, turned = np.empty((len(at), 3)), np.empty((len(at), 3, 3))
    slopes = np.empty((len(at), 3, 6))
    integrate_felt(times, past.samples[first:end], bias, at, gained, turned, slopes)
    t_s = (instants - instants[0]) * 1e-9
    means = _samples_at(past, instants)
    return Felt(t_s, gained, turned, slopes, means[:, :3] - bias, means[:, 3:], bias)


def _samples_at(past: Past, instants: NDArray[np.int64]) -> Array:
    """`samples_at` (k, 6) of instants (k,) in their order."""
    low = max(0, past.index_after(int(instants[0]) - AROUND_NS) - 1)
    end = past.index_after(int(instants[-1]) + AROUND_NS)
    times = past.times[low:end]
    before = np.maximum(0, np.searchsorted(times, instants - AROUND_NS, side="right") - 1)
    after = np.maximum(before + 1, np.searchsorted(times, instants + AROUND_NS, side="right"))
    sums = np.zeros((end - low + 1, 6))
    np.cumsum(past.samples[low:end], axis=0, out=sums[1:])
    means: Array = (sums[after] - sums[before]) / (after - before)[:, None]
    return means


def fit(
    past: Past,
    f: Felt,
    m: Measured,
    noise: ImuNoise,
    g: float,
    yaw: float,
    sd_yaw: float,
    sd_late_s: float = 0.0,
) -> Fit:
    """The best fit with `yaw` (rad) at the last fix, to within `sd_yaw`, and velocities that are
    late by 0, to within `sd_late_s`, begun at `f`."""
    white = noise.force_noise**2 * f.t_s
    white += (STANDARD_GRAVITY_M_S2 * noise.rate_noise) ** 2 * f.t_s**3 / 3.0
    weight = 1.0 / np.sqrt(m.sd**2 + white[:, None])
    force = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    rate = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    # The offset in its sigmas: one that is known has a column of zeros.
    prior = np.array([TILT_SD_RAD] * 2 + [sd_yaw] + [force] * 3 + [rate] * 3 + [1.0])
    gained = m.velocity - np.outer(f.t_s, [0.0, 0.0, g])
    biases = np.concatenate([np.zeros(3), f.bias])
    here = Guess(dcm_from_rpy(0.0, 0.0, yaw), biases, 0.0, m.velocity[0])
    for _ in range(ITERATIONS):
        if np.abs(here.biases[3:] - f.bias).max() * f.t_s[-1] > BENT_RAD:
            f = felt(past, m.instants, here.biases[3:])
        dcm, there = _since_first(f, m, here)
        while_late = sd_late_s * _accelerations(f, dcm, here, g)
        h = np.zeros((len(there), 3, 13))
        h[:, :, :3] = np.einsum("ijk,mk->mij", CROSS, there)  # d(exp(phi) u) = dphi x u
        h[:, :, 3:9] = dcm @ f.slopes
        h[:, :, 6:9] -= h[:, :, :3] @ (dcm @ f.turns)
        h[:, :, 9] = while_late
        h[:, :, 10:] = np.eye(3)
        h *= weight[:, :, None]
        rows = np.vstack([h.reshape(-1, 13), np.hstack([np.diag(1.0 / prior), np.zeros((10, 3))])])
        z = (gained - here.first - there - here.late * while_late) * weight
        z = np.concatenate([z.ravel(), here.apart(yaw) / prior])
        step = np.linalg.lstsq(rows, z, rcond=None)[0]
        here = here.moved(step)
        if np.linalg.norm(rows @ step) < CONVERGED:
            break
    dcm, there = _since_first(f, m, here)
    while_late = sd_late_s * _accelerations(f, dcm, here, g)
    z = (gained - here.first - there - here.late * while_late) * weight
    cost = float((z**2).sum() + ((here.apart(yaw) / prior) ** 2).sum())
    scale = np.array([1.0] * 9 + [sd_late_s])
    covariance = np.linalg.inv(rows.T @ rows)[:10, :10] * np.outer(scale, scale)
    late_s = sd_late_s * here.late
    return Fit(cost, max(1, z.size - 3), here.last, here.biases, late_s, covariance)


class Guess(NamedTuple):
    """Attitude C_nb (3, 3) at the last fix, biases (6,) of force and rate, offset in time in
    sigmas, velocity (3,) at the first fix."""

    last: Array
    biases: Array
    late: float
    first: Array

    def moved(self, step: Array) -> Guess:
        """By a step (13,)."""
        last = _turn(step[:3]) @ self.last
        late = self.late + float(step[9])
        return Guess(last, self.biases + step[3:9], late, self.first + step[10:])

    def apart(self, yaw: float) -> Array:
        """How far the priors (10,) are: level, `yaw` (rad), no biases, no offset."""
        c = self.last
        apart = wrap_angle(yaw - math.atan2(c[1, 0], c[0, 0]))
        return np.concatenate([[c[1, 2], -c[0, 2], apart], -self.biases, [-self.late]])


def _since_first(f: Felt, m: Measured, here: Guess) -> tuple[Array, Array]:
    """C_0 (3, 3), and the velocity (k, 3) gained since the first fix but for gravity's, with the
    antenna's about the IMU."""
    more = here.biases[3:] - f.bias
    dcm = here.last @ (_turn(f.turns @ more) @ f.turned[-1]).T
    levers = np.einsum("ijk,mj,mk->mi", CROSS, f.rates, m.levers)
    arms = (f.turned @ levers[:, :, None])[:, :, 0]
    return dcm, (f.gained + f.slopes @ np.concatenate([here.biases[:3], more]) + arms) @ dcm.T


def _accelerations(f: Felt, dcm: Array, here: Guess, g: float) -> Array:
    """Of the body, NED (k, 3) at the fixes, with C_0 (3, 3)."""
    forces = (dcm @ f.turned) @ (f.forces - here.biases[:3])[:, :, None]
    accelerations: Array = forces[:, :, 0] + [0.0, 0.0, g]
    return accelerations


def _turn(phi: Array) -> Array:
    x, y, z = (float(v) for v in phi)
    return dcm_from_quaternion(np.array(rotation_vector_to_quaternion(x, y, z)))
