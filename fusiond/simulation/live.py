"""Simulated vehicle for a separate daemon: devices, and a configuration that reads them.

    fusiond simulate drive --live DIR          and in another terminal
    fusiond run DIR/vehicle.toml

The IMU is on `vcan0` where that interface is up, else on python-can's UDP multicast, which needs no
privilege; receiver and RDSS terminal are pseudo terminals, DIR/gnss and DIR/rdss.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from drivers.can.bus import Interface
from fusiond.configuration.draft import Draft, DraftSource, toml
from fusiond.files.csv_tables import MissingPackageError
from fusiond.files.install_extra import install_command
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import ANTENNA_M, CAR_IMU, REAR_AXLE_M, SCENARIOS
from fusiond.simulation.trajectories import drive

VCAN, MULTICAST = "vcan0", "239.74.163.2"
REST_S = 20.0
"""Time (s) at rest before the drive, to start a daemon and to level."""
SERVICE_FREQUENCY_S = 10


def bus_here() -> tuple[Interface, str]:
    """Bus that simulation and daemon can use: a virtual CAN interface, or python-can's multicast.

    Raises `MissingPackageError` if there is neither.
    """
    with suppress(OSError):
        state = Path(f"/sys/class/net/{VCAN}/operstate").read_text(encoding="ascii").strip()
        if state in ("up", "unknown"):  # a virtual interface that is up has no carrier to know
            return "socketcan", VCAN
    if find_spec("msgpack") is None:  # python-can's multicast packs with it
        raise MissingPackageError(
            f"{VCAN} is not up (ip link add {VCAN} type vcan; ip link set {VCAN} up), and the bus "
            f"over UDP needs msgpack: {install_command('demo')}"
        )
    return "udp_multicast", MULTICAST


def configuration(folder: Path, interface: Interface, channel: str) -> str:
    """Configuration for `fusiond run` that reads the devices."""
    imu = SIM_IMU.model_copy(update={"interface": interface, "channel": channel})
    options = imu.model_dump(mode="json", exclude_unset=True)
    sources = (
        DraftSource("imu", "can_imu", options, "the simulated IMU"),
        DraftSource("gnss", "nmea", {"port": str(folder / "gnss")}, "the simulated receiver"),
        DraftSource("rdss", "rdss", {"port": str(folder / "rdss")}, "the simulated terminal"),
    )
    return toml(
        Draft(
            vehicle="simulated",
            axes=CAR_IMU.axes,
            axes_known="As the simulated unit is mounted.",
            rate_hz=CAR_IMU.rate_hz,
            lever_arms_m={"gnss": ANTENNA_M, "rdss": ANTENNA_M},
            axle_m=REAR_AXLE_M,
            sources=sources,
        )
    )


def live(
    folder: Path, duration_s: float | None, seed: int, report: Callable[[str], None]
) -> dict[str, int]:
    """Drive until the end, Ctrl-C or SIGTERM and return counters of frames and bytes sent."""
    interface, channel = bus_here()
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    config = folder / "vehicle.toml"
    config.write_text(configuration(folder, interface, channel), encoding="utf-8")
    scenario = replace(SCENARIOS["drive"], path=partial(drive, rest_s=REST_S))
    rdss = replace(scenario.rdss, service_frequency_s=SERVICE_FREQUENCY_S)
    vehicle = SimulatedVehicle(
        replace(scenario, rdss=rdss),
        seed=seed,
        duration_s=duration_s,
        can_imu=SIM_IMU.model_copy(update={"interface": interface, "channel": channel}),
        gnss_link=folder / "gnss",
        rdss_link=folder / "rdss",
    )
    report(f"a car: IMU on {interface} {channel}, receiver {folder}/gnss, terminal {folder}/rdss")
    report(f"it stands for {REST_S:g} s, then drives. In another terminal: fusiond run {config}")
    asyncio.run(_until_stopped(vehicle))
    return dict(vehicle.counters)


async def _until_stopped(vehicle: SimulatedVehicle) -> None:
    driving = asyncio.create_task(vehicle.run())
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, driving.cancel)
    with suppress(asyncio.CancelledError):
        await driving
