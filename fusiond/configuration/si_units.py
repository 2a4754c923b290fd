"""Conversion of a vehicle's configuration from data-sheet units to SI units.

The only place where units are converted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.constraints import ZeroVelocity
from fusiond.configuration.schema import Imu
from fusiond.models.blocks import ClockNoise, ImuNoise
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.rotation import dcm_from_rpy
from fusiond.navigation.standstill import BIAS_SIGMAS, QuietLimits

DEG = math.pi / 180.0
DEG_PER_HOUR = DEG / 3600.0
PER_ROOT_HOUR = 1.0 / 60.0
ARCSEC = DEG / 3600.0
MILLI_G = 1e-3 * STANDARD_GRAVITY_M_S2


def imu_noise(imu: Imu) -> ImuNoise:
    """The IMU's error model."""
    return ImuNoise(
        rate_noise=imu.gyro_noise_deg_sqrt_h * DEG * PER_ROOT_HOUR,
        force_noise=imu.accel_noise_m_s_sqrt_h * PER_ROOT_HOUR,
        rate_bias_initial=imu.gyro_bias_initial_deg_h * DEG_PER_HOUR,
        force_bias_initial=imu.accel_bias_initial_mg * MILLI_G,
        rate_bias_instability=imu.gyro_bias_instability_deg_h * DEG_PER_HOUR,
        force_bias_instability=imu.accel_bias_instability_mg * MILLI_G,
        bias_correlation_s=imu.bias_correlation_s,
        rate_scale=imu.gyro_scale_ppm * 1e-6,
        force_scale=imu.accel_scale_ppm * 1e-6,
    )


def imu_range(imu: Imu) -> tuple[float, float]:
    """Full scale of rate (rad/s) and force (m/s^2); infinite if none is configured."""
    rate, force = imu.gyro_range_deg_s, imu.accel_range_g
    return (
        math.inf if rate is None else rate * DEG,
        math.inf if force is None else force * STANDARD_GRAVITY_M_S2,
    )


def clock_noise(raw: RawAiding) -> ClockNoise:
    """The receiver clock's error model. A Markov drift of correlation time tau has the density
    q = 2 sigma^2 / tau of its walk."""
    phase, walk = raw.clock_phase_m_sqrt_s**2, raw.clock_drift_m_s_sqrt_s**2
    tau_s = raw.clock_drift_tau_s
    if tau_s is None:
        return ClockNoise(offset_white=phase, drift_white=walk)
    steady = math.sqrt(0.5 * walk * tau_s)
    return ClockNoise(
        drift_initial=steady,
        offset_white=phase,
        drift_white=0.0,
        drift_tau_s=tau_s,
        drift_steady=steady,
    )


def sensor_to_body(imu: Imu) -> NDArray[np.float64]:
    """Rotation (3, 3) from sensor axes to body axes.

    Nominal axes first (`axes`), then the mounting: `mounting_deg` is the attitude of the nominal
    sensor frame
    against the body, so its matrix turns nominal sensor axes into body axes.
    """
    nominal = np.zeros((3, 3))
    for row, axis in enumerate(imu.axes):
        nominal[row, "xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    roll, pitch, yaw = (a * DEG for a in imu.mounting_deg)
    return dcm_from_rpy(roll, pitch, yaw) @ nominal


def quiet_limits(zero_velocity: ZeroVelocity, noise: ImuNoise) -> QuietLimits:
    """Thresholds of the standstill detector. A gyro's bias, its mean rate at rest, does not reduce
    the limit of the rate."""
    bias = math.hypot(noise.rate_bias_initial, noise.rate_bias_instability)
    return QuietLimits(
        window_ns=round(zero_velocity.window_s * 1e9),
        rate_sd=zero_velocity.gyro_sd_deg_s * DEG,
        force_sd=zero_velocity.accel_sd_m_s2,
        mean_rate=zero_velocity.max_rate_deg_s * DEG + BIAS_SIGMAS * bias,
    )
