"""What is fuzzed besides streams: commands, files of state, tables.

Each is read, or refused by the one exception that says why. The first byte of an input chooses
which of several readers has it.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from fusiond.files import tables
from fusiond.files.csv_tables import TableError
from fusiond.live.warm_keeper import KEPT_STATE
from fusiond.navigator.saved_calibration import SavedCalibration
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.state_file import DamagedStateError, read_state, write_state
from fusiond.outputs.commands import COMMANDS, BadCommandError, parse

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
    tables.read_imu,
    tables.read_gnss,
    tables.read_rdss,
    tables.read_attitude,
    tables.read_bearing,
    tables.read_wheel,
    tables.read_truth,
    tables.read_barometer,
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
