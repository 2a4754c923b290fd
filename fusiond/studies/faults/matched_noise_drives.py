"""Simulated drives, receivers and IMUs for `sharpness` and `service`, with noise as the filter's.

All random numbers of a run come from a `SeedSequence` of its drive's number and share: drives of
the share `looked` may be inspected while the code is changed, those of `scored` are scored alone.

    SeedSequence(38, spawn_key=(0, k, ...))   drive k of those that are looked at
    SeedSequence(38, spawn_key=(1, k, ...))   drive k of those that are scored

The rest of the key names the part: 0 path, 1 IMU, 2 receiver, 3 unmeasured quantities (the lever
arm), 4 with the fault's number the fault's begin. So a drive has the same noise under every fault.

A receiver's error is white, or shared: a Gauss-Markov process of `SHARED_S` beside white noise. The
car neither slides nor is its unit askew, and stamps are exact. What of this the configuration says
is `Told`:

    all       noise of the IMU and of the receiver, of which `[aiding.gnss]` says what is shared and
              each fix what is white; stamps that are exact. The filter has no constraint of a
              noise that a car which never slides does not have: told in millimetres a second, it
              asks for more than a linear filter can do, and told wider it is wrong
    noise     the same, but for the car and the stamps, which may be as wrong as by default
    class     the IMU's class, and nothing else: the unit on board is a typical one of it
              (`TYPICAL`), and fixes state the sum of their errors
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from drivers.measurements import PositionFix
from fusiond.configuration.schema import Config
from fusiond.configuration.sensor_class import CLASSES, SensorClass
from fusiond.simulation.gnss.receiver import GnssOptions, GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.studies.faults.random_drives import random_drive
from fusiond.studies.faults.runs import ANTENNA_M, VEHICLE
from fusiond.studies.faults.sensor_data import Received, Recording, gnss_fixes

Share = Literal["looked", "scored"]
SHARES: tuple[Share, ...] = ("looked", "scored")
Told = Literal["all", "noise", "class"]
ENTROPY = 38
RATE_HZ = 50.0
SHARED_S = 60.0
LEVER_SD_M = 1.0
"""Lever arm sigma, as `fusiond.configuration.aiding.UNKNOWN_LEVER_SD_M`."""
AXLE_M = (-1.0, 0.0, 0.5)
TYPICAL = 1.0 / 3.0
"""Ratio of a typical unit's biases, scale factors and angles to the data sheet's limits; its noise
is the class's."""


@dataclass(frozen=True, slots=True)
class Receiver:
    """One sigma of a receiver's errors, (horizontal, down): `white_m` independent, `shared_m` for
    `SHARED_S`."""

    name: str
    quality: int
    white_m: tuple[float, float]
    velocity_m_s: tuple[float, float]
    shared_m: tuple[float, float] = (0.0, 0.0)
    rate_hz: float = 1.0

    @property
    def options(self) -> GnssOptions:
        """Options of the simulated receiver."""
        return GnssOptions(
            rate_hz=self.rate_hz,
            white_sd_m=self.white_m,
            correlated_sd_m=self.shared_m,
            correlation_s=SHARED_S,
            velocity_sd_m_s=self.velocity_m_s,
            quality=self.quality,
        )

    @property
    def section(self) -> dict[str, Any]:
        """Matching section `[aiding.gnss]` without the lever arm."""
        level, down = self.shared_m
        shared = {"bias_sd_m": level, "bias_correlation_s": SHARED_S}
        return {**shared, **({"bias_down_sd_m": down} if down else {})}


