"""Bytes of a receiver's log, unpacked from any compression.

A gzip file, whatever its name, is decompressed as far as possible: a power cut of its writer
truncates the last block. Text redirected by PowerShell (`>`) is UTF-16 with a byte order mark (RFC
2781, 3.2).
"""

from __future__ import annotations

import codecs
import zlib
from pathlib import Path
from typing import NamedTuple

from fusiond.files.csv_tables import Rejection, TableError

_GZIP = b"\x1f\x8b"
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
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
    if found.data.startswith(_UTF_16):
        text = found.data.decode("utf-16", "replace")
        return found._replace(data=text.encode("latin-1", "replace"))
    return found


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
