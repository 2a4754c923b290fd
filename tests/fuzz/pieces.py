"""Streams for the targets: split as an input's first byte says, and mended where it says so."""

from __future__ import annotations

import itertools
from datetime import date
from typing import TypeVar

from drivers.nmea.incremental_checksum import crc24q
from drivers.rdss.framing import checksum
from tests.drivers.raw.frames import ubx

EARLIEST = date(2014, 1, 1)


_EVERYWHERE = 15
_PIECES = 8


def pieces_of(choice: int, stream: bytes) -> list[bytes]:
    """Of a size by the low bits of `choice`, everywhere or where its high ones say: a few pieces
    between two long ones find what many do, at each place in turn, for a tenth of the work."""
    size, place = (1, 2, 3, 7, 16, 61, 255, 5000)[choice & 7], choice >> 4
    begin, end = 0, len(stream)
    if place < _EVERYWHERE:
        begin = end * place // _EVERYWHERE
        end = min(end, begin + _PIECES * size)
    cuts = (0, *range(begin, end, size), end, len(stream))
    return [stream[a:b] for a, b in itertools.pairwise(cuts) if a < b]


Reader = TypeVar("Reader")
UNTRACED: dict[type, type] = {}
"""Of a fuzzed reader, the same without the fuzzer's probes. A stream is read twice, to see that its
split does not matter: where the pieces have shown which branches there are, the whole need not."""


def untraced(reader: type[Reader]) -> type[Reader]:
    """The reader itself where nothing is traced."""
    return UNTRACED.get(reader, reader)


def whole_and_cut(
    reader: type[Reader], choice: int, stream: bytes
) -> tuple[tuple[type[Reader], list[bytes]], ...]:
    return (untraced(reader), [stream]), (reader, pieces_of(choice, stream))


def mended_lines(stream: bytes) -> bytes:
    """Lines as sentences and what starts as a frame as one, with good checks."""
    mended = []
    for line in stream.split(b"\n"):
        body, star, _ = line[1:].partition(b"*")
        if line[:1] == b"$" and star:
            mended.append(b"$%b*%02X\r\n" % (body, checksum(body)))
        elif line[:2] == b"\xb5\x62" and len(line) > 6:
            mended.append(ubx(line[2:4], line[6:]))
        elif line[:1] == b"\xd3" and len(line) > 4:
            frame = b"\xd3" + (len(line[3:]) & 0x3FF).to_bytes(2, "big") + line[3:1026]
            mended.append(frame + crc24q(frame).to_bytes(3, "big"))
        else:
            mended.append(line + b"\n")
    return b"".join(mended)
