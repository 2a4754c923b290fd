"""Functions and modules that an ordinary fix passes, from bytes on a wire to the payload of `nav`.

The daemon's own objects in its event loop: a receiver's line is a pseudo terminal, the scheduler
ticks at 100 Hz, the publisher of MQTT encodes what goes to the broker. Simulated are the vehicle,
the host's clocks, by which a minute takes seconds, and the broker. The inertial unit's samples have
a way of their own, which is left out (`LEFT_OUT`); so is what a library does.

Counted as in `fusiond.bench.fix_call_trace`, whose way is the middle of this one: from the read of
the fix's bytes to the first `nav` that holds it.
"""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import aiomqtt
import numpy as np

from drivers.can.bus import CanFrame
from drivers.can.imu import CanImuDriver
from drivers.nmea.driver import NmeaDriver
from drivers.port import ByteBudget
from fusiond.bench.fix_call_trace import FixPath, Trace, median
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import load_config
from fusiond.live.daemon import Daemon
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.pty_line import PtyLine
from fusiond.simulation.scenarios import SCENARIOS, Scenario
from fusiond.simulation.trajectories import drive

REST_S, UNDER_WAY_S, LONGEST_S = 8.0, 60.0, 100.0
"""At rest, time of the first fix that is traced, and length of the drive."""
FIXES_HZ, LATENCY_S = 10.0, (0.05, 0.1)
FIXES = 9
"""Of one second: what is done once a second is done at most in one."""
OPENED_MS = 5000
"""Longest wait for the thread that opens the line."""
TICK_NS = 10_000_000
BEGIN_NS = 1_000_000_000_000
AHEAD_NS = 1_796_083_200_000_000_000 - BEGIN_NS
"""Begin of the drive on the host's monotonic clock, and the lead of UTC: it is 2026-12-01."""
LEFT_OUT = frozenset(
    {"Wired._samples", "Sources.poll", "Sources.catch_up", "Sources.take_imu", "Navigator.add_imu"}
    | {"ReceiverDriver._watch", "SerialLine._serve", "SerialLine.run"}
)
"""Entrances of samples, and timers of the host: nothing of a fix is called from there."""
CONFIG = """
vehicle = "bench"
state_file = "{folder}/state.json"
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = 100.0
gyro_range_deg_s = 2000.0
accel_range_g = 10.0
[sources.imu]
driver = "can_imu"
{imu}
[sources.gnss]
driver = "nmea"
port = "{port}"
last_sentence = "ZDA"
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[alignment]
heading = ["gnss_course"]
"""


class Host:
    """Clocks of a simulated computer."""

    def __init__(self) -> None:
        self.t_ns = BEGIN_NS

    def monotonic_ns(self) -> int:
        return self.t_ns

    def realtime_ns(self) -> int:
        return self.t_ns + AHEAD_NS

    slewed_ns = boottime_ns = monotonic_ns


