"""Contents of a log: `fusiond log info`."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS
from fusiond.outputs.messages.base import stamp
from fusiond.recording.channels import INPUT
from fusiond.recording.reader import Log
from fusiond.recording.records import NO_SOURCE, REALTIME, SLEWED, Kind, Record, tick_of

_STEP_NS = MILLISECOND_NS
"""Least jump of the system clock against the monotonic one. What stays below it between two
readings of a running daemon is a quartz that is disciplined (500 ppm at most)."""


def info(recording: Log) -> dict[str, Any]:
    """Summary of a log: versions, time, channels, inputs by source, damage.

    `gaps` are pauses between ticks of more than a second; `clock_steps` of the system clock.
    """
    channels = Counter(message.topic for message in recording.messages() if message.topic != INPUT)
    inputs = _Inputs(recording)
    for record in recording.records():
        inputs.add(record)
    about = recording.about
    bytes_in_all = sum(path.stat().st_size for path in recording.paths)
    hours = inputs.duration_s / 3600.0
    return {
        "files": [str(path) for path in recording.paths],
        "bytes": bytes_in_all,
        "mb_per_hour": round(bytes_in_all * 1e-6 / hours, 1) if hours else None,
        **about.metadata,
        "sources": inputs.sources(),
        "from_the_daemons_start": inputs.from_start,
        "begin_utc": inputs.utc(inputs.first_ns),
        "end_utc": inputs.utc(inputs.last_ns),
        "duration_s": round(inputs.duration_s, 3),
        "ticks": inputs.ticks,
        "overruns": inputs.overruns,
        "commands": inputs.commands,
        "clock_steps": inputs.steps,
        "gaps": inputs.gaps,
        "channels": dict(channels),
        "problems": recording.problems,
    }


class _Inputs:
    def __init__(self, recording: Log) -> None:
        self._about = recording.about
        self._counts = [[0] * len(Kind) for _ in self._about.sources]
        self._bytes = [0] * len(self._counts)
        self._ahead_ns: int | None = None
        self._unslewed_ns: int | None = None
        """System clock minus CLOCK_MONOTONIC at the last reading; both are slewed alike."""
        self._tick_ns: int | None = None
        self.from_start = False
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.ticks = self.overruns = 0
        self.commands: list[dict[str, Any]] = []
        self.steps: list[dict[str, Any]] = []
        self.gaps: list[dict[str, Any]] = []

    def add(self, record: Record) -> None:
        self.first_ns = record.t_ns if self.first_ns is None else self.first_ns
        self.last_ns = record.t_ns
        for clock, t_ns, ahead_ns in record.readings:
            if clock == REALTIME:
                self._look(t_ns, ahead_ns)
            elif clock == SLEWED and self._ahead_ns is not None:
                self._look_at_slews(self._ahead_ns - ahead_ns)
        kind, source = record.kind, record.source
        if source != NO_SOURCE:
            self._counts[source][kind] += 1
            self._bytes[source] += len(record.payload)
            return
        match kind:
            case Kind.START:
                start = json.loads(record.payload)
                self.from_start = bool(start.get("from_start"))
                self._unslewed_ns = start.get("system_clock", {}).get("_unslewed_ns")
            case Kind.TICK:
                self._tick(record)
            case Kind.COMMAND:
                self.commands.append({"t_utc": self.utc(record.t_ns), **json.loads(record.payload)})

    def _look(self, t_ns: int, ahead_ns: int) -> None:
        before, self._ahead_ns = self._ahead_ns, ahead_ns
        if before is not None and abs(ahead_ns - before) > _STEP_NS:
            step_s = (ahead_ns - before) / SECOND_NS
            self.steps.append({"t_utc": self.utc(t_ns), "step_s": round(step_s, 6)})

    def _look_at_slews(self, unslewed_ns: int) -> None:
        """Tell a step from a slew by the reading of CLOCK_MONOTONIC after a jump."""
        before, self._unslewed_ns = self._unslewed_ns, unslewed_ns
        if before is None or not self.steps:
            return
        if abs(unslewed_ns - before) <= _STEP_NS:
            self.steps.pop()
        else:
            self.steps[-1]["step_s"] = round((unslewed_ns - before) / SECOND_NS, 6)

    def _tick(self, record: Record) -> None:
        tick = tick_of(record)
        before, self._tick_ns = self._tick_ns, record.t_ns
        if before is not None and record.t_ns - before > SECOND_NS:
            length_s = (record.t_ns - before) / SECOND_NS
            self.gaps.append({"t_utc": self.utc(before), "length_s": round(length_s, 3)})
        self.ticks += 1
        self.overruns = tick.overruns

    @property
    def duration_s(self) -> float:
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) / SECOND_NS

    def sources(self) -> dict[str, Any]:
        rows = zip(self._about.sources, self._counts, self._bytes, strict=True)
        return {
            name: {**{Kind(k).name.lower(): n for k, n in enumerate(counts) if n}, "bytes": size}
            for name, counts, size in rows
        }

    def utc(self, t_ns: int | None) -> str | None:
        return None if t_ns is None else stamp(t_ns + self._about.epoch_ns)[0]
