"""What is fuzzed besides streams: commands, messages to the dashboard, files of state, logs, CSV.

Each is read, or refused by the one exception that says why. The first byte of an input chooses
which of several readers has it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from fusiond.dashboard.message_parser import topic_parsers
from fusiond.dashboard.vehicles import REFUSALS, Hub
from fusiond.files import measurement_csv
from fusiond.files.csv_tables import TableError
from fusiond.live.state_in_memory import KEPT_STATE
from fusiond.navigator.saved_calibration import SavedCalibration
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.state_file import DamagedStateError, read_state, write_state
from fusiond.outputs.commands import COMMANDS, BadCommandError, parse
from fusiond.recording.channels import CHANNELS
from fusiond.recording.info import info
from fusiond.recording.mcap_writer import About, LogFile
from fusiond.recording.reader import MOST_PROBLEMS, Log, LogError
from fusiond.recording.records import NO_SOURCE, Kind, Record, pack
from fusiond.recording.records import input_of as kind_of_input
from tools.topic_schemas import SHOWN

_MEMORY = Path("/dev/shm")
_SCRATCH = tempfile.TemporaryDirectory(prefix="fuzz-", dir=_MEMORY if _MEMORY.is_dir() else None)
INPUT_FILE = Path(_SCRATCH.name, "fuzzed")


def input_of(data: bytes) -> tuple[int, bytes]:
    """The choice and what is read."""
    return (data[0], data[1:]) if data else (0, b"")


_COMMANDS = sorted(COMMANDS)


def commands(data: bytes) -> None:
    """A command's payload is one, or BadCommandError says why not."""
    choice, payload = input_of(data)
    try:
        command = parse(_COMMANDS[choice % len(_COMMANDS)], payload)
    except BadCommandError as bad:
        request_id = bad.id
    else:
        request_id = command.id
        numbers = [value for value in command.model_dump().values() if isinstance(value, float)]
        assert all(map(math.isfinite, numbers))
    assert request_id is None or len(request_id) <= 64


_TOPICS = ("online", *SHOWN)
_VIEWED = ("received", "other_topic", *REFUSALS)


def hub(data: bytes) -> None:
    """Messages to the dashboard, a line each: every one is counted by one name, and what browsers
    are sent is JSON without NaN, of the published schemas. Of the choice four bits are the topic of
    the first, and the high one says that the broker had kept them."""
    choice, text = input_of(data)
    payloads = text.split(b"\n")[:8]
    now_s = 100.0
    taking = Hub(lambda: now_s, "fuzz")
    for place, payload in enumerate(payloads):
        now_s += 0.4
        topic = _TOPICS[((choice & 0xF) + place) % len(_TOPICS)]
        taking.receive(f"v{choice >> 4 & 1 & place}", topic, payload, kept=bool(choice & 0x80))
    assert sum(taking.counters[name] for name in _VIEWED) == len(payloads)
    assert taking.counters.total() == len(payloads)
    frame: dict[str, Any] = {"refused": taking.refused}
    for vehicle in taking.vehicles.values():
        frame[vehicle.name] = new = vehicle.since(0)
        for topic, latest in new["messages"].items():
            if topic in SHOWN:
                assert topic_parsers()[topic](latest["said"]) == latest["said"]
    json.dumps(frame, allow_nan=False)


def _head(more: bytes) -> bytes:
    """A log's beginning that describes it, then records of MCAP."""
    path = INPUT_FILE.with_suffix(".mcap")
    path.unlink(missing_ok=True)
    about = {"format": "1", "run": "r", "part": "0", "vehicle": "v", "epoch_ns": "1000"}
    file = LogFile(path, About({**about, "sources": '["a", "b"]'}), 1)
    file.write(CHANNELS["/fusiond/input"], 1, more)
    file.write(CHANNELS["/event"], 1, b"{}")
    file.sync()
    file.abandon()
    return path.read_bytes()


_HEAD = _head(pack(Record(Kind.TICK, NO_SOURCE, 5, bytes(32))))


def log(data: bytes) -> None:
    """A file that may be a log is read, told of and cut, or LogError says why not. Of the choice:
    as it is, behind a sound head, or as the input of a log that is sound otherwise."""
    choice, stream = input_of(data)
    path = INPUT_FILE.with_suffix(".mcap")
    match choice % 3:
        case 0:
            path.write_bytes(stream)
        case 1:
            path.write_bytes(_HEAD + stream)
        case _:
            _head(stream)
    try:
        found = Log([path])
        told = info(found)
        for record in found.records():
            if record.kind not in (Kind.START, Kind.TICK, Kind.COMMAND):
                kind_of_input(record)
    except LogError:
        return
    json.dumps(told)
    assert len(told["problems"]) <= MOST_PROBLEMS
    for message in found.messages("/event"):
        with contextlib.suppress(ValueError):
            message.json()


STATES: tuple[TypeAdapter[Any], ...] = (
    TypeAdapter(SavedState),
    TypeAdapter(SavedCalibration),
    KEPT_STATE,
)


def _numbers(value: Any) -> Iterator[float]:
    """Those in what a state is dumped to, however deep."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list | tuple):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _numbers(one)


def state(data: bytes) -> None:
    """A file of state is one of finite numbers and is read again as it was written, or
    DamagedStateError says why not. The high bit: with a good check in front."""
    choice, text = input_of(data)
    kind = STATES[choice % len(STATES)]
    if choice & 0x80 and text:
        write_state(INPUT_FILE, text, durable=False)
    else:
        INPUT_FILE.write_bytes(text)
    try:
        found = read_state(INPUT_FILE, kind)
    except DamagedStateError:
        return
    assert all(map(math.isfinite, _numbers(kind.dump_python(found))))
    write_state(INPUT_FILE, kind.dump_json(found), durable=False)
    assert read_state(INPUT_FILE, kind) == found


TABLES: tuple[Callable[[Path], Any], ...] = (
    measurement_csv.read_imu,
    measurement_csv.read_gnss,
    measurement_csv.read_rdss,
    measurement_csv.read_attitude,
    measurement_csv.read_bearing,
    measurement_csv.read_wheel,
    measurement_csv.read_truth,
    measurement_csv.read_barometer,
)


def csv(data: bytes) -> None:
    """A table is read with what is wrong named by line, or TableError says why not."""
    choice, text = input_of(data)
    INPUT_FILE.write_bytes(text)
    try:
        table = TABLES[choice % len(TABLES)](INPUT_FILE)
    except TableError:
        return
    t_s = table.t_s.tolist()
    assert all(map(math.isfinite, t_s))
    assert all(a < b for a, b in itertools.pairwise(t_s))
    assert all(rejection.line >= 2 and rejection.reason for rejection in table.rejected)