class Broker:
    """Broker that takes everything; `payloads` are those of `nav`."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    async def publish(self, address: str, payload: bytes, *, qos: int, retain: bool) -> None:
        if address.endswith("/nav"):
            self.payloads.append(payload)


class Wired:
    """Daemon on a receiver's line and an inertial unit's frames, run from tick to tick."""

    def __init__(self, folder: Path) -> None:
        scenario: Scenario = replace(SCENARIOS["drive"], path=partial(drive, rest_s=REST_S))
        scenario = replace(
            scenario, gnss=replace(scenario.gnss, rate_hz=FIXES_HZ, latency_s=LATENCY_S)
        )
        rng = np.random.default_rng(1)
        self.truth = scenario.truth(LONGEST_S)
        self._imu = scenario.imu_output(self.truth, rng)
        self._encoder = CanImu(SIM_IMU)
        self._receiver = GnssReceiver(self.truth, scenario.gnss, rng)
        self._line = PtyLine(folder / "gnss")
        self.host, self.broker = Host(), Broker()
        file = folder / "bench.toml"
        said = SIM_IMU.model_dump(exclude_unset=True)
        imu = "\n".join(f"{key} = {json.dumps(value)}" for key, value in said.items())
        file.write_text(CONFIG.format(imu=imu, port=self._line.link, folder=folder))
        config = load_config(file)
        self.daemon = Daemon(config, Clock(config.clock, self.host))
        self.daemon.scheduler._sleep = self._sleep
        self._woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sample = self._epoch = self._sent = 0

    async def _sleep(self, _: float) -> None:
        self._woken = asyncio.get_running_loop().create_future()
        await self._woken

    async def begin(self) -> None:
        """Open the line, start scheduler and publisher."""
        daemon = self.daemon
        mqtt = cast(MqttPublisher, daemon.outputs["mqtt"])
        mqtt._flowing.set()
        self._line.plug()
        self.gnss = cast(NmeaDriver, daemon.sources.all["gnss"].driver)
        self.gnss._line._budget = ByteBudget(now_s=lambda: self.host.t_ns * 1e-9)
        tasks = (
            self.gnss.run(),
            daemon.scheduler.run(),
            mqtt._send_latest(cast(aiomqtt.Client, self.broker)),
        )
        self.tasks = [asyncio.create_task(task) for task in tasks]
        for _ in range(OPENED_MS):
            if self.gnss.counters["opened"]:
                break
            await asyncio.sleep(0.001)

    async def tick(self) -> None:
        """Bring what has come since the last tick, and tick."""
        deadline = self.host.t_ns + TICK_NS
        self._samples((deadline - BEGIN_NS) * 1e-9)
        t_s = float(self._receiver.t_arrival_s[self._epoch])
        if BEGIN_NS + t_s * 1e9 <= deadline:
            self.host.t_ns = BEGIN_NS + round(t_s * 1e9)
            data = self._receiver.nmea(self._epoch, BEGIN_NS + AHEAD_NS)
            assert self._line.write(data)
            self._epoch += 1
            self._sent += len(data)
            while self.gnss.counters["bytes_in"] < self._sent:  # noqa: ASYNC110 (nobody sets one)
                await asyncio.sleep(0)
        self.host.t_ns = deadline
        self._woken.set_result(None)
        await self._turns()

    async def _turns(self) -> None:
        for _ in range(4):
            await asyncio.sleep(0)

    def _samples(self, t_s: float) -> None:
        """Frames of the inertial unit's samples until `t_s`."""
        unit = cast(CanImuDriver, self.daemon.sources.all["imu"].driver)
        while self.truth.t_s[self._sample + 1] <= t_s + 1e-9:
            k = self._sample = self._sample + 1
            t_ns = round(float(self.truth.t_s[k]) * 1e9)
            sample = self._imu.gyro[k - 1].tolist(), self._imu.accel[k - 1].tolist()
            for message in self._encoder.frames(k, t_ns, *sample):
                seen_ns = BEGIN_NS + t_ns
                data = bytes(message.data)
                frame = CanFrame(message.arbitration_id, message.is_extended_id, data, seen_ns)
                unit.inputs.take("frame", frame, seen_ns)

    @property
    def fused(self) -> int:
        """Measurements of the receiver that have been fused."""
        return self.daemon.navigator.outcomes()["gnss"]["fused"]

    @property
    def under_way(self) -> bool:
        """True from the first fix to trace on."""
        return (self.host.t_ns - BEGIN_NS) * 1e-9 >= UNDER_WAY_S

    @property
    def fix_arrives(self) -> bool:
        """True if the next tick brings a fix."""
        t_s = float(self._receiver.t_arrival_s[self._epoch])
        return BEGIN_NS + t_s * 1e9 <= self.host.t_ns + TICK_NS

    async def fix(self) -> None:
        """Bring a fix, and tick until a `nav` has been sent."""
        self.broker.payloads.clear()
        await self.tick()
        while not self.broker.payloads:
            await self.tick()


def wired_fix() -> FixPath:
    """Median of `FIXES` fixes under way."""
    logging.disable(logging.WARNING)  # what the daemon says of the drive
    try:
        with TemporaryDirectory() as folder:
            return asyncio.run(_wired_fix(Path(folder)))
    finally:
        logging.disable(logging.NOTSET)


async def _wired_fix(folder: Path) -> FixPath:
    wired = Wired(folder)
    await wired.begin()
    ways: list[FixPath] = []
    while len(ways) < FIXES:
        if not wired.under_way or not wired.fix_arrives:
            await wired.tick()
            continue
        fused = wired.fused
        with Trace(("fusiond.", "drivers."), LEFT_OUT) as trace:
            await wired.fix()
        if wired.fused == fused + 1:
            ways.append(trace.way)
    for task in wired.tasks:
        task.cancel()
    await asyncio.gather(*wired.tasks, return_exceptions=True)
    return median(ways)
