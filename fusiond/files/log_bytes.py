"""Bytes of a receiver's log, unpacked from any compression.

A gzip file, whatever its name, is decompressed as far as possible: a power cut of its writer
truncates the last block. Text redirected by PowerShell is UTF-16, with a byte order mark (`>`; RFC
2781, 3.2) or, appended to a file (`>>`) or cut out of one, without.
"""

from __future__ import annotations

import codecs
import zlib
from pathlib import Path
from typing import NamedTuple

from fusiond.files.csv_tables import Rejection, TableError

_GZIP = b"\x1f\x8b"
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_FIRST = 64
"""Bytes by which UTF-16 without a mark is known: of each pair one is 0 and the other printable."""
_ANY_HEADER = 16 + zlib.MAX_WBITS
"""Window size for `zlib.decompressobj` with a gzip header."""


class LogBytes(NamedTuple):
    """Bytes of a log; `cut` describes a truncation, "" without one."""

    data: bytes
    cut: str = ""

    @property
    def notes(self) -> list[Rejection]:
        """Notes for a report."""
        return [Rejection(0, "file_cut", f"{self.cut}: read is what comes before", 0)] * bool(
            self.cut
        )


def log_bytes(path: Path) -> LogBytes:
    """Read the bytes of the file at `path`. Raises `OSError`, or `TableError` if nothing can be
    decompressed."""
    data = path.read_bytes()
    found = _unpacked(data) if data.startswith(_GZIP) else LogBytes(data)
    if found.cut and not found.data:
        raise TableError(f"{path}: no gzip file that can be unpacked ({found.cut})")
    if coding := utf_16(found.data):
        text = found.data.decode(coding, "replace")
        return found._replace(data=text.encode("latin-1", "replace"))
    return found


def utf_16(data: bytes) -> str:
    """Coding of text in UTF-16; "" for any other bytes."""
    if data.startswith(_UTF_16):
        return "utf-16"
    head = data[:_FIRST]
    for coding, text, zeros in (
        ("utf-16-le", head[::2], head[1::2]),
        ("utf-16-be", head[1::2], head[::2]),
    ):
        printable = all(32 <= byte < 127 or byte in b"\t\r\n" for byte in text)
        if len(head) == _FIRST and printable and not any(zeros):
            return coding
    return ""


def _unpacked(data: bytes) -> LogBytes:
    """Decompress all members in sequence; zeros after the last are padding."""
    parts: list[bytes] = []
    while data.startswith(_GZIP):
        member = zlib.decompressobj(_ANY_HEADER)
        try:
            parts.append(member.decompress(data))
        except zlib.error as error:
            return LogBytes(b"".join(parts), f"the gzip file is damaged ({error})")
        if not member.eof:
            return LogBytes(b"".join(parts), "the gzip file ends before its end")
        data = member.unused_data.lstrip(b"\0")
    cut = "something follows the gzip file that is none" if data else ""
    return LogBytes(b"".join(parts), cut)
