"""Scenarios of the simulation: motion, origin, and sensors on board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fusiond.configuration.aiding import GnssAiding, RawAiding, RdssAiding, SarAiding
from fusiond.configuration.schema import Config, Imu
from fusiond.simulation.barometer import BarometerOptions
from fusiond.simulation.gnss.masks import Mask
from fusiond.simulation.gnss.raw import GnssRawOptions
from fusiond.simulation.gnss.receiver import GnssOptions
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssOptions
from fusiond.simulation.sensor_errors import ImuOutput, Vibration, imu_output
from fusiond.simulation.star_tracker_radar import FLIGHT_POINTS, SarOptions, StarTrackerOptions
from fusiond.simulation.trajectories import Path, drive, flight, level_flight, static

ANTENNA_M = (0.0, 0.0, -1.0)
"""Lever arm of both antennas: on the roof, 1 m above the IMU."""
CAR_IMU = Imu(axes=("+x", "-y", "-z"), rate_hz=100.0, gyro_range_deg_s=2000.0, accel_range_g=10.0)
"""IMU of `config/vehicle.toml`: MEMS, 10 deg/h and 0.1 mg, 0.3 deg/sqrt(h), 0.1 m/s/sqrt(h)."""
REAR_AXLE_M = (-1.0, 0.0, 0.5)
"""Vector from the car's IMU to the middle of its rear axle, body axes."""
AIRCRAFT_IMU = Imu(
    rate_hz=200.0,
    gyro_noise_deg_sqrt_h=0.05,
    accel_noise_m_s_sqrt_h=0.02,
    gyro_bias_instability_deg_h=1.0,
    accel_bias_instability_mg=0.05,
    gyro_bias_initial_deg_h=1.0,
    accel_bias_initial_mg=1.0,
    gyro_scale_ppm=300.0,
    accel_scale_ppm=300.0,
)
"""IMU of `config/tactical.toml`: 1 deg/h and 50 ug, 0.05 deg/sqrt(h), 0.02 m/s/sqrt(h)."""


MICRO_IMU = Imu(
    rate_hz=50.0,
    gyro_noise_deg_sqrt_h=0.3,
    accel_noise_m_s_sqrt_h=0.0832,
    gyro_bias_initial_deg_h=1e-9,
    gyro_bias_instability_deg_h=360.0,
    accel_bias_initial_mg=1e-9,
    accel_bias_instability_mg=1e-9,
    bias_correlation_s=3600.0,
    gyro_scale_ppm=1e-9,
    accel_scale_ppm=1e-9,
)
"""IMU of paper 001 (study `multiscale`): 0.1 deg/s of Markov drift, 1e-3 g white in each sample."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Scenario of a vehicle: `path` makes its motion over a time (s) from `origin_deg_m` (lat, lon,
    height)."""

    name: str
    path: Callable[[float], Path]
    duration_s: float
    origin_deg_m: tuple[float, float, float] = (30.5276, 114.3556, 38.0)
    imu: Imu = CAR_IMU
    gnss: GnssOptions = field(default_factory=lambda: GnssOptions(lever_arm_m=ANTENNA_M))
    gnss_raw: GnssRawOptions = field(default_factory=lambda: GnssRawOptions(lever_arm_m=ANTENNA_M))
    rdss: RdssOptions = field(default_factory=lambda: RdssOptions(lever_arm_m=ANTENNA_M))
    vibration: Vibration = field(default_factory=Vibration)
    no_slip_m: tuple[float, float, float] = REAR_AXLE_M
    """Vector from the IMU to the point that moves without side slip, body axes."""
    star_tracker: StarTrackerOptions | None = None
    sar: SarOptions | None = None
    barometer: BarometerOptions | None = None

    def truth(self, duration_s: float | None = None) -> Truth:
        """The trajectory, sampled at the IMU's rate."""
        length = self.duration_s if duration_s is None else duration_s
        lat, lon, height = self.origin_deg_m
        origin = (float(np.radians(lat)), float(np.radians(lon)), height)
        x, y, z = self.no_slip_m
        path = replace(self.path(length), arm_m=(-x, -y, -z))
        return Truth(path, origin, self.imu.rate_hz, length)

    def imu_output(self, truth: Truth, rng: np.random.Generator) -> ImuOutput:
        """IMU samples of this scenario on that trajectory."""
        return imu_output(self.imu, truth.gyro, truth.accel, rng, vibration=self.vibration)

    def fitted(self, config: Config) -> Scenario:
        """Scenario with the IMU, the lever arms and the no-slip point of a configuration."""
        gnss, raw, rdss, no_slip = self.gnss, self.gnss_raw, self.rdss, self.no_slip_m
        sar = self.sar
        for aiding in config.aiding.values():
            match aiding:
                case GnssAiding():
                    gnss = replace(gnss, lever_arm_m=aiding.lever_arm_m)
                case RawAiding():
                    raw = replace(raw, lever_arm_m=aiding.lever_arm_m)
                case RdssAiding():
                    rdss = replace(rdss, lever_arm_m=aiding.lever_arm_m)
                case SarAiding() if sar is not None:
                    points = aiding.targets_deg_m
                    sar = replace(sar, lever_arm_m=aiding.lever_arm_m, targets_deg_m=points)
        if config.constraints.non_holonomic.enabled:
            no_slip = config.constraints.non_holonomic.lever_arm_m
        return replace(
            self, imu=config.imu, gnss=gnss, gnss_raw=raw, rdss=rdss, sar=sar, no_slip_m=no_slip
        )

    def masked(self, masks: Sequence[Mask]) -> Scenario:
        """Scenario with sky masks. A receiver has no fix in a tunnel or with fewer than four
        satellites, so its NMEA stops there."""
        windows = tuple(
            (mask.start_s, mask.length_s)
            for mask in masks
            if mask.kind == "tunnel" or (mask.satellites is not None and mask.satellites < 4)
        )
        return replace(
            self,
            gnss=replace(self.gnss, outages=(*self.gnss.outages, *windows)),
            gnss_raw=replace(self.gnss_raw, masks=(*self.gnss_raw.masks, *masks)),
        )


FLIGHT = Scenario(
    "flight",
    flight,
    4000.0,
    imu=AIRCRAFT_IMU,
    rdss=RdssOptions(lever_arm_m=ANTENNA_M, service_frequency_s=60),
    no_slip_m=(0.0, 0.0, 0.0),
)
# Car and aircraft fit the shipped configurations `vehicle.toml`, `tactical.toml`,
# `flight_sar.toml` and `flight_star.toml` unchanged.
SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("static", static, 600.0),
        Scenario("drive", drive, 1560.0, barometer=BarometerOptions()),
        FLIGHT,
        replace(
            FLIGHT,
            name="flight-sar",
            star_tracker=StarTrackerOptions(),
            sar=SarOptions(FLIGHT_POINTS),
        ),
        Scenario(
            "flight-star",
            level_flight,
            400.0,
            (29.0, 118.0, 50.0),
            imu=MICRO_IMU,
            gnss=GnssOptions(rate_hz=1.0, white_sd_m=(8.0, 8.0), velocity_sd_m_s=(0.5, 0.5)),
            no_slip_m=(0.0, 0.0, 0.0),
            star_tracker=StarTrackerOptions(misalignment_sd_arcsec=0.0),
        ),
    )
}


def random_streams(seed: int | np.random.SeedSequence) -> tuple[np.random.Generator, ...]:
    """Independent random generators for IMU, GNSS fixes, RDSS and raw GNSS, so that a change of one
    device leaves the others alone."""
    sequence = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    return tuple(np.random.default_rng(child) for child in sequence.spawn(4))
