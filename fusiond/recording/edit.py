"""Edits of logs: cut out a part, join parts, recover a damaged log.

The result is an ordinary log with index, metadata and attachments.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from fusiond.clock.host import SECOND_NS
from fusiond.recording.channels import CHANNELS, INPUT, STATE
from fusiond.recording.mcap_writer import About, Attachment, LogFile
from fusiond.recording.reader import About as Described
from fusiond.recording.reader import Log, LogError, LogMessage
from fusiond.recording.records import NO_SOURCE, SLEWED, Kind, Record, pack, unpack

_TYPES = {".json": "application/json"}


@dataclass(frozen=True, slots=True)
class Edited:
    """Result of an edit: the file, its number of messages, and the defects of the source logs."""

    path: Path
    messages: int
    begins: str
    problems: tuple[str, ...]


def merge(paths: Sequence[Path], out: Path) -> Edited:
    """Merge all parts of one recording into one file. Raises `LogError`, OSError."""
    recording = Log(paths)
    written = write_log(out, recording.about, {}, recording.messages())
    return Edited(out, written, "what the recording began with", tuple(recording.problems))


def recover(path: Path, out: Path) -> Edited:
    """Write the readable part of a truncated or damaged log. Raises `LogError`, OSError."""
    return merge([path], out)


def trim(paths: Sequence[Path], from_s: float, to_s: float, out: Path) -> Edited:
    """Write `from_s` to `to_s` (s after the recording's first tick) as a log that can be replayed.

    The part begins with the last stored state before `from_s` (one each 10 s), from which a replay
    continues, or with the recording's begin if `from_s` is before its first state.
    """
    recording = Log(paths)
    first_ns = _first_tick_ns(recording)
    begin_ns, end_ns = (first_ns + round(s * SECOND_NS) for s in (from_s, to_s))
    states = [m.t_log_ns for m in recording.messages(STATE) if m.t_log_ns <= begin_ns]
    if from_s <= 0.0:
        chosen = (m for m in recording.messages() if m.t_log_ns <= end_ns)
        written = write_log(out, recording.about, {}, chosen)
        return Edited(out, written, "what the recording began with", tuple(recording.problems))
    start_ns = states[-1] if states else begin_ns
    head = _head(recording, start_ns)
    chosen = (m for m in recording.messages() if start_ns <= m.t_log_ns <= end_ns)
    cut = {"cut_from_s": f"{(start_ns - first_ns) / SECOND_NS:.3f}"}
    written = write_log(out, recording.about, cut, chain([head], chosen))
    begins = "a state of the log" if states else "no state: a replay aligns first"
    return Edited(out, written, begins, tuple(recording.problems))


def _first_tick_ns(recording: Log) -> int:
    for message in recording.messages(INPUT):
        if any(record.kind is Kind.TICK for record in unpack(message.data)):
            return message.t_log_ns
    raise LogError(f"{recording.paths[0]}: no tick in it")


def _head(recording: Log, t_log_ns: int) -> LogMessage:
    """Metadata of a start in the middle of a drive: the state of the host's clocks."""
    t_ns = t_log_ns - recording.about.epoch_ns
    ahead = [recording.about.epoch_ns, 0, 0]
    unslewed_ns = ahead[0]
    read_ns, sequence = t_ns, 0
    for message in recording.messages(INPUT):
        if message.t_log_ns >= t_log_ns:
            sequence = message.sequence - 1
            break
        for record in unpack(message.data):
            if record.kind is Kind.START:
                start = json.loads(record.payload)["system_clock"]
                slewed_ns = start.get("_slewed_ns", 0)
                ahead = [start["offset_ns"], start["_boot_ns"] + slewed_ns, slewed_ns]
                unslewed_ns = start.get("_unslewed_ns", start["offset_ns"])
            for clock, at_ns, ahead_ns in record.readings:
                ahead[clock] = ahead_ns
                read_ns = at_ns
                if clock == SLEWED:
                    unslewed_ns = ahead[0] - ahead_ns
    clock_state = {
        **dict.fromkeys(("_sampled_ns", "_queued_ns", "_stepped_ns"), read_ns),
        **dict.fromkeys(("offset_ns", "held_ns"), ahead[0]),
        **dict.fromkeys(("slept_ns", "changes", "last_step_ns"), 0),
        "_boot_ns": ahead[1] - ahead[2],
        "_slewed_ns": ahead[2],
        "_unslewed_ns": unslewed_ns,
        "before_step_ns": None,
    }
    payload = json.dumps({"from_start": False, "system_clock": clock_state}).encode()
    record = Record(Kind.START, NO_SOURCE, t_ns, payload)
    return LogMessage(INPUT, t_log_ns, pack(record), max(0, sequence))


def write_log(
    out: Path, about: Described, more: dict[str, str], messages: Iterable[LogMessage]
) -> int:
    """Write messages as a new log with `more` in its metadata and return their number."""
    attachments = tuple(
        Attachment(name, _TYPES.get(Path(name).suffix, "text/plain"), data)
        for name, data in about.attachments.items()
    )
    file: LogFile | None = None
    for message in messages:
        channel = CHANNELS.get(message.topic)
        if channel is None:  # of another program
            continue
        if file is None:
            described = About({**about.metadata, **more}, attachments)
            file = LogFile(out, described, message.t_log_ns)
        file.write(channel, message.t_log_ns, message.data, message.sequence)
    if file is None:
        raise LogError("there is nothing in that part of the log")
    file.finish()
    return file.messages
