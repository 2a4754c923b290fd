"""What Monte Carlo tests of sigma share: matched IMUs, drawn fixes, chi-square intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.simulation.imu_truth import Truth
from tests import runs

Array = NDArray[np.float64]

RATE_HZ = 50.0
FIRST_FIX_S = 0.303  # inside an IMU interval, so that every fix splits one
LEVER = (0.4, -0.3, -1.2)
NO_SCALE = 1e-6  # ppm: models without scale factors meet an IMU without
MATCHED = {
    "ins15": Imu(rate_hz=RATE_HZ, gyro_scale_ppm=NO_SCALE, accel_scale_ppm=NO_SCALE),
    "ins21": Imu(rate_hz=RATE_HZ),
    # One Markov state an axis stands for all of the accelerometer's bias: no turn-on part. A better
    # gyro than the others': 20 m fixes leave the heading of a MEMS one at 5 deg, where the filter's
    # linearisation, not its noise model, sets the NEES (measured: 19.6 instead of 12 after 60 s).
    "planar15": Imu(
        rate_hz=RATE_HZ,
        gyro_noise_deg_sqrt_h=0.05,
        accel_noise_m_s_sqrt_h=0.02,
        gyro_bias_initial_deg_h=10.0,
        gyro_bias_instability_deg_h=3.0,
        accel_bias_initial_mg=1e-9,
        accel_bias_instability_mg=0.5,
        gyro_scale_ppm=NO_SCALE,
        accel_scale_ppm=NO_SCALE,
    ),
    # As planar15, but for what it has no states for: the gyro's constant part, the accelerometer.
    "planar10": Imu(
        rate_hz=RATE_HZ,
        gyro_noise_deg_sqrt_h=0.05,
        accel_noise_m_s_sqrt_h=0.02,
        gyro_bias_initial_deg_h=1e-9,
        gyro_bias_instability_deg_h=3.0,
        accel_bias_initial_mg=1e-9,
        accel_bias_instability_mg=1e-9,
        gyro_scale_ppm=NO_SCALE,
        accel_scale_ppm=NO_SCALE,
    ),
}


def drawn_measurements(
    name: str, truth: Truth, t_s: Array, rng: np.random.Generator
) -> list[list[Linearised]]:
    """GNSS position and velocity; horizontal 20 m fixes for the planar models."""
    states = truth.at(t_s, LEVER)
    planar = name.startswith("planar")
    sd, sd_v = (20.0, 20.0, 20.0) if planar else (1.5, 1.5, 3.0), (0.05, 0.05, 0.1)
    measurements: list[list[Linearised]] = []
    for t, p, v in zip(t_s, states.position, states.v_ned, strict=True):
        lat, lon, height = (
            float(x)
            for x in p
            + rng.standard_normal(3) * sd / runs.metres_per_unit(float(p[0]), float(p[2]))
        )
        t_ns = round(t * 1e9)
        if planar:
            measurements.append(
                [PositionMeasurement("rdss", t_ns, 1 - 1e-9, lat, lon, None, sd, LEVER)]
            )
            continue
        n, e, d = (float(x) for x in v + rng.standard_normal(3) * sd_v)
        measurements.append(
            [
                PositionMeasurement("gnss", t_ns, 1 - 1e-9, lat, lon, height, sd, LEVER),
                VelocityMeasurement("gnss_velocity", t_ns, 1 - 1e-9, (n, e, d), sd_v, LEVER),
            ]
        )
    return measurements


def interval(degrees: int, probability: float) -> tuple[float, float]:
    """Two-sided chi-square interval."""
    tail = 0.5 * (1.0 - probability)
    return float(chi2.ppf(tail, degrees)), float(chi2.ppf(1.0 - tail, degrees))
