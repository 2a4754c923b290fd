"""A drive in time of its own: the daemon's chain and recorder, fed by the simulated devices.

Every read, frame, timer and tick comes as it would live, in the order of a clock that the rig
turns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from drivers.can.bus import CanFrame
from fusiond.clock.clock import Clock
from fusiond.configuration.recording import Recording
from fusiond.configuration.schema import Config
from fusiond.demo.demo import demo_config, demo_scenario
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.loaded import LOADED, Loaded
from fusiond.live.publishing import Publishing
from fusiond.live.scheduler import Scheduler
from fusiond.live.warm_keeper import KEPT_STATE, WarmKeeper
from fusiond.navigation.solution import Solution
from fusiond.outputs.commands import NAMES, Command
from fusiond.outputs.topics import EVENT
from fusiond.recording.digest import state_digest
from fusiond.recording.recorder import Recorder
from fusiond.simulation.vehicle import SimulatedVehicle
from tests.clock.host_time import MS, Host

TICK_NS = 20 * MS


class Drive:
    """The demo's car with recording into `folder`; `run` drives on, `close` ends the daemon.

    `host` is the computer's time; `unplugged` devices send nothing.
    """

    def __init__(self, folder: Path, duration_s: float, **options: Any) -> None:
        config = demo_config(1, folder / "gnss", folder / "rdss")
        recording = Recording(directory=folder, min_free_mb=0.0, **options)
        update = {"recording": recording, "mqtt": config.mqtt.model_copy(update={"enabled": False})}
        self.config: Config = config.model_copy(update=update)
        self.vehicle = SimulatedVehicle(demo_scenario(config), seed=3, duration_s=duration_s)
        self.host = Host()
        self._start_ns = self.vehicle.start_ns = self.host.mono + 500 * MS
        utc_ns = self.host.utc(self._start_ns)
        self.vehicle.utc_start_ns = self.vehicle.terminal.utc_start_ns = utc_ns
        self.clock = Clock(self.config.clock, self.host)
        self.events = Events(self.clock)
        self.recorder = Recorder(
            self.config, self.clock, lambda code, text: self.events.report("recording", code, text)
        )
        self.chain = Chain(
            self.config,
            self.clock,
            self.events,
            on_outcome=lambda e: (
                e.outcome and self.recorder.innovation(e.aid.source, e.key[0], e.outcome)
            ),
        )
        self.inputs = self.chain.sources.inputs
        self._warm = WarmKeeper(self.config, self.clock, lambda code, text: None, {})
        scheduler = Scheduler(50.0, lambda t_ns: None, now=self.clock.now_ns)
        self._publishing = Publishing(
            self.config, self.chain, scheduler.status, {"recording": self.recorder}
        )
        self.unplugged: set[str] = set()
        self.solutions: list[Solution] = []
        self.digests: list[bytes] = []
        self._next_imu = self._next_gnss = 0
        self.recorder.listen(self.inputs)
        self.recorder.arm(LOADED.dump_python(Loaded(), mode="json"))
        self._hear_requests()
        self.events.listen(partial(self.recorder.take, EVENT))
        for name in ("imu", "gnss", "rdss"):
            self.take(name, "open")

    def _hear_requests(self) -> None:
        """What the driver sends goes to the terminal, and where it goes anyhow."""
        inputs = self.inputs["rdss"]
        recorded = inputs.heard

        def heard(kind: str, t_ns: int, payload: Any) -> None:
            if kind == "sent":
                self.vehicle.terminal.receive(payload, self.t_s)
            if recorded is not None:
                recorded(kind, t_ns, payload)

        inputs.heard = heard

    @property
    def t_s(self) -> float:
        """Of the vehicle's drive."""
        return (self.host.mono - self._start_ns) * 1e-9

    def take(self, source: str, kind: str, payload: Any = None) -> None:
        self.host.mono += 30_000  # each input takes its time
        self.inputs[source].take(kind, payload, self.host.mono)

    def command(self, command: Command) -> str:
        """An operator says something."""
        self.host.mono += 30_000
        self.recorder.command(self.host.mono, NAMES[type(command)], command)
        return self.chain.operator.carry_out(command, self.host.mono)

    def run(self, until_s: float, at_tick: Callable[[int], None] | None = None) -> None:
        """Drive until `until_s` of the drive."""
        while self.t_s < until_s:
            deadline_ns = (self.host.mono // TICK_NS + 1) * TICK_NS
            self._serve(deadline_ns)
            self.host.mono = max(self.host.mono, deadline_ns) + 300_000  # a tick is never in time
            self.tick(deadline_ns)
            if at_tick is not None:
                at_tick(deadline_ns)

    def tick(self, t_ns: int) -> None:
        self.recorder.tick_begins(t_ns)
        solution = self.chain.tick(t_ns)
        self.solutions.append(solution)
        self.digests.append(state_digest(self.chain.navigator, solution))
        self.recorder.tick_ended(t_ns, self.host.mono - t_ns, 0, self.digests[-1])
        if self.recorder.state_due(t_ns):
            self._keep_state(t_ns, solution)
        self._publishing.tick(t_ns, solution)

    def _keep_state(self, t_ns: int, solution: Solution) -> None:
        state = self._warm.state(solution, self.chain.navigator)
        if state is not None:
            self.recorder.keep_state(t_ns, KEPT_STATE.dump_json(state))

    def _serve(self, until_ns: int) -> None:
        vehicle, until_s = self.vehicle, (until_ns - self._start_ns) * 1e-9
        while vehicle.truth.t_s[self._next_imu + 1] <= until_s:
            k = self._next_imu
            self._next_imu += 1
            if "imu" not in self.unplugged:
                t_ns = round(float(vehicle.truth.t_s[k + 1]) * 1e9)
                gyro, accel = vehicle.imu.gyro[k].tolist(), vehicle.imu.accel[k].tolist()
                for m in vehicle.encoder.frames(k + 1, t_ns, gyro, accel):
                    self._frame(m.arbitration_id, m.is_extended_id, bytes(m.data))
        while vehicle.gnss.t_arrival_s[self._next_gnss] <= until_s:
            sentences = vehicle.gnss.nmea(self._next_gnss, vehicle.utc_start_ns)
            self._next_gnss += 1
            if "gnss" not in self.unplugged:
                self.take("gnss", "read", sentences[:40])  # boundaries fall where they fall
                self.take("gnss", "read", sentences[40:])
                self.take("gnss", "silence")
        self.take("rdss", "due")
        if data := vehicle.terminal.take(until_s):
            self.take("rdss", "read", data)

    def _frame(self, can_id: int, extended: bool, data: bytes) -> None:
        self.host.mono += 30_000
        frame = CanFrame(can_id, extended, data, self.host.mono, self.host.realtime_ns())
        self.inputs["imu"].take("frame", frame, self.host.mono)

    def close(self) -> list[Path]:
        """The daemon ends; the files."""
        self.recorder.close()
        return sorted(self.config.recording.directory.glob("*.mcap"))  # type: ignore[union-attr]
