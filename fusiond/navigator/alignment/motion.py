r"""Which way a moving vehicle faces: felt against measured changes of velocity, by least squares.

    v(t_k) = v_0 + C_0 a_k + g t_k + C_k (w_k x l),   a_k = int C(0, t) (f - b_f) dt

C_0 attitude at the first fix, C(0, t) its change by the gyros (less b_w), l the antenna's lever.
v_0, the rotation vector phi of C_0 = exp(phi) R_z(yaw_0), b_f and b_w are sought, with the data
sheet's biases, a road's slope and the course's sigma as priors. The cost J of the best fit is twice
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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.offers import VelocityOffer
from fusiond.models.blocks import ImuNoise
from fusiond.navigation.alignment import integrate_from_rest
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    rotation_vector_to_quaternion,
)
from fusiond.navigator.alignment.start import velocity_of

Array = NDArray[np.float64]

# One sigma (rad) of how a road and a vehicle's body on it slope: 10 %, beyond which streets are
# signposted.
TILT_SD_RAD = 0.1
# Steps for the slopes by the biases: m/s^2 and rad/s. The integral is all but linear in them.
FORCE_STEP, RATE_STEP = 0.1, 1e-3
ITERATIONS = 4
MOST_FIXES = 20
"""Of the fixes, evenly: more add little, for their changes are alike."""


class Felt(NamedTuple):
    """Integrals from the first fix to each of k: times (k,) s, gained velocity (k, 3) and attitude
    (k, 3, 3) in the axes of the first, slopes of the velocity by force and rate bias (k, 3, 6),
    rates at the fixes (k, 3)."""

    t_s: Array
    gained: Array
    turned: Array
    slopes: Array
    rates: Array


class Fit(NamedTuple):
    """The best fit under one hypothesis: cost, degrees of freedom, attitude C_nb (3, 3) at the last
    fix, sigma (rad) of its yaw, gyro bias (3,)."""

    cost: float
    degrees: int
    dcm: Array
    sd_yaw: float
    rate_bias: Array


def rate_at(imu: ImuBuffer, t_ns: int) -> Array:
    """Mean rate (3,) of the samples around an instant: 0.1 s to each side, as many as there are."""
    first = max(0, imu.index_after(t_ns - 100_000_000) - 1)
    end = max(first + 1, imu.index_after(t_ns + 100_000_000))
    mean: Array = imu.samples[first:end, :3].mean(axis=0)
    return mean


def felt(imu: ImuBuffer, instants: Sequence[int]) -> Felt:
    """What the IMU felt from the first instant to each."""
    first, end = imu.index_after(instants[0]), imu.index_after(instants[-1])
    times = np.concatenate(([instants[0]], imu.times[first:end]))
    samples = imu.samples[first:end]
    at = [imu.index_after(t) - first for t in instants]
    zero = np.zeros(3)
    gained, turned = _integrate(times, samples, at, zero)
    slopes = np.empty((len(at), 3, 6))
    for axis in range(3):
        shifted = samples.copy()
        shifted[:, 3 + axis] -= FORCE_STEP
        slopes[:, :, axis] = (_integrate(times, shifted, at, zero)[0] - gained) / FORCE_STEP
        bias = zero.copy()
        bias[axis] = RATE_STEP
        slopes[:, :, 3 + axis] = (_integrate(times, samples, at, bias)[0] - gained) / RATE_STEP
    t_s = (np.array(instants) - instants[0]) * 1e-9
    return Felt(t_s, gained, turned, slopes, np.array([rate_at(imu, t) for t in instants]))


def _integrate(
    times: NDArray[np.int64], samples: Array, at: Sequence[int], bias: Array
) -> tuple[Array, Array]:
    q, velocity = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    gained, turned = np.empty((len(at), 3)), np.empty((len(at), 3, 3))
    before = 0
    for k, row in enumerate(at):
        if row > before:
            part = np.ascontiguousarray(samples[before:row])
            integrate_from_rest(times[before : row + 1], part, bias, q, 0.0, velocity)
        before = max(before, row)
        gained[k], turned[k] = velocity, dcm_from_quaternion(q)
    return gained, turned


def fit(
    f: Felt, fixes: Sequence[VelocityOffer], noise: ImuNoise, g: float, yaw: float, sd_yaw: float
) -> Fit:
    """The best fit with `yaw` (rad) at the last fix, to within `sd_yaw`."""
    measured = np.array([velocity_of(x)[0] for x in fixes])
    sd = np.array([velocity_of(x)[1] for x in fixes])
    white = noise.force_noise**2 * f.t_s
    white += (STANDARD_GRAVITY_M_S2 * noise.rate_noise) ** 2 * f.t_s**3 / 3.0
    weight = 1.0 / np.sqrt(sd**2 + white[:, None])
    force = math.hypot(noise.force_bias_initial, noise.force_bias_instability)
    rate = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    prior = np.array([TILT_SD_RAD] * 2 + [sd_yaw] + [force] * 3 + [rate] * 3)
    turned_yaw = math.atan2(f.turned[-1, 1, 0], f.turned[-1, 0, 0])
    base = dcm_from_rpy(0.0, 0.0, yaw - turned_yaw)
    levers = np.array([np.cross(w, x.lever) for w, x in zip(f.rates, fixes, strict=True)])
    arms = (f.turned @ levers[:, :, None])[:, :, 0]
    down = np.outer(f.t_s, [0.0, 0.0, g])
    x = np.zeros(12)  # phi, b_f, b_w, v_0
    x[9:] = measured[0]
    count = len(fixes)
    for _ in range(ITERATIONS):
        dcm = _turn(x[:3]) @ base
        body = f.gained + f.slopes @ x[3:9] + arms
        there = body @ dcm.T
        z = (measured - (x[9:] + there + down)) * weight
        h = np.zeros((count, 3, 12))
        for axis in range(3):  # d(exp(phi) u) = dphi x u
            h[:, :, axis] = np.cross(np.eye(3)[axis], there)
        h[:, :, 3:9] = dcm @ f.slopes
        h[:, :, 9:] = np.eye(3)
        h *= weight[:, :, None]
        rows = np.vstack([h.reshape(-1, 12), np.hstack([np.diag(1.0 / prior), np.zeros((9, 3))])])
        x += np.linalg.lstsq(rows, np.concatenate([z.ravel(), -x[:9] / prior]), rcond=None)[0]
    dcm = _turn(x[:3]) @ base
    there = (f.gained + f.slopes @ x[3:9] + arms) @ dcm.T
    z = (measured - (x[9:] + there + down)) * weight
    cost = float((z**2).sum() + ((x[:9] / prior) ** 2).sum())
    covariance = np.linalg.inv(rows.T @ rows)
    degrees = max(1, z.size - 3)
    return Fit(cost, degrees, dcm @ f.turned[-1], math.sqrt(covariance[2, 2]), x[6:9])


def _turn(phi: Array) -> Array:
    x, y, z = (float(v) for v in phi)
    return dcm_from_quaternion(np.array(rotation_vector_to_quaternion(x, y, z)))
