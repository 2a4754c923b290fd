"""What can be simulated: a motion, where it starts, and the sensors on board."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fusiond.config import Imu
from fusiond.simulation.gnss_receiver import GnssOptions
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss_terminal import RdssOptions
from fusiond.simulation.sensor_errors import ImuOutput, Vibration, imu_output
from fusiond.simulation.trajectories import Path, drive, flight, static

TACTICAL_IMU = Imu(
    rate_hz=200.0,
    gyro_noise_deg_sqrt_h=0.05,
    accel_noise_m_s_sqrt_h=0.02,
    gyro_bias_instability_deg_h=1.0,
    accel_bias_instability_mg=0.05,
    gyro_bias_initial_deg_h=5.0,
    accel_bias_initial_mg=1.0,
    gyro_scale_ppm=300.0,
    accel_scale_ppm=300.0,
)
"""1 deg/h and 50 ug bias instability, 0.05 deg/sqrt(h), 0.02 m/s/sqrt(h)."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """A vehicle: `path` makes its motion for a time in s from `origin_deg_m`, lat, lon, height."""

    name: str
    path: Callable[[float], Path]
    duration_s: float
    origin_deg_m: tuple[float, float, float] = (30.5276, 114.3556, 38.0)
    imu: Imu = field(default_factory=lambda: Imu(rate_hz=200.0))
    gnss: GnssOptions = field(default_factory=GnssOptions)
    rdss: RdssOptions = field(default_factory=RdssOptions)
    vibration: Vibration = field(default_factory=Vibration)

    def truth(self, duration_s: float | None = None) -> Truth:
        """The trajectory, sampled at the IMU's rate."""
        length = self.duration_s if duration_s is None else duration_s
        lat, lon, height = self.origin_deg_m
        origin = (float(np.radians(lat)), float(np.radians(lon)), height)
        return Truth(self.path(length), origin, self.imu.rate_hz, length)

    def imu_output(self, truth: Truth, rng: np.random.Generator) -> ImuOutput:
        """What this scenario's IMU says on that trajectory."""
        return imu_output(self.imu, truth.gyro, truth.accel, rng, vibration=self.vibration)


SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("static", static, 600.0),
        Scenario("drive", drive, 1560.0),
        Scenario("flight", flight, 4000.0, imu=TACTICAL_IMU),
    )
}


def random_streams(seed: int) -> tuple[np.random.Generator, ...]:
    """Independent generators for IMU, GNSS and RDSS: changing one device leaves the others."""
    children = np.random.SeedSequence(seed).spawn(3)
    return tuple(np.random.default_rng(child) for child in children)
