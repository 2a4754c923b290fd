r"""Errors of inertial sensors and measurements, by the configuration's error model.

    y = (1 + s) x + b + c + n + m
    n   white, sigma = N / sqrt(dt)                            N angle or velocity random walk
    b   constant, N(0, sigma_0)                                turn-on bias
    c'  = -c / T + w,  q = 2 sigma_b^2 / T                     bias instability, from steady state
    s   constant, N(0, sigma_s)                                scale factor of each axis
    m   engine vibration, a sine of random phase, averaged over the sample interval

which is what the filter assumes of `fusiond.configuration.schema.Imu`: sigma_0 its initial bias,
sigma_b its bias instability, T its `bias_correlation_s`. Errors act in sensor axes.

Source: Groves, 2nd ed., sections 4.4 and 14.2.6; IEEE Std 952-1997 annex B for the noise units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise, sensor_to_body
from fusiond.simulation.markov import gauss_markov

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Vibration:
    """Engine vibration at the IMU: amplitudes (each axis) and frequency."""

    accel_m_s2: float = 0.0
    gyro_rad_s: float = 0.0
    frequency_hz: float = 27.3


@dataclass(frozen=True, slots=True)
class ImuOutput:
    """Output of the IMU and its true biases, rows (n, 3) in sensor axes."""

    gyro: Array
    accel: Array
    gyro_bias: Array
    accel_bias: Array


def imu_output(
    imu: Imu,
    gyro: Array,
    accel: Array,
    rng: np.random.Generator,
    *,
    vibration: Vibration | None = None,
    misalignment_deg: float | None = None,
    gyro_step_rad_s: float = 0.0,
    accel_step_m_s2: float = 0.0,
) -> ImuOutput:
    """Convert ideal means in body axes (n, 3) at `imu.rate_hz` into this IMU's samples.

    `misalignment_deg` is one sigma of each small angle between a sensor's axes and its nominal
    ones, None for that of `imu`, `*_step_*` the resolution of its output (0: none). Equal states of
    `rng` give equal bytes.
    """
    n, dt = len(gyro), 1.0 / imu.rate_hz
    misalignment = (imu.misalignment_deg if misalignment_deg is None else misalignment_deg) * DEG
    vibration = vibration or Vibration()
    phase = rng.uniform(0.0, 2.0 * math.pi, 6)
    omega = 2.0 * math.pi * vibration.frequency_hz
    average = math.sin(0.5 * omega * dt) / (0.5 * omega * dt)
    middle = (np.arange(n) + 0.5)[:, None] * dt
    matrix = sensor_to_body(imu).T
    outputs: list[tuple[Array, Array]] = []
    si = imu_noise(imu)
    for truth, noise, bias, initial, scale_sd, amplitude, step, phases in (
        (
            gyro,
            si.rate_noise,
            si.rate_bias_instability,
            si.rate_bias_initial,
            si.rate_scale,
            vibration.gyro_rad_s,
            gyro_step_rad_s,
            phase[:3],
        ),
        (
            accel,
            si.force_noise,
            si.force_bias_instability,
            si.force_bias_initial,
            si.force_scale,
            vibration.accel_m_s2,
            accel_step_m_s2,
            phase[3:],
        ),
    ):
        misaligned = np.eye(3)
        misaligned[~np.eye(3, dtype=bool)] = rng.standard_normal(6) * misalignment
        value = truth @ (misaligned @ matrix).T
        if amplitude > 0.0:
            value += amplitude * average * np.sin(omega * middle + phases)
        biases = rng.standard_normal(3) * initial + gauss_markov(
            rng, (n, 3), step_s=dt, correlation_s=imu.bias_correlation_s, sigma=bias
        )
        value *= 1.0 + rng.standard_normal(3) * scale_sd
        value += biases
        value += rng.standard_normal((n, 3)) * (noise / math.sqrt(dt))
        if step > 0.0:
            value = np.round(value / step) * step
        outputs.append((value, biases))
    return ImuOutput(outputs[0][0], outputs[1][0], outputs[0][1], outputs[1][1])
