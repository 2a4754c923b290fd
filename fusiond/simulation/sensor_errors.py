r"""Errors of inertial sensors and aids, as the configuration's error model states them.

    y = (1 + s) x + b + n + m
    n   white, sigma = N / sqrt(dt)                            N angle or velocity random walk
    b'  = -b / T + w,  q = 2 sigma_b^2 / T                     bias, b(0) ~ N(0, sigma_0)
    s'  = -s / T_s + w_s,  q = 2 sigma_s^2 / T_s               scale factor, s(0) ~ N(0, sigma_s)
    m   engine vibration, a sine of random phase, averaged over the sample interval

sigma_b is the bias instability and sigma_0 the turn-on bias of `fusiond.config.Imu`, T its
`bias_correlation_s`: one Gauss-Markov process whose start is more uncertain than its steady state,
which is also what the filter assumes. Errors act in sensor axes.

Source: Groves, 2nd ed., sections 4.4 and 14.2.6; IEEE Std 952-1997 annex B for the noise units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from fusiond.config import Imu
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.simulation.trajectories import dcm_from_rpy

Array = NDArray[np.float64]

DEG = math.pi / 180.0
DEG_PER_HOUR = DEG / 3600.0
DEG_PER_SQRT_HOUR = DEG / 60.0
"""deg/sqrt(h) in rad/sqrt(s)."""
METRES_PER_S_PER_SQRT_HOUR = 1.0 / 60.0
MILLI_G = 1e-3 * STANDARD_GRAVITY_M_S2


def gauss_markov(
    rng: np.random.Generator,
    shape: tuple[int, int],
    *,
    step_s: float,
    correlation_s: float,
    sigma: float,
    initial_sigma: float | None = None,
) -> Array:
    """First-order Gauss-Markov processes (n, columns), sampled every `step_s`.

    `sigma` is the steady state's; the first row has `initial_sigma` where that is given.
    `correlation_s` 0 gives white noise.
    """
    n, columns = shape
    decay = math.exp(-step_s / correlation_s) if correlation_s > 0.0 else 0.0
    drive = rng.standard_normal((n, columns)) * (sigma * math.sqrt(1.0 - decay * decay))
    first = sigma if initial_sigma is None else initial_sigma
    drive[0] = rng.standard_normal(columns) * first
    process: Array = lfilter([1.0], [1.0, -decay], drive, axis=0)
    return process


@dataclass(frozen=True, slots=True)
class Vibration:
    """Engine vibration at the IMU: amplitudes (each axis) and frequency."""

    accel_m_s2: float = 0.0
    gyro_rad_s: float = 0.0
    frequency_hz: float = 27.3


@dataclass(frozen=True, slots=True)
class ImuOutput:
    """Rows (n, 3) in sensor axes: what the IMU says, and the biases it had while saying it."""

    gyro: Array
    accel: Array
    gyro_bias: Array
    accel_bias: Array


def body_to_sensor(imu: Imu) -> Array:
    """Matrix (3, 3) that turns body axes into sensor axes, from `axes` and `mounting_deg`."""
    nominal_to_sensor = np.zeros((3, 3))
    for row, name in enumerate(imu.axes):
        nominal_to_sensor["xyz".index(name[-1]), row] = -1.0 if name.startswith("-") else 1.0
    mounting = np.radians(np.asarray(imu.mounting_deg, dtype=np.float64))
    body_to_nominal = dcm_from_rpy(mounting[None, :])[0].T
    matrix: Array = nominal_to_sensor @ body_to_nominal
    return matrix


def imu_output(
    imu: Imu,
    gyro: Array,
    accel: Array,
    rng: np.random.Generator,
    *,
    vibration: Vibration | None = None,
    misalignment_deg: float = 0.0,
    gyro_step_rad_s: float = 0.0,
    accel_step_m_s2: float = 0.0,
) -> ImuOutput:
    """Turn ideal means in body axes (n, 3) at `imu.rate_hz` into what this IMU would send.

    `misalignment_deg` is one sigma of each small angle between a sensor's axes and its nominal
    ones, `*_step_*` the resolution of its output (0: none). The same `rng` state, the same bytes.
    """
    n, dt = len(gyro), 1.0 / imu.rate_hz
    vibration = vibration or Vibration()
    phase = rng.uniform(0.0, 2.0 * math.pi, 6)
    omega = 2.0 * math.pi * vibration.frequency_hz
    average = math.sin(0.5 * omega * dt) / (0.5 * omega * dt)
    middle = (np.arange(n) + 0.5)[:, None] * dt
    matrix = body_to_sensor(imu)
    outputs: list[tuple[Array, Array]] = []
    for truth, noise, bias, initial, scale_ppm, amplitude, step, phases in (
        (
            gyro,
            imu.gyro_noise_deg_sqrt_h * DEG_PER_SQRT_HOUR,
            imu.gyro_bias_instability_deg_h * DEG_PER_HOUR,
            imu.gyro_bias_initial_deg_h * DEG_PER_HOUR,
            imu.gyro_scale_ppm,
            vibration.gyro_rad_s,
            gyro_step_rad_s,
            phase[:3],
        ),
        (
            accel,
            imu.accel_noise_m_s_sqrt_h * METRES_PER_S_PER_SQRT_HOUR,
            imu.accel_bias_instability_mg * MILLI_G,
            imu.accel_bias_initial_mg * MILLI_G,
            imu.accel_scale_ppm,
            vibration.accel_m_s2,
            accel_step_m_s2,
            phase[3:],
        ),
    ):
        misaligned = np.eye(3)
        misaligned[~np.eye(3, dtype=bool)] = rng.standard_normal(6) * misalignment_deg * DEG
        value = truth @ (misaligned @ matrix).T
        if amplitude > 0.0:
            value += amplitude * average * np.sin(omega * middle + phases)
        biases = gauss_markov(
            rng,
            (n, 3),
            step_s=dt,
            correlation_s=imu.bias_correlation_s,
            sigma=bias,
            initial_sigma=initial,
        )
        scale = gauss_markov(
            rng, (n, 3), step_s=dt, correlation_s=imu.scale_correlation_s, sigma=scale_ppm * 1e-6
        )
        value *= 1.0 + scale
        value += biases
        value += rng.standard_normal((n, 3)) * (noise / math.sqrt(dt))
        if step > 0.0:
            value = np.round(value / step) * step
        outputs.append((value, biases))
    return ImuOutput(outputs[0][0], outputs[1][0], outputs[0][1], outputs[1][1])