CODE = Receiver("code", 1, (1.5, 3.0), (0.08, 0.12))
"""Receiver of the prototype to which published figures refer."""
SHARING = Receiver("code, shared errors", 1, (0.8, 1.6), (0.08, 0.12), (1.5, 3.0))
RTK = Receiver("RTK", 4, (0.02, 0.04), (0.03, 0.05))
_HALF = 0.5**0.5
SHARING_RTK = replace(RTK, name="RTK, shared errors", shared_m=(0.02 * _HALF, 0.04 * _HALF))
"""Receiver of carrier phase, for which the filter assumes half of a fix's stated variance as shared
beside it (`fusiond.navigator.intake.gnss.PHASE_SHARE`)."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Class of IMU, or the data sheet of `config/vehicle.toml`, with a receiver, a given or unknown
    lever arm, and further settings."""

    sensor: SensorClass | Literal["data sheet"]
    receiver: Receiver
    lever_given: bool = True
    told: Told = "all"

    def config(self) -> Config:
        """Configuration of the navigator."""
        gnss: dict[str, Any] = {"lever_arm_m": ANTENNA_M} if self.lever_given else {}
        slip = {"enabled": self.told != "all", "lever_arm_m": AXLE_M}
        if self.told != "class":
            gnss |= self.receiver.section
        if self.told == "all":
            gnss |= {"time_offset_sd_s": 0.0}
        own: dict[str, Any] = {"sensor_class": self.sensor}
        if self.sensor == "data sheet":
            own = VEHICLE.imu.model_dump(exclude_unset=True)
        imu = {**own, "axes": ("+x", "-y", "-z"), "rate_hz": RATE_HZ}
        return Config.model_validate(
            {
                "imu": imu,
                "aiding": {"gnss": gnss},
                "constraints": {"non_holonomic": slip},
                "estimator": {"model": "ins21"},
            }
        )

    def unit(self) -> Config:
        """Configuration with the IMU on board."""
        config = self.config()
        if self.told != "class" or self.sensor == "data sheet":
            return config
        own = {
            key: value if "_noise_" in key else TYPICAL * value
            for key, value in CLASSES[self.sensor].items()
        }
        return config.model_copy(update={"imu": config.imu.model_copy(update=own)})


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene of a drive: configuration of the navigator, truth, and recorded sensor data."""

    config: Config
    truth: Truth
    recording: Recording


def scene(vehicle: Vehicle, share: Share, number: int, duration_s: float) -> Scene:
    """Make the scene of drive `number` of a share with a vehicle."""
    path, imu, receiver, unknown = (part_generator(share, number, k) for k in range(4))
    config, unit = vehicle.config(), vehicle.unit()
    drive = random_drive(path, duration_s)
    car = replace(SCENARIOS["drive"], path=drive.path).fitted(unit)
    truth = car.truth(duration_s)
    sensed = car.imu_output(truth, imu)
    x, y, z = unknown.normal(0.0, LEVER_SD_M, 3).tolist()
    lever = ANTENNA_M if vehicle.lever_given else (x, y, z)
    options = replace(vehicle.receiver.options, lever_arm_m=lever)
    fixes = gnss_fixes(GnssReceiver(truth, options, receiver))
    said = [_stating(item, vehicle) for item in fixes]
    stamps = np.rint(truth.t_s[1:] * 1e9).astype(np.int64)
    samples = np.hstack((sensed.gyro, sensed.accel))
    recording = Recording(stamps, stamps, samples, ()).with_received(said)
    return Scene(config, truth, recording)


def part_generator(share: Share, number: int, *what: int) -> np.random.Generator:
    """Random generator of one part of a drive."""
    key = (SHARES.index(share), number, *what)
    return np.random.default_rng(np.random.SeedSequence(ENTROPY, spawn_key=key))


def _stating(item: Received, vehicle: Vehicle) -> Received:
    """Measurement with its quality and sigma."""
    fix, receiver = item.measurement, vehicle.receiver
    assert isinstance(fix, PositionFix)
    level, down = receiver.white_m
    stated = fix.sd_ned_m if vehicle.told == "class" else (level, level, down)
    return replace(item, measurement=replace(fix, quality=receiver.quality, sd_ned_m=stated))
