"""A daemon in this process: its real drivers on a virtual CAN bus and pseudo terminals."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from drivers.can.imu import CanImuOptions
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.live.daemon import Daemon
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.messages.health import SourceHealth
from fusiond.simulation.can.imu import SIM_IMU
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive
from tests.patience import until

REST = replace(SCENARIOS["drive"], path=partial(drive, rest_s=60.0))
FIRST_COURSE_DEG = 40.0
BASE = """
vehicle = "test"
state_file = "state.json"
[imu]
axes = ["+x", "-y", "-z"]
{imu}
[sources.gnss]
driver = "nmea"
port = "gnss"
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[alignment]
heading = ["saved", "config"]
heading_deg = 40.0
"""
PARKED = Mode.COASTING
"""Of a vehicle that stands, with the heading that was configured."""
RDSS = '[sources.rdss]\ndriver = "rdss"\nport = "rdss"\nbaud = 115200\n'
NO_MQTT = "[mqtt]\nenabled = false\n"


def imu_section(options: CanImuOptions) -> str:
    given = options.model_dump(exclude_unset=True)
    lines = [
        f"{key} = {json.dumps(value if isinstance(value, str) else list(value))}"
        for key, value in given.items()
    ]
    return "\n".join(["[sources.imu]", 'driver = "can_imu"', *lines])


class Bench:
    """A daemon, the devices it serves, and what it says."""

    def __init__(
        self, folder: Path, log: pytest.LogCaptureFixture, imu: CanImuOptions = SIM_IMU
    ) -> None:
        self.folder = folder
        self.imu = imu.model_copy(update={"channel": f"daemon-{folder.name}"})
        self.seen: list[Solution] = []
        self._log = log

    def configuration(self, *sections: str) -> Config:
        """The configuration of `BASE` and `sections`, in a file as well."""
        path = self.folder / "test.toml"
        text = BASE.format(imu=imu_section(self.imu)) + "\n".join(sections)
        for port in ("gnss", "rdss"):
            text = text.replace(f'port = "{port}"', f'port = "{self.folder / port}"')
        path.write_text(text)
        return load_config(path)

    def daemon(self, *sections: str) -> Daemon:
        """A daemon for that configuration."""
        self.made = Daemon(self.configuration(*sections), on_solution=self.seen.append)
        return self.made

    def vehicle(self, scenario: Any = REST, **links: Path) -> SimulatedVehicle:
        return SimulatedVehicle(scenario, seed=4, duration_s=60.0, can_imu=self.imu, **links)

    @property
    def health(self) -> dict[str, SourceHealth]:
        return self.made.sources.health(self.made.clock.now_ns())

    def events(self, code: str) -> list[str]:
        """The events with that code, as they were logged."""
        return [r.getMessage() for r in self._log.records if f": {code}: " in r.getMessage()]

    async def mode(self, mode: Mode) -> None:
        """Wait for a solution of that mode from now on."""
        looked_at = len(self.seen)

        def came() -> bool:
            nonlocal looked_at
            first, looked_at = looked_at, len(self.seen)
            return any(s.mode is mode for s in self.seen[first:])

        await until(came)


@asynccontextmanager
async def driving(vehicle: SimulatedVehicle) -> AsyncIterator[None]:
    """A vehicle on its way."""
    task = asyncio.create_task(vehicle.run())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@asynccontextmanager
async def running(daemon: Daemon, *vehicles: SimulatedVehicle) -> AsyncIterator[None]:
    """Daemon and vehicles at work; the daemon is stopped as SIGTERM stops it."""
    stop = asyncio.Event()
    async with AsyncExitStack() as stack:
        for vehicle in vehicles:
            await stack.enter_async_context(driving(vehicle))
        serving = asyncio.create_task(daemon.run(stop))
        try:
            yield
            assert not serving.done(), serving
        finally:
            stop.set()
            await serving
