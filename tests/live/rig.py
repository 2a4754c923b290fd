"""The daemon's own process on wires that can be disturbed, and what came of a disturbance.

The vehicle is simulated here; its bytes pass a `Wire` and its samples an `AlteredImu` on their way
to pseudo terminals and a CAN bus, a real one where `vcan0` is up. Judged as the matrix of faults on
values (`fusiond.studies.faults.error_sigma_score`), on samples of whole seconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import random
import subprocess
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import can
import numpy as np

from drivers.base import monotonic_ns
from fusiond.navigation.solution import Mode, Solution
from fusiond.simulation.can.imu import SIM_IMU as SIM_IMU_OPTIONS
from fusiond.simulation.can.imu import CanImu
from fusiond.simulation.live_devices import SimulatedVehicle
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.simulation.trajectories import drive
from fusiond.studies.faults.error_sigma_score import Course, Event, Sample
from fusiond.studies.faults.runs import error_sample
from tests.broker import Broker
from tests.hil.processes import SIM_IMU
from tests.live.told import ToldDaemon

REST_S = 8.0
"""At rest before the drive, which goes on without another stop until 100 s later."""
CONFIG = """
vehicle = "rig"
state_file = "state.json"
[imu]
axes = ["+x", "-y", "-z"]
{imu}
[sources.gnss]
driver = "nmea"
port = "{folder}/gnss"
[aiding.gnss]
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
[alignment]
heading = ["gnss_course"]
[scheduler]
rate_hz = 50.0
[mqtt]
host = "127.0.0.1"
port = {port}
commands = ["set_position", "request_fix"]
"""
EVERY_TICKS = 5
STALL_S = 0.2
"""Less than half of `gap_s`, from which on the daemon calls the IMU silent."""
# unshare(2), linux/sched.h
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000


class Wire(PtyLine):
    """A serial line: `alter` makes what arrives of what is sent, `late_s` is how late it does.

    A line keeps its order: what was held back comes in one burst when it is late no more.
    """

    def __init__(self, link: Path) -> None:
        super().__init__(link)
        self.alter: Callable[[bytes], bytes] = lambda data: data
        self._late_s = 0.0
        self._held: deque[tuple[float, bytes]] = deque()

    @property
    def late_s(self) -> float:
        return self._late_s

    @late_s.setter
    def late_s(self, seconds: float) -> None:
        self._late_s = seconds
        if not seconds:
            self._held = deque((0.0, data) for _, data in self._held)
        self._flush()

    def write(self, data: bytes) -> bool:
        self._held.append((time.monotonic() + self._late_s, self.alter(data)))
        if self._late_s:
            asyncio.get_running_loop().call_later(self._late_s, self._flush)
            return True
        return self._flush()

    def _flush(self) -> bool:
        sent = True
        while self._held and self._held[0][0] <= time.monotonic():
            data = self._held.popleft()[1]
            sent = super().write(data) if data else True
        return sent


class AlteredImu(CanImu):
    """An IMU whose `number(n)` and `time(t_ns)` are what it says of its sample; None is lost."""

    def __init__(self) -> None:
        super().__init__(SIM_IMU_OPTIONS)
        self.number: Callable[[int], int | None] = lambda n: n
        self.time: Callable[[int], int] = lambda t_ns: t_ns

    def frames(
        self, number: int, t_ns: int, gyro: Sequence[float], accel: Sequence[float]
    ) -> list[can.Message]:
        said = self.number(number)
        return [] if said is None else super().frames(said, self.time(t_ns), gyro, accel)


def network_of_its_own() -> None:
    """Leave this process, and those that it starts, a loopback of their own: a multicast group is
    heard by every socket of a host at that port, whichever group it has asked for.

    Before there are threads. Where `vcan0` is up, or the kernel allows no such thing, all stays.
    """
    if "channel" in _vcan():
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNET) and libc.unshare(CLONE_NEWUSER | CLONE_NEWNET):
        return
    for words in ("link set lo up", "link set lo multicast on", "route add 239.0.0.0/8 dev lo"):
        subprocess.run(["ip", *words.split()], check=True)


def _vcan() -> dict[str, str]:
    up = subprocess.run(["ip", "link", "show", "vcan0", "up"], capture_output=True, check=False)
    return {"interface": "socketcan", "channel": "vcan0"} if up.stdout else {}


def bus_here(seed: int) -> dict[str, str]:
    """`vcan0` where it is up, else a multicast group of this process's own."""
    if found := _vcan():
        return found
    dice = random.Random(os.getpid() * 1000 + seed)
    channel = f"239.{dice.randrange(64, 250)}.{dice.randrange(250)}.2"
    return {"interface": "udp_multicast", "channel": channel}


