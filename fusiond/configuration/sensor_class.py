"""Noise and bias of a sensor class, as defaults until the data sheet is entered.

Switch-on bias and scale are one sigma without a calibration by the owner, instability that of some
minutes in a vehicle that warms up. Noise is the chip's: vibration shows in the samples
(fusiond.navigation.vibration).

`consumer`: phones, OBD dongles, navigation modules (Bosch BMI160, ST LSM6DS3: zero-rate level 3 to
10 deg/s, zero-g level 40 mg, cross-axis sensitivity 1 %). `mems`: industrial units, calibrated at
the factory (Xsens MTi-600, Analog Devices ADIS16470: 0.2 deg/s, 10 to 16 mg over temperature, axes
to the package 0.25 deg). `tactical`: 1 deg/h units (Sensonor STIM300: axes 1 mrad; Honeywell
HG4930).
"""

from __future__ import annotations

from typing import Literal

SensorClass = Literal["consumer", "mems", "tactical"]

CLASSES: dict[SensorClass, dict[str, float]] = {
    "consumer": {
        "gyro_noise_deg_sqrt_h": 0.6,
        "accel_noise_m_s_sqrt_h": 0.2,
        "gyro_bias_instability_deg_h": 100.0,
        "accel_bias_instability_mg": 1.0,
        "gyro_bias_initial_deg_h": 10800.0,
        "accel_bias_initial_mg": 50.0,
        "gyro_scale_ppm": 10000.0,
        "accel_scale_ppm": 10000.0,
        # Data sheets say 1 % (0.57 deg) at most. No better than the class above is what can be
        # said: docs/vehicle.md has what other values give.
        "misalignment_deg": 0.2,
    },
    "mems": {
        "gyro_noise_deg_sqrt_h": 0.3,
        "accel_noise_m_s_sqrt_h": 0.1,
        "gyro_bias_instability_deg_h": 30.0,
        "accel_bias_instability_mg": 0.3,
        "gyro_bias_initial_deg_h": 1800.0,
        "accel_bias_initial_mg": 20.0,
        "gyro_scale_ppm": 5000.0,
        "accel_scale_ppm": 5000.0,
        "misalignment_deg": 0.2,
    },
    "tactical": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "accel_noise_m_s_sqrt_h": 0.03,
        "gyro_bias_instability_deg_h": 1.0,
        "accel_bias_instability_mg": 0.05,
        "gyro_bias_initial_deg_h": 20.0,
        "accel_bias_initial_mg": 2.0,
        "gyro_scale_ppm": 500.0,
        "accel_scale_ppm": 500.0,
        "misalignment_deg": 0.05,
    },
}
"""Values of `[imu]` that a class stands for, by key."""
