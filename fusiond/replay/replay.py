"""Replay of a recording through the daemon's chain: drivers, clock, navigator, tick by tick.

A replay from the beginning, with the log's own configuration, must end every tick in the same bits:
the log holds digests, and the first difference is named. A replay from the middle of a drive (a cut
log, a recording started during a drive) begins at a state that the log holds, as a restarted daemon
would; it cannot be compared.
"""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pydantic import ValidationError

from drivers.measurements import Measurement
from drivers.raw.messages import RawGnssEpoch
from fusiond.clock.results import Instant
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.restored_state import RESTORED_STATE, RestoredState
from fusiond.live.state_in_memory import KEPT_STATE
from fusiond.navigation.solution import Solution
from fusiond.navigator.state_file import DamagedStateError
from fusiond.navigator.timeline import Entry
from fusiond.outputs.commands import CARRIED_OUT, CommandRefusedError
from fusiond.outputs.messages.event import EventMessage
from fusiond.recording.channels import STATE
from fusiond.recording.reader import Log
from fusiond.recording.records import Kind, Record, Tick, input_of, tick_of
from fusiond.recording.state_digest import state_digest
from fusiond.replay.recorded_time import RecordedReadings, RecordedTime

log = logging.getLogger("fusiond")


Arrival = Callable[[Measurement | RawGnssEpoch, Instant], None]


class Divergence(NamedTuple):
    """First difference of a replay from the recording."""

    tick: int
    t_ns: int
    what: str


@dataclass
class Comparison:
    """Comparison of a replay's ticks and requests with the recorded ones."""

    ticks: int = 0
    compared: int = 0
    differing: int = 0
    first: Divergence | None = None
    lost_inputs: int = 0
    faults: list[str] = field(default_factory=list)


class ReplayedTick(NamedTuple):
    """A tick of a replay beside the recorded one."""

    recorded: Tick
    solution: Solution


