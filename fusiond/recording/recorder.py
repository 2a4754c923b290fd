"""Daemon side of a recording: every input is written in the order of handling.

A record begins before its input is handled and is complete when the next one begins: it owns the
readings of the host's clocks in between. A tick closes a message. So the log grows by one message
of inputs and a few derived ones a tick, at any rate of the devices.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from pydantic import BaseModel

from drivers.base import DriverStatus
from drivers.can.bus import CanFrame
from drivers.external_inputs import Inputs
from fusiond.clock.host import SECOND_NS, ReadClock
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.recording import Recording
from fusiond.configuration.schema import Config
from fusiond.navigator.timeline import Entry
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.status import RecordingState, RecordingStatus
from fusiond.outputs.topics import INNOVATIONS, Topic
from fusiond.recording.channels import INNOVATION, INPUT, STATE, innovation
from fusiond.recording.log_metadata import about_run
from fusiond.recording.log_writer import Item, LogWriter, log_stem
from fusiond.recording.records import (
    NO_SOURCE,
    Kind,
    Reading,
    Record,
    Tick,
    input_record,
    pack,
    reading,
    tick_payload,
)
from fusiond.recording.retry import Retry

MESSAGE_BYTES = 64 * 1024
"""Size at which inputs without a tick form a message of their own."""
STATE_EVERY_NS = 10 * SECOND_NS
"""Interval of stored states, by which a cut may begin early; a state has 6 kB."""


class RecordingRefusedError(Exception):
    """Error: the recording cannot be started or stopped now; the text has the reason."""


class Recorder:
    """Recorder of one daemon, as an output (`fusiond.outputs.base`) with commands of its own.

    `on_event(code, text)` receives `recording_started`, `recording_stopped` and `recording_failed`;
    a failed recording resumes by itself (`fusiond.recording.retry`). `begin` and `end` may be
    called at any time; `listen` connects the drivers.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        on_event: Callable[[str, str], None],
    ) -> None:
        self._config = config
        self._options: Recording = config.recording
        self._clock = clock
        self._event = on_event
        self._inputs: dict[str, Inputs] = {}
        self._numbers: dict[str, int] = {}
        now_ns = clock.now_ns()
        self._epoch_ns = (clock.utc_ns(now_ns) or now_ns) - now_ns
        self.state: RecordingState = "off"
        """State of the recording; `waiting`: the last seconds are kept in memory until an event."""
        self._writer: LogWriter | None = None
        self._closing: list[LogWriter] = []
        self._again = Retry()
        self._ring: deque[Item] = deque()
        self._until_ns: int | None = None
        self._started: Record | None = None
        self._readings: list[Reading] = []
        self._after: list[Record] = []
        self._message: list[bytes] = []
        self._message_bytes = 0
        self._sequence = 0
        self._count = 0
        self._message_ns = now_ns
        self._state_ns: int | None = None
        self._state_part = 0

    # ------------------------------------------------------------------ what is asked of it

    def listen(self, inputs: Mapping[str, Inputs]) -> None:
        """Record the inputs of drivers, by source."""
        self._inputs = dict(inputs)
        self._numbers = {name: number for number, name in enumerate(inputs)}

    def arm(self, restored: Mapping[str, Any]) -> None:
        """Start recording as configured. `restored` is the saved state that the start read; a
        replay starts from it."""
        if self._options.directory is None:
            return
        if self._options.when == "always":
            self.begin(restored)
        elif self._options.when == "event":
            self._attach(restored)
            self.state = "waiting"

    def begin(self, restored: Mapping[str, Any] | None = None) -> str:
        """Start recording and return the file's name. Raises `RecordingRefusedError`.

        `restored` is None for a recording that starts during a run.
        """
        if self.state == "recording":
            raise RecordingRefusedError(f"recording already, into {self._path().name}")
        self._again.give_up()
        return self._record_into(self._open(), restored)

    def _record_into(self, writer: LogWriter, restored: Mapping[str, Any] | None) -> str:
        if self.state != "waiting":
            self._attach(restored)
        self._writer = writer
        while self._ring:
            writer.put(self._ring.popleft())
        self.state = "recording"
        self._state_ns = None
        self._event("recording_started", str(writer.path))
        return writer.path.name

    def end(self, why: str) -> str:
        """Stop recording and finish the file. Raises `RecordingRefusedError`."""
        if self._writer is None and self.state == "failed":
            self._again.give_up()
            self.state = "off"
            return "nothing more, since it had failed"
        if self._writer is None:
            raise RecordingRefusedError("nothing is being recorded")
        path = self._path()
        self._complete()
        self._flush()
        writer, self._writer = self._writer, None
        writer.close()
        self._closing = [w for w in (*self._closing, writer) if w.busy]
        self._until_ns = None
        if writer.stopped is not None:
            why = writer.stopped
            self.state = "failed"
            self._event("recording_failed", f"{path}: {why}")
        else:
            self.state = "off"
            self._event("recording_stopped", f"{path}: {why}")
        self._detach()
        if self._options.when == "event" and self.state == "off":
            self._attach(None)
            self.state = "waiting"
        return path.name

    def close(self) -> None:
        """Finish at the daemon's end and return when everything is on the disk. Call it from a
        thread."""
        self._again.give_up()
        if self._writer is not None:
            self.end("the daemon ends")
        for writer in self._closing:
            writer.wait()

    @property
    def active(self) -> bool:
        """True if input must be handed to the recorder."""
        return self.state in ("recording", "waiting")

    @property
    def recording(self) -> RecordingStatus:
        """State of the recording for `status`."""
        writer = self._writer
        if writer is None:
            return RecordingStatus(self.state)
        return RecordingStatus(self.state, str(writer.path), writer.dropped, writer.free_mb)

    # ------------------------------------------------------------------ as an output

    @property
    def name(self) -> str:
        return "recording"

    @property
    def nav_rate_hz(self) -> float:
        return self._config.mqtt.nav_rate_hz

    @property
    def sets_clocks(self) -> bool:
        return False

    @property
    def counters(self) -> Counter[str]:
        return Counter(recording_dropped=self.recording.dropped)

    @property
    def status(self) -> DriverStatus:
        detail = self.recording.file or self.state
        return DriverStatus("failed" if self.state == "failed" else "running", detail)

    def publish(self, topic: Topic, message: Message) -> None:
        """Write a topic's message to the log; an event of `recording.events` starts a recording if
        configured. `innovations` is left out: the log has each innovation by itself."""
        t_ns = self._clock.now_ns()
        if self.active and topic is not INNOVATIONS:
            self._put(Item(f"/{topic.name}", t_ns + self._epoch_ns, message))
        if isinstance(message, EventMessage):
            self._look_at(message, t_ns)

    async def run(self) -> None:
        """Record until cancelled; everything is on disk when this returns."""
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.to_thread(self.close)

    # ------------------------------------------------------------------ what happens

    def command(self, t_ns: int, name: str, command: BaseModel) -> None:
        """Begin the record of an operator's command, before its execution."""
        if self.active:
            text = json.dumps({"name": name, **command.model_dump(mode="json")})
            self._begin(Record(Kind.COMMAND, NO_SOURCE, t_ns, text.encode()))

    def tick_begins(self, t_ns: int) -> None:
        """Begin the tick with this deadline."""
        if self.state == "failed":
            self._take_up_again(t_ns)
        if self.active:
            self._begin(Record(Kind.TICK, NO_SOURCE, t_ns, b""))

    def tick_ended(self, t_ns: int, delay_ns: int, overruns: int, digest: bytes) -> None:
        """End the tick; clock readings until the next input still belong to its record."""
        if self._writer is not None and self._writer.stopped is not None:
            self.end(self._writer.stopped)
        if self._started is None or self._started.kind is not Kind.TICK:
            return
        payload = tick_payload(Tick(self._count, overruns, delay_ns, digest))
        self._started = self._started._replace(payload=payload)
        if self._until_ns is not None and t_ns > self._until_ns:
            self.end(f"{self._options.after_s:.0f} s after the last event")

    def innovation(self, entry: Entry) -> None:
        """Record the outcome of a measurement."""
        if self.active and entry.outcome is not None:
            t_log_ns = self._clock.now_ns() + self._epoch_ns
            self._put(Item(INNOVATION, t_log_ns, innovation(entry, entry.outcome)))

    def state_due(self, t_ns: int) -> bool:
        """True if `keep_state` is due: at the begin of each file, then at intervals."""
        old = self._state_ns is None or t_ns - self._state_ns >= STATE_EVERY_NS
        parts = 0 if self._writer is None else self._writer.parts
        return self.active and (old or parts != self._state_part)

    def keep_state(self, t_ns: int, kept: bytes) -> None:
        """Store a navigation state in the warm start's format (JSON), at which a cut log can
        begin."""
        self._state_ns = t_ns
        self._state_part = 0 if self._writer is None else self._writer.parts
        self._put(Item(STATE, t_ns + self._epoch_ns, kept))

    # ------------------------------------------------------------------ inside

    def _take_up_again(self, t_ns: int) -> None:
        """Resume recording after a failure; with `when = "event"`, wait for the next event."""
        writer = self._again.ready(t_ns, self._open)
        if writer is None:
            return
        if self._options.when != "event":
            self._record_into(writer, None)
            return
        writer.close()
        self._closing.append(writer)
        self._attach(None)
        self.state = "waiting"

    def _look_at(self, message: EventMessage, t_ns: int) -> None:
        if self._options.when != "event" or not self.active:
            return
        wanted = any(code in message.code for code in self._options.events)
        if not wanted or message.source == "recording":
            return
        if self.state == "waiting":
            try:
                self.begin()
            except RecordingRefusedError as error:
                self.state = "failed"
                self._detach()
                self._event("recording_failed", str(error))
                return
            self._until_ns = t_ns
        if self._until_ns is not None:
            self._until_ns = t_ns + round(self._options.after_s * SECOND_NS)

    def _open(self) -> LogWriter:
        folder = self._options.directory
        if folder is None:
            raise RecordingRefusedError("recording.directory is not configured")
        run = uuid4().hex
        t_log_ns = self._clock.now_ns() + self._epoch_ns
        vehicle = self._config.vehicle
        about = partial(about_run, self._config, run, self._epoch_ns, list(self._numbers))
        stem = log_stem(vehicle, t_log_ns, run)
        return LogWriter(folder, stem, vehicle, about, self._options, t_log_ns)

    def _path(self) -> Path:
        assert self._writer is not None
        return self._writer.path

    def _attach(self, restored: Mapping[str, Any] | None) -> None:
        self._count = self._sequence = 0
        self._readings.clear()
        for name, inputs in self._inputs.items():
            inputs.on_input = partial(self.record_input, self._numbers[name])
        self._clock.readings.on_reading = self._record_reading
        start = {
            "from_start": restored is not None,
            "system_clock": self._clock.system_state(),
            **(restored or {}),
        }
        t_ns = self._clock.now_ns()
        self._begin(Record(Kind.START, NO_SOURCE, t_ns, json.dumps(start).encode()))

    def _detach(self) -> None:
        for inputs in self._inputs.values():
            inputs.on_input = None
        self._clock.readings.on_reading = None
        self._started = None
        self._ring.clear()
        self._message, self._message_bytes = [], 0

    def record_input(
        self, source: int, kind: str, t_ns: int, payload: bytes | str | CanFrame | None
    ) -> None:
        """Begin the record of a driver's input, before it is handled; bytes that a driver sends
        form a record after it."""
        record = input_record(source, kind, t_ns, payload)
        if record.kind is Kind.SENT:
            self._after.append(record)
            return
        self._count += 1
        self._begin(record)

    def _record_reading(self, clock: ReadClock, t_ns: int, ahead_ns: int) -> None:
        self._readings.append(reading(clock, t_ns, ahead_ns))

    def _begin(self, record: Record) -> None:
        self._complete()
        self._started = record

    def _complete(self) -> None:
        """Write the current record, whose readings are complete."""
        record = self._started
        if record is None:
            self._readings.clear()
            return
        self._started = None
        if self._readings:
            record = record._replace(readings=self._readings)
            self._readings = []
        data = pack(record)
        if self._after:
            data += b"".join(map(pack, self._after))
            self._after = []
        self._message.append(data)
        self._message_bytes += len(data)
        self._message_ns = record.t_ns
        if record.kind is Kind.TICK or self._message_bytes > MESSAGE_BYTES:
            self._flush()

    def _flush(self) -> None:
        if not self._message:
            return
        data = b"".join(self._message)
        self._message, self._message_bytes = [], 0
        self._sequence += 1
        t_log_ns = self._message_ns + self._epoch_ns
        self._put(Item(INPUT, t_log_ns, data, self._sequence))

    def _put(self, item: Item) -> None:
        if self._writer is not None:
            self._writer.put(item)
            return
        self._ring.append(item)
        oldest_ns = item.t_log_ns - round(self._options.before_s * SECOND_NS)
        while self._ring[0].t_log_ns < oldest_ns:
            self._ring.popleft()
