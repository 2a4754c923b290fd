"""The processes of a bench: the daemon as systemd starts it, and the simulated vehicle."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from fusiond.files.measurement_csv import read_truth
from tests.places import REPOSITORY

FUSIOND = Path(sys.executable).with_name("fusiond")
PATIENCE_S = 240.0
"""Only bounds a broken run; nothing passes or fails by its length."""

SIM_IMU = """
[sources.imu]
driver = "can_imu"
interface = "{interface}"
channel = "{channel}"
dbc = "fusiond_sim_imu"
gyro = ["SIM_GYRO.GYRO_X", "SIM_GYRO.GYRO_Y", "SIM_GYRO.GYRO_Z"]
accel = ["SIM_ACCEL.ACCEL_X", "SIM_ACCEL.ACCEL_Y", "SIM_ACCEL.ACCEL_Z"]
counter = ["SIM_TIME.TIME_COUNTER", "SIM_GYRO.GYRO_COUNTER", "SIM_ACCEL.ACCEL_COUNTER"]
device_time = "SIM_TIME.TIME"
"""
"""The section of an IMU that speaks `config/dbc/fusiond_sim_imu.dbc`."""


class DaemonProcess:
    """`fusiond run CONFIG` with a service manager that listens; `log` is its standard error.

    `async with` starts nothing; it sees to it that nothing is left running. `program` is another
    that takes the same arguments."""

    def __init__(self, config: Path, program: Sequence[str | Path] = (FUSIOND,)) -> None:
        self._config = config
        self._program = program
        self._log = config.with_suffix(".log")
        self._notify = config.with_suffix(".notify")
        self._socket: socket.socket | None = None
        self._process: asyncio.subprocess.Process | None = None
        self.told: list[str] = []
        """What the service manager was told, a line each."""

    @property
    def log(self) -> str:
        return self._log.read_text() if self._log.exists() else ""

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    async def start(self) -> None:
        """Start it; returns at once."""
        self.told.clear()
        self._notify.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.bind(str(self._notify))
        asyncio.get_running_loop().add_reader(self._socket, self._hear, self._socket)
        environment = {**os.environ, "NOTIFY_SOCKET": str(self._notify)}
        with self._log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *self._program, "run", self._config, env=environment, stdout=log, stderr=log
            )

    def _hear(self, notifications: socket.socket) -> None:
        while True:
            try:
                self.told += notifications.recv(4096).decode().splitlines()
            except BlockingIOError:
                return

    async def ready(self) -> None:
        """Wait until it has told the service manager that it is up."""
        assert self._process is not None
        async with asyncio.timeout(PATIENCE_S):
            while "READY=1" not in self.told:
                assert self._process.returncode is None, self.log
                await asyncio.sleep(0.02)

    async def terminate(self) -> int:
        """SIGTERM, as systemd stops it; the exit status."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(PATIENCE_S):
            status = await self._process.wait()
        self._hang_up()
        return status

    async def __aenter__(self) -> DaemonProcess:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        """End it whatever it does; a test that failed shows its log."""
        if error is not None:
            print(self.log)
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._process.wait()
        self._hang_up()

    def _hang_up(self) -> None:
        if self._socket is not None:
            self._hear(self._socket)
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None


class VehicleProcess:
    """`python -m fusiond.simulation.live_devices`, its plugs, and the truth at any instant of UTC.

    `async with` starts nothing, as for the daemon."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.gnss, self.rdss = folder / "gnss", folder / "rdss"
        self._truth, self._start = folder / "truth.csv", folder / "start.json"
        self._arguments = arguments
        self._process: asyncio.subprocess.Process | None = None
        self._times: NDArray[np.float64] = np.zeros(0)
        self._states: NDArray[np.float64] = np.zeros((0, 9))
        self._utc_start_s = 0.0

    async def start(self) -> None:
        """Start it, and wait until its devices are there."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "fusiond.simulation.live_devices", *self._arguments),
            *("--gnss-link", str(self.gnss), "--rdss-link", str(self.rdss)),
            *("--truth", str(self._truth), "--start-file", str(self._start)),
            cwd=REPOSITORY,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        assert await self._line() == "ready"
        table = read_truth(self._truth)
        self._times = table.t_s
        self._states = np.column_stack(
            [table.lat_rad, table.lon_rad, table.height_m, table.v, np.unwrap(table.rpy, axis=0)]
        )
        self._utc_start_s = json.loads(self._start.read_text())["start_utc_ns"] * 1e-9

    async def _line(self) -> str:
        assert self._process is not None
        assert self._process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            return (await self._process.stdout.readline()).decode().strip()

    async def command(self, line: str, answer: str) -> None:
        """Say a line; the vehicle must give this answer."""
        self._say(line)
        assert await self._line() == answer

    def _say(self, line: str) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())

    async def plug(self, device: str) -> None:
        await self.command(f"plug {device}", f"plugged {device}")

    async def unplug(self, device: str) -> None:
        await self.command(f"unplug {device}", f"unplugged {device}")

    async def finish(self) -> dict[str, int]:
        """End it as its user would; its counters."""
        self._say("quit")
        counters: dict[str, int] = json.loads(await self._line())
        return counters

    def t_s(self, utc_ms: float) -> float:
        """Time of the trajectory at a POSIX instant in ms."""
        return utc_ms * 1e-3 - self._utc_start_s

    def truth(self, utc_ms: float) -> NDArray[np.float64]:
        """True latitude, longitude (rad), height (m), v_ned (m/s), roll, pitch, yaw (rad): (9,)."""
        t_s = float(np.clip(self.t_s(utc_ms), self._times[0], self._times[-1]))
        k = max(1, int(np.searchsorted(self._times, t_s)))
        (t0, t1), (before, after) = self._times[k - 1 : k + 1], self._states[k - 1 : k + 1]
        state: NDArray[np.float64] = before + (after - before) * ((t_s - t0) / (t1 - t0))
        return state

    async def __aenter__(self) -> VehicleProcess:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._process.wait()
