"""Frames of an MF4 log, read by asammdf in a process of its own.

asammdf trusts the lengths in a file: a wrong one ends the process that reads it, in its compiled
part, or keeps it there for ever. So this module is run for each log, with a limit to its time by
the file's size, and writes to its standard output a record a frame:

    M  t_s  identifier  flags  channel  length code  length  data        a frame
    E  length  text                                                      what the reader has raised
    .                                                                    the end
"""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from drivers.can.python_can_import import can, with_mf4

_FRAME = struct.Struct("<dqBqBB")
_TEXT = struct.Struct("<H")
_FLAGS = (
    "is_extended_id",
    "is_remote_frame",
    "is_error_frame",
    "is_fd",
    "is_rx",
    "bitrate_switch",
    "error_state_indicator",
)
_CHANNEL = 1 << len(_FLAGS)
"""Flag of a frame whose channel is known."""
_LONGEST_TEXT = 2000
_CPU_S, _CPU_S_A_MB = 30, 30
"""Most processor time (s), at all and for each megabyte: the start takes 1.3 s on a desktop, and so
do 100,000 frames, which are a megabyte packed by half; a small computer takes ten times that."""


class Mf4Error(Exception):
    """The log is read as far as this."""


def frames(path: Path) -> Iterator[can.Message]:
    """Frames of the log at `path`. Raises `Mf4Error` where reading ends for damage."""
    command = [sys.executable, "-P", "-m", __name__, str(path)]
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, stdin=nothing, stdout=pipe, stderr=nothing) as reader:
        assert reader.stdout is not None
        try:
            yield from _received(reader.stdout)
        finally:
            reader.kill()


def _received(stream: IO[bytes]) -> Iterator[can.Message]:
    while (kind := stream.read(1)) == b"M":
        if len(head := stream.read(_FRAME.size)) < _FRAME.size:
            break
        stamp, identifier, flags, channel, dlc, length = _FRAME.unpack(head)
        if len(data := stream.read(length)) < length:
            break
        yield can.Message(
            timestamp=stamp,
            arbitration_id=identifier,
            channel=channel if flags & _CHANNEL else None,
            dlc=dlc,
            data=data,
            **{name: bool(flags >> bit & 1) for bit, name in enumerate(_FLAGS)},
        )
    if kind == b"E":
        raise Mf4Error(stream.read(_TEXT.unpack(stream.read(_TEXT.size))[0]).decode())
    if kind != b".":
        raise Mf4Error("asammdf dies of it: a length in the file is wrong")


def write_frames(path: Path, out: IO[bytes]) -> None:
    """Write the records of the log at `path`."""
    with_mf4()
    try:
        for m in can.MF4Reader(path):
            flags = sum(bool(getattr(m, name)) << bit for bit, name in enumerate(_FLAGS))
            known = isinstance(m.channel, int)
            channel = int(m.channel) if isinstance(m.channel, int) else 0
            head = m.arbitration_id, flags | _CHANNEL * known, channel, m.dlc, len(m.data)
            out.write(b"M" + _FRAME.pack(m.timestamp, *head) + bytes(m.data))
    except Exception as error:  # whatever asammdf raises for a file that is none
        text = f"{type(error).__name__}: {error}"[:_LONGEST_TEXT].encode()
        out.write(b"E" + _TEXT.pack(len(text)) + text)
    else:
        out.write(b".")
    out.flush()


def _limit_to(size: int) -> None:
    """Limit this process to the processor time for a file of so many bytes."""
    cpu_s = _CPU_S + _CPU_S_A_MB * size // 1_000_000
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))


if __name__ == "__main__":
    _limit_to(Path(sys.argv[1]).stat().st_size)
    write_frames(Path(sys.argv[1]), sys.stdout.buffer)
