"""What the benchmarks of the daemon's own process share: the vehicle that it serves, its broker and
configuration, and what the kernel says of it."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path

from fusiond.simulation.can.imu import SIM_IMU as SIM_IMU_OPTIONS
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive
from tests.broker import Broker, free_port
from tests.hil.processes import SIM_IMU
from tests.live.rig import bus_here

IMU_HZ, TICK_HZ, GNSS_HZ = 200.0, 100.0, 10.0
SETTLE_S = 5.0
REST_S = 5.0
CONFIG = """
vehicle = "load"
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = {imu_hz}
{imu}
[sources.gnss]
driver = "gnss"
port = "{folder}/gnss"
[aiding.gnss]
kind = "{kind}"
lever_arm_m = [0.0, 0.0, -1.0]
[sources.rdss]
driver = "rdss"
port = "{folder}/rdss"
baud = 115200
[aiding.rdss]
lever_arm_m = [0.0, 0.0, -1.0]
[constraints.non_holonomic]
enabled = true
lever_arm_m = [-1.0, 0.0, 0.5]
[estimator]
filter = "{name}"
[clock]
utc = "system"
[scheduler]
rate_hz = {tick_hz}
[mqtt]
host = "127.0.0.1"
port = {broker}
nav_rate_hz = {nav_hz}
commands = {commands}
"""
OUTPUTS = """
[outputs.gpsd]
port = {gpsd}
rate_hz = 10.0
[outputs.nmea]
port = {nmea}
rate_hz = 10.0
[outputs.prometheus]
port = {prometheus}
[outputs.foxglove]
port = {foxglove}
"""
SERVERS = ("gpsd", "nmea", "prometheus", "foxglove")
RECORDING = """
[recording]
directory = "{folder}/logs"
"""


@dataclass(frozen=True)
class DaemonBench:
    """A vehicle that has yet to start, a broker, and the configuration of a daemon for them;
    `ports` of its servers by name."""

    config: Path
    broker: Broker
    vehicle: BaseProcess
    ports: dict[str, int]
    interface: str


@asynccontextmanager
async def daemon_bench(
    folder: Path,
    duration_s: float,
    *,
    nav_hz: float,
    raw: bool,
    name: str = "kalman",
    commands: tuple[str, ...] = (),
    servers: bool = True,
    recording: bool = True,
    more: str = "",
) -> AsyncIterator[DaemonBench]:
    """Files go to `folder`; the vehicle drives for `duration_s`. `more` is configured as well."""
    bus = bus_here(0)
    # Else Mosquitto waits for the client's delayed acknowledgement, 40 ms.
    broker = Broker(folder, "allow_anonymous true", "set_tcp_nodelay true")
    ports = {server: free_port() for server in SERVERS}
    text = CONFIG.format(
        imu=SIM_IMU.format(interface=bus["interface"], channel=bus["channel"]),
        imu_hz=IMU_HZ,
        tick_hz=TICK_HZ,
        nav_hz=nav_hz,
        folder=folder,
        broker=broker.port,
        name=name,
        kind="raw" if raw else "gnss",
        commands=list(commands),
    )
    text += RECORDING.format(folder=folder) if recording else ""
    text += OUTPUTS.format(**ports) if servers else ""
    config = folder / "load.toml"
    config.write_text(text + more)
    vehicle = multiprocessing.get_context("spawn").Process(
        target=_simulate,
        args=(str(folder), bus["interface"], bus["channel"], raw, duration_s),
        daemon=True,
    )
    try:
        with broker:
            yield DaemonBench(config, broker, vehicle, ports, bus["interface"])
    finally:
        if vehicle.pid is not None:
            vehicle.kill()


def _simulate(folder: str, interface: str, channel: str, raw: bool, duration_s: float) -> None:
    scenario = SCENARIOS["drive"]
    vehicle = SimulatedVehicle(
        replace(
            scenario,
            path=partial(drive, rest_s=REST_S),
            imu=scenario.imu.model_copy(update={"rate_hz": IMU_HZ}),
            gnss=replace(scenario.gnss, rate_hz=GNSS_HZ),
            gnss_raw=replace(scenario.gnss_raw, rate_hz=GNSS_HZ),
        ),
        duration_s=duration_s,
        can_imu=SIM_IMU_OPTIONS.model_copy(update={"interface": interface, "channel": channel}),
        gnss_link=Path(folder, "gnss"),
        rdss_link=Path(folder, "rdss"),
        gnss_raw="ubx" if raw else None,
    )
    asyncio.run(vehicle.run())


def compile_kernels() -> None:
    """So that no benchmark measures it."""
    subprocess.run([sys.executable, "-c", "import fusiond.live.daemon"], check=True)


def cpu_s(pid: int) -> float:
    """User and system time of all threads (proc(5): utime, stime)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def running_s(pid: int) -> float:
    """On a processor, all threads (proc(5): schedstat, ns) that have not ended."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


def descriptors(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))
