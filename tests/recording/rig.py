"""The daemon's chain and recorder in time of its own: a clock that a test turns, and no device.

Every read, frame, timer and tick comes as it would live, in the order of that clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from drivers.can.bus import CanFrame
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.recording import Recording
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.publishing import Publishing
from fusiond.live.restored_state import RESTORED_STATE, RestoredState
from fusiond.live.state_in_memory import KEPT_STATE, WarmKeeper
from fusiond.live.tick_scheduler import Scheduler
from fusiond.navigation.solution import Solution
from fusiond.outputs.commands import NAMES, Command
from fusiond.outputs.topics import EVENT
from fusiond.recording.recorder import Recorder
from fusiond.recording.state_digest import state_digest
from tests.clock.host_time import MS, Host
from tests.patience import PATIENCE_S

TICK_NS = 20 * MS


class Rig:
    """A daemon that records into `folder`; `run` ticks on, `close` ends it.

    `host` is the computer's time, `end_ns` when there is nothing more to serve. A subclass has
    devices: it serves what they say up to an instant.
    """

    def __init__(self, folder: Path, config: Config, host: Host, **options: Any) -> None:
        recording = Recording(directory=folder, min_free_mb=0.0, **options)
        update = {"recording": recording, "mqtt": config.mqtt.model_copy(update={"enabled": False})}
        self.end_ns = 0
        self.config: Config = config.model_copy(update=update)
        self.host = host
        self.clock = Clock(self.config.clock, self.host)
        self.events = Events(self.clock)
        self.recorder = Recorder(
            self.config, self.clock, lambda code, text: self.events.report("recording", code, text)
        )
        self.chain = Chain(
            self.config,
            self.clock,
            self.events,
            on_outcome=self.recorder.innovation,
        )
        self.chain.navigator.timeline.keeps_raw = True
        self.inputs = self.chain.sources.inputs
        self._warm = WarmKeeper(self.config, self.clock, lambda code, text: None, {})
        scheduler = Scheduler(50.0, lambda t_ns: None, now=self.clock.now_ns)
        self._publishing = Publishing(
            self.config, self.chain, scheduler.status, {"recording": self.recorder}
        )
        self.solutions: list[Solution] = []
        self.digests: list[bytes] = []
        self.recorder.listen(self.inputs)
        self.recorder.arm(RESTORED_STATE.dump_python(RestoredState(), mode="json"))
        self.events.listen(partial(self.recorder.publish, EVENT))
        for name in self.inputs:
            self.take(name, "open")

    def take(self, source: str, kind: str, payload: Any = None) -> None:
        self.host.mono += 30_000  # each input takes its time
        self.inputs[source].take(kind, payload, self.host.mono)

    def frame(self, source: str, can_id: int, extended: bool, data: bytes) -> None:
        """A frame of the bus, stamped as it is taken."""
        self.host.mono += 30_000
        frame = CanFrame(can_id, extended, data, self.host.mono, self.host.realtime_ns())
        self.inputs[source].take("frame", frame, self.host.mono)

    def command(self, command: Command) -> str:
        """An operator says something."""
        self.host.mono += 30_000
        self.recorder.command(self.host.mono, NAMES[type(command)], command)
        return self.chain.operator.carry_out(command, self.host.mono)

    def serve(self, until_ns: int) -> None:
        """What the devices say up to `until_ns`."""
        raise NotImplementedError

    def run_to(self, until_ns: int, at_tick: Callable[[int], None] | None = None) -> None:
        """Go on until `until_ns`."""
        while self.host.mono < until_ns:
            deadline_ns = (self.host.mono // TICK_NS + 1) * TICK_NS
            self.serve(deadline_ns)
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

    def until_file(self, number: int) -> None:
        """Wait until the writing thread has begun so many files: a state is kept for each, and on a
        busy host it would come at any later tick."""
        begun, writer = time.monotonic(), self.recorder._writer
        assert writer is not None
        while writer.parts < number:
            assert time.monotonic() - begun < PATIENCE_S
            time.sleep(0.002)

    def close(self) -> list[Path]:
        """The daemon ends; the files."""
        self.recorder.close()
        return sorted(self.config.recording.directory.glob("*.mcap"))  # type: ignore[union-attr]
