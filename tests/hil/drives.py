"""What the drives of the bench have in common: the vehicle on its devices, and a configuration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.hil.processes import SIM_IMU, VehicleProcess

LEVER_ARM_M = (0.0, 0.0, -1.0)
"""Of both antennas of the simulated vehicle."""


def drive(
    folder: Path, rest_s: float, duration_s: float, seed: int, *arguments: str
) -> VehicleProcess:
    """Scenario `drive`, IMU on the bus, a card that may be asked every 2 s."""
    return VehicleProcess(
        folder,
        *("--scenario", "drive", "--rest", f"{rest_s}"),
        *("--duration", f"{duration_s}", "--seed", f"{seed}"),
        *("--can", "socketcan:vcan0", "--service-frequency", "2"),
        *arguments,
    )


def imu_section() -> str:
    """The IMU on the bus of the bench."""
    return SIM_IMU.format(interface="socketcan", channel="vcan0")


def section(name: str, **values: Any) -> str:
    """A section of a configuration; the values that JSON and TOML write alike."""
    return "".join(
        [f"[{name}]\n", *(f"{key} = {json.dumps(value)}\n" for key, value in values.items())]
    )


def configuration(
    name: str,
    vehicle: VehicleProcess,
    port: int,
    rate_hz: float,
    gnss: dict[str, Any] | None = None,
    aiding: dict[str, Any] | None = None,
) -> str:
    """IMU, receiver and terminal as `drive` has them, `nav` at 10 Hz to the broker at `port`.

    `gnss` and `aiding` are further keys of the receiver's sections."""
    return "".join(
        [
            f'vehicle = "{name}"\n',
            section("imu", axes=["+x", "-y", "-z"], rate_hz=100.0),
            imu_section(),
            section(
                "sources.gnss", **{"driver": "nmea", "port": str(vehicle.gnss), **(gnss or {})}
            ),
            section("aiding.gnss", lever_arm_m=LEVER_ARM_M, **(aiding or {})),
            section(
                "sources.rdss", driver="rdss", port=str(vehicle.rdss), baud=115200, family="4.0"
            ),
            section("aiding.rdss", lever_arm_m=LEVER_ARM_M),
            section("scheduler", rate_hz=rate_hz),
            section("mqtt", host="127.0.0.1", port=port, nav_rate_hz=10.0),
        ]
    )