@dataclass
class Rig:
    """A vehicle, the daemon that serves it and its broker. `samples` is what the daemon said at
    each whole second of the drive, held against the truth."""

    folder: Path
    vehicle: SimulatedVehicle
    daemon: ToldDaemon
    broker: Broker
    gnss: Wire
    rdss: Wire
    imu: AlteredImu
    can_bus: dict[str, str]
    samples: list[Sample]
    ended: str | None = None
    stalls: list[tuple[float, float]] = field(default_factory=list)
    """When this process, and so the vehicle, stood still for longer than `STALL_S`: when it went
    on, s of the drive, and how long. What the daemon made of that is no answer to a fault."""

    @property
    def now_s(self) -> float:
        """Time of the drive."""
        return (monotonic_ns() - self.vehicle.start_ns) * 1e-9

    async def until(self, t_s: float) -> None:
        """Wait for an instant of the drive."""
        await asyncio.sleep(max(0.0, t_s - self.now_s))

    def course(self) -> Course:
        """All that was said so far, events at the instants when they were heard."""
        start_ns = self.vehicle.start_ns
        events = [Event((e.t_ns - start_ns) * 1e-9, e.code, e.text) for e in self.daemon.events]
        return Course(list(self.samples), events, self.ended)

    async def listen(self) -> None:
        """Take every solution down until the process ends."""
        while True:
            try:
                said = await self.daemon.said()
            except AssertionError:
                self.ended = f"the daemon ended with {self.daemon.status}"
                return
            self.take(said)

    async def watch_itself(self) -> None:
        """Keep `stalls`."""
        while True:
            before_s = time.monotonic()
            await asyncio.sleep(0.05)
            late_s = time.monotonic() - before_s - 0.05
            if late_s > STALL_S:
                self.stalls.append((self.now_s, late_s))

    def take(self, said: Solution) -> None:
        """Take one solution down, if it is the first of its second."""
        t_s = (said.t_ns - self.vehicle.start_ns) * 1e-9
        # The least lever of a drive that has not begun has no truth.
        if t_s < 0.0 or (self.samples and t_s < self.samples[-1].t_s + 1.0):
            return
        true = self.vehicle.truth.at(np.array([t_s]))
        found = error_sample(said._replace(t_ns=round(t_s * 1e9)), true)
        self.samples.append(replace(found, t_s=float(int(t_s))))

    @property
    def mode(self) -> str:
        """The mode that was said last."""
        return self.samples[-1].mode if self.samples else str(Mode.WAITING)


@asynccontextmanager
async def rig(folder: Path, duration_s: float, seed: int, settings: str = "") -> AsyncIterator[Rig]:
    """All of it, ready to begin: the daemon loaded, the vehicle about to drive."""
    bus = bus_here(seed)
    vehicle = SimulatedVehicle(
        replace(SCENARIOS["drive"], path=partial(drive, rest_s=REST_S)),
        seed=seed,
        duration_s=duration_s,
        can_imu=SIM_IMU_OPTIONS.model_copy(update=bus),
        gnss_link=folder / "gnss",
        rdss_link=folder / "rdss",
    )
    gnss, rdss, imu = Wire(folder / "gnss"), Wire(folder / "rdss"), AlteredImu()
    vehicle.lines |= {"gnss": gnss, "rdss": rdss}
    vehicle.encoder = imu
    broker = Broker(folder)
    config = folder / "rig.toml"
    text = CONFIG.format(imu=SIM_IMU.format(**bus), folder=folder, port=broker.port)
    config.write_text(text + settings)
    daemon = ToldDaemon(config, EVERY_TICKS, {"RUNTIME_DIRECTORY": str(folder)})
    try:
        broker.start()
        await daemon.load()
        yield Rig(folder, vehicle, daemon, broker, gnss, rdss, imu, bus, [])
    finally:
        await daemon.kill()
        broker.stop()


@asynccontextmanager
async def under_way(made: Rig) -> AsyncIterator[None]:
    """The daemon begins, the vehicle drives off, and what the daemon says is taken down."""
    await made.daemon.begin()
    work = made.vehicle.run(), made.listen(), made.watch_itself()
    tasks = [asyncio.create_task(each) for each in work]
    try:
        # The vehicle takes its start instant with its first step.
        await asyncio.sleep(0)
        yield
        if made.ended is None:
            tasks[1].cancel()
            await asyncio.gather(tasks[1], return_exceptions=True)
            await made.daemon.terminate()
    finally:
        for task in tasks:
            task.cancel()
        for task in tasks:
            with contextlib.suppress(asyncio.CancelledError):
                await task
