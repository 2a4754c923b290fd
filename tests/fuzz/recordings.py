"""What is fuzzed of recordings: logs of a CAN bus, and the DBC files that say what is in them."""

from __future__ import annotations

import itertools
import struct
import zlib

from drivers.can.dbc_salvage import UnreadableError, sound_part
from fusiond.clock.recorder_clock import FOLLOWING, RecorderClock
from fusiond.files.csv_tables import TableError
from fusiond.offline.can_log_reader import Refusals, messages
from tests.fuzz.documents import INPUT_FILE, input_of

SUFFIXES = (".log", ".asc", ".trc", ".blf")
COUNTED = ("unreadable", "cut", "length_or_type_odd")
_HEADER = struct.pack("<4sL136x", b"LOGG", 144)


def _container(content: bytes, packed: bool) -> bytes:
    """A container of a BLF file with this in it."""
    held = zlib.compress(content, 1) if packed else content
    size = 32 + len(held)
    head = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, size, 10, 2 * packed, len(content))
    return head + held + bytes(size % 4)


def can_log(data: bytes) -> None:
    """A log is read with what is lost named, or TableError says why not; its stamps make monotonic
    time. The high bits: what is read stands in containers of a BLF file, or twice in it."""
    choice, content = input_of(data)
    path = INPUT_FILE.with_suffix(SUFFIXES[choice & 3])
    if path.suffix == ".blf" and choice & 0x80:
        content = _HEADER + _container(content, bool(choice & 0x40)) * (1 + (choice >> 4 & 1))
    path.write_bytes(content)
    refusals = Refusals()
    try:
        found = list(messages(path, refusals))
    except TableError:
        return
    assert all(each.reason in COUNTED and each.detail for each in refusals.all())
    stamps = [round(m.timestamp * 1e9) for m in found if abs(m.timestamp) < 9e9]
    clock, times = RecorderClock(), []
    for k, stamp in enumerate(stamps):
        if not clock.is_odd(stamp, (k % 2, 0)):
            clock.next(stamp, (k % 2, 0))
        elif (
            clock.take(stamp, (k % 2, 0), stamps[k + 1 : k + 1 + FOLLOWING], lambda: None)
            != "taken"
        ):
            continue
        times.append(clock.t_ns)
    assert all(before <= after for before, after in itertools.pairwise(times))


def dbc(data: bytes) -> None:
    """Of a DBC file the messages that can be read, the others by name; or the reason."""
    _, content = input_of(data)
    text = content.decode("cp1252", "replace")
    try:
        found = sound_part(text)
    except UnreadableError:
        return
    assert found.messages
    assert all(found.left_out.values())
