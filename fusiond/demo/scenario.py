"""Scenario of a demo: configuration of the daemon, vehicle, and times of unplugged devices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple

from fusiond.configuration.schema import Config, Source
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.can.star_tracker_radar import SIM_SAR, SIM_STAR
from fusiond.simulation.gnss.raw_stream import RawFormat
from fusiond.simulation.live_devices import Device, SimulatedVehicle
from fusiond.simulation.scenarios import Scenario


class Unplugged(NamedTuple):
    """Device that is unplugged at `start_s` for `length_s`, again each `every_s` (0: once)."""

    device: Device
    start_s: float
    length_s: float
    every_s: float = 0.0

    def times(self, duration_s: float) -> Iterator[tuple[float, float]]:
        """Begin and end (s) of each time without the device that begins before `duration_s`."""
        starts = count(self.start_s, self.every_s) if self.every_s else iter([self.start_s])
        for start_s in takewhile(lambda at: at < duration_s, starts):
            yield start_s, start_s + self.length_s


@dataclass(frozen=True)
class DemoSetup:
    """Setup of a demo. `config` lacks devices and broker; `scenario` is its vehicle; `paper`
    describes the paper it follows."""

    config: Config
    scenario: Scenario
    devices: tuple[Device, ...]
    pulled: Unplugged | None = None
    raw: RawFormat | None = None
    aligning: str = "the car stands, then drives off: heading comes of the first motion"
    paper: dict[str, Any] = field(default_factory=dict)

    def sources(self, folder: Path) -> dict[str, Source]:
        """Configure the drivers of the simulated devices, whose links are in `folder`."""
        receiver = {"driver": "nmea"} if self.raw is None else RAW
        every = {
            "imu": Source(driver="can_imu", **SIM_IMU.model_dump()),
            "gnss": Source.model_validate({**receiver, "port": str(folder / "gnss")}),
            "rdss": Source.model_validate({"driver": "rdss", "port": str(folder / "rdss")}),
            "star_tracker": Source(driver="can_attitude", **SIM_STAR.model_dump()),
            "sar": Source(driver="can_bearing", **SIM_SAR.model_dump()),
        }
        return {name: every[name] for name in self.devices}

    def served(self, port: int, folder: Path) -> Config:
        """Complete the configuration with these devices and the demo's broker."""
        mqtt = self.config.mqtt.model_copy(
            update={"enabled": True, "host": "127.0.0.1", "port": port}
        )
        return self.config.model_copy(update={"sources": self.sources(folder), "mqtt": mqtt})

    def vehicle(self, duration_s: float, folder: Path) -> SimulatedVehicle:
        """Simulated vehicle whose devices run in real time."""
        link = {name: folder / name if name in self.devices else None for name in ("gnss", "rdss")}
        return SimulatedVehicle(
            self.scenario,
            duration_s=duration_s,
            gnss_link=link["gnss"],
            rdss_link=link["rdss"],
            gnss_raw=self.raw,
        )


RAW = {"driver": "gnss", "allow_simulator": True}
