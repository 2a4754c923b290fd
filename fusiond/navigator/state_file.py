"""Small state files: written atomically, validated before use.

A start must survive anything at the path: no file, half a file, a directory, a pipe, impossible
numbers. So the size is checked before reading, the parser bounds depth and numbers, and a model of
the state checks ranges. A file that fails is set aside: a person can examine it, and the next start
does not read it again.

A bit lost on disk may change a digit into another one, a wrong but possible heading. So the first
member, `crc32`, is the CRC-32 (IEEE 802.3, hexadecimal) of the text without it. Older files have
none.
"""

from __future__ import annotations

import contextlib
import os
import stat
import zlib
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

State = TypeVar("State")

# The longest state, a covariance of the widest model (32 states, 528 numbers of 25 characters),
# has 15 kB; what is larger is none of ours.
MOST_BYTES = 65_536
CHECK = b'{"crc32":"%08x",'
CHECK_BEGINS, CHECK_SIZE = b'{"crc32":', len(CHECK % 0)


class DamagedStateError(Exception):
    """File at the path is not a state; the text gives the reason."""


class RefusedStateError(Exception):
    """Valid state that cannot be used now; the text gives the reason."""


def read_state(path: Path, kind: TypeAdapter[State]) -> State | None:
    """State at `path`, None without a file. Raises `DamagedStateError` for invalid contents."""
    try:
        # A pipe without a writer would hold up the start.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            about = os.fstat(descriptor)
            if not stat.S_ISREG(about.st_mode):
                raise DamagedStateError("not a regular file")
            if about.st_size > MOST_BYTES:
                raise DamagedStateError(f"{about.st_size} bytes, at most {MOST_BYTES} are read")
            text = os.read(descriptor, MOST_BYTES)
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DamagedStateError(error.strerror or str(error)) from error
    try:
        return kind.validate_json(_checked(text))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "file"
        raise DamagedStateError(f"{where}: {first['msg']}") from error


def _checked(text: bytes) -> bytes:
    """Text without its verified checksum. Raises `DamagedStateError`."""
    if not text.startswith(CHECK_BEGINS):
        return text
    state = b"{" + text[CHECK_SIZE:]
    if text[:CHECK_SIZE] != CHECK % zlib.crc32(state):
        raise DamagedStateError("what it holds is not what was written: CRC-32 differs")
    return state


def write_state(path: Path, text: bytes, durable: bool) -> None:
    """Write `text`, a JSON object, with its checksum.

    Atomic: if the process dies, the old or the new file exists. OSError passes.

    `durable`: also after a power cut; it costs the disk two flushes.
    """
    temporary = path.with_name(path.name + ".new")
    with contextlib.suppress(FileNotFoundError):
        try:
            temporary.unlink()  # a link itself, never what it names
        except IsADirectoryError:
            temporary.rmdir()
    with temporary.open("xb") as file:
        file.write(CHECK % zlib.crc32(text) + text[1:])
        if durable:
            file.flush()
            os.fsync(file.fileno())
    temporary.replace(path)
    if durable:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def set_aside(path: Path) -> str:
    """Rename an unusable file so that the next start ignores it; a description.

    It replaces a file that was set aside before.
    """
    aside = path.with_name(path.name + ".bad")
    if path.is_dir():
        # It is not renamed over a file, and while it stays no state can be written here.
        with contextlib.suppress(OSError):
            aside.unlink()
    try:
        path.rename(aside)
    except OSError as error:
        return f"it stays: {error.strerror}"
    return f"kept as {aside}"