class Replay:
    """One replay of a log with a configuration. `exact`: the log's own digests should be
    reproduced, which needs its configuration and the start of the drive.

    `on_event`, `on_outcome` and `on_arrival` (each measurement, with its instant) receive the
    reports of the daemon's parts. Without `navigate` the filter does not run, and there are no
    ticks. `afresh` ignores the daemon's restored state.
    """

    def __init__(
        self,
        recording: Log,
        config: Config,
        same: bool = True,
        on_event: Callable[[EventMessage], None] | None = None,
        on_outcome: Callable[[Entry], None] | None = None,
        navigate: bool = True,
        on_arrival: Arrival | None = None,
        afresh: bool = False,
    ) -> None:
        self._navigate, self._on_arrival, self._afresh = navigate, on_arrival, afresh
        self._log = recording
        self._config = config
        self._same = same
        self._on_event, self._on_outcome = on_event, on_outcome
        self._sources = recording.about.sources
        self._sent: deque[tuple[str, bytes]] = deque()
        self._inputs = 0
        self.exact = False
        self.began = "nothing in the log"
        """Starting state of the replay, in words."""
        self.comparison = Comparison()
        self.chain: Chain | None = None

    def ticks(self) -> Iterator[ReplayedTick]:
        """Run the replay once and yield each tick after its end."""
        after_ns = 0
        for record in self._log.records():
            if self.chain is None:
                after_ns = self._start(record)
            if record.kind is Kind.START or record.t_ns <= after_ns:
                continue
            tick = self._handle(record)
            if tick is not None:
                yield tick

    # ------------------------------------------------------------------ start

    def _start(self, record: Record) -> int:
        """Assemble the chain and return the instant (ns) up to which inputs are too early."""
        start: dict[str, Any] = json.loads(record.payload) if record.kind is Kind.START else {}
        from_start = bool(start.get("from_start"))
        system_clock = start.get("system_clock") or _system_clock(record, self._log)
        restored, after_ns = RestoredState(), 0
        if self._afresh:
            self.began = "an alignment, as was asked"
        elif from_start:
            restored = RESTORED_STATE.validate_json(
                json.dumps({name: start.get(name) for name in ("saved", "warm", "calibration")})
            )
            self.began = "the daemon's start"
        else:
            restored, after_ns = self._on_the_way(start)
        self._time = RecordedTime(max(record.t_ns, after_ns))
        self._readings = RecordedReadings(self._time, system_clock)
        clock = Clock(self._config.clock, self._time, self._readings)
        clock.restore_system(system_clock)
        events = Events(clock)
        if self._on_event is not None:
            events.listen(self._on_event)
        self.chain = Chain(self._config, clock, events, restored.saved, self._on_outcome)
        try:
            restored.restore_into(self.chain)
        except DamagedStateError as error:
            self.began = f"an alignment: the log's state is of another filter ({error})"
        self.chain.sources.on_arrival = self._on_arrival
        of_drivers = self.chain.sources.inputs
        for name, inputs in of_drivers.items():
            inputs.on_input = self._listener(name)
        self._driver_inputs = [of_drivers.get(name) for name in self._sources]
        self.exact = self._same and from_start and self._log.first_part and not self._afresh
        self._finish()
        return after_ns

    def _on_the_way(self, start: dict[str, Any]) -> tuple[RestoredState, int]:
        """First state in the log, and its instant."""
        for message in self._log.messages(STATE):
            try:
                kept = KEPT_STATE.validate_json(message.data)
            except ValidationError:
                break
            self.began = "a state on the way"
            return RestoredState(warm=kept), message.t_log_ns - self._log.about.epoch_ns
        self.began = "an alignment: the log begins on the way and holds no state"
        return RestoredState(), 0

    def _listener(self, name: str) -> Callable[[str, int, Any], None]:
        def record(kind: str, t_ns: int, payload: Any) -> None:
            if kind == "sent":
                self._sent.append((name, payload))

        return record

    # ------------------------------------------------------------------ on the way

    def _handle(self, record: Record) -> ReplayedTick | None:
        assert self.chain is not None
        kind, _, t_ns, _, readings = record
        self._time.t_ns = t_ns
        if readings:
            self._readings.give(readings)
        tick = None
        if kind is Kind.TICK:
            if self._navigate:
                tick = self._tick(record)
            else:
                self.chain.sources.imu.samples()
        elif kind is Kind.COMMAND:
            self._command(record)
        elif kind is Kind.SENT:
            self._compare_sent(record)
        else:
            self._inputs += 1
            self._replay_input(record)
        if readings:
            self._finish()
        return tick

    def _finish(self) -> None:
        """Consume the remaining clock readings, which the daemon's outputs made."""
        assert self.chain is not None
        while self._readings.pending:
            self.chain.clock.look()

    def _replay_input(self, record: Record) -> None:
        inputs = self._driver_inputs[record.source]
        if inputs is None:  # another configuration, without it
            return
        kind, payload = input_of(record)
        try:
            inputs.take(kind, payload, record.t_ns)
        except KeyError:
            self._fault(f"{self._sources[record.source]}: its driver knows no input {kind!r}")
        except Exception as error:  # the daemon restarts a driver that raises
            self._fault(f"{self._sources[record.source]}: {error!r}")

    def _fault(self, text: str) -> None:
        if text not in self.comparison.faults:
            log.warning("%s", text)
            self.comparison.faults.append(text)

    def _command(self, record: Record) -> None:
        assert self.chain is not None
        said = json.loads(record.payload)
        model = CARRIED_OUT[said.pop("name")]
        try:
            self.chain.operator.carry_out(model.model_validate(said), record.t_ns)
        except CommandRefusedError as error:
            log.info("%s", error)

    def _tick(self, record: Record) -> ReplayedTick:
        assert self.chain is not None
        recorded = tick_of(record)
        solution = self.chain.tick(record.t_ns)
        c = self.comparison
        c.ticks += 1
        if self.exact:
            c.compared += 1
            if recorded.inputs != self._inputs:
                c.lost_inputs = recorded.inputs - self._inputs
                self._diverged(record, f"{c.lost_inputs} inputs are missing in the log")
            elif state_digest(self.chain.navigator, solution) != recorded.digest:
                c.differing += 1
                self._diverged(record, "the solution or the filter's state")
        return ReplayedTick(recorded, solution)

    def _compare_sent(self, record: Record) -> None:
        name = self._sources[record.source]
        if not self.exact:
            self._sent.clear()
        elif not self._sent or self._sent.popleft() != (name, record.payload):
            self._diverged(record, f"what was sent to {name}")

    def _diverged(self, record: Record, what: str) -> None:
        if self.comparison.first is None:
            self.comparison.first = Divergence(self.comparison.ticks, record.t_ns, what)


def _system_clock(record: Record, recording: Log) -> dict[str, int | None]:
    """System clock by the log's own dates, for a log that holds no readings of it."""
    t_ns, ahead_ns = record.t_ns, recording.about.epoch_ns
    return {
        **dict.fromkeys(("_sampled_ns", "_queued_ns", "_stepped_ns"), t_ns),
        **dict.fromkeys(("offset_ns", "held_ns"), ahead_ns),
        **dict.fromkeys(("_boot_ns", "slept_ns", "changes", "last_step_ns"), 0),
        "before_step_ns": None,
    }
