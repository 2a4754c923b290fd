"""Splitter of a byte stream into blocks of the Septentrio Binary Format: no I/O.

    $ @ crc16 id16 length16 body     CRC-16-CCITT (1021 hex, from 0) from id to the end
    id       bits 0 to 12 the block's number, 13 to 15 its revision
    length   of the whole block, a multiple of 4

NMEA and everything else on the line is skipped. After a false header or a block that does not
verify, only its two sync bytes are skipped. Source: Septentrio AsteRx SB3 Reference Guide, section
4.1.
"""

from __future__ import annotations

import binascii
from typing import NamedTuple

from drivers.framing_base import Splitter

MAX_BLOCK = 8192
"""MeasEpoch of 80 channels takes 5 kB; a longer length is a false header."""
SYNC = b"$@"
_HEADER = 8


class Block(NamedTuple):
    """Verified block: number, revision, and contents behind the header."""

    number: int
    revision: int
    body: bytes


class BlockSplitter(Splitter[Block]):
    """Splitter of bytes, in pieces of any size, into verified blocks.

    Counts `sbf_blocks`; refused `sbf_damaged`, `sbf_cut` (the stream ended inside it); and
    `other_bytes`, all that belonged to no good block.
    """

    def _scan(self, found: list[Block], *, final: bool) -> None:
        buffer, at = self._buffer, 0
        while True:
            start = buffer.find(SYNC, at)
            if start < 0:
                # The last byte may be the first of a sync.
                end = len(buffer) - (not final and buffer[-1:] == SYNC[:1])
                self.counters["other_bytes"] += max(0, end - at)
                at = max(at, end)
                break
            self.counters["other_bytes"] += start - at
            at = start
            length = _length(buffer, at)
            if length is None or (length and len(buffer) < at + length):
                if not final:
                    break
                self.counters["sbf_cut"] += 1
                length = 0
            elif length and not _verifies(buffer, at, at + length):
                self.counters["sbf_damaged"] += 1
                length = 0
            if not length:
                self.counters["other_bytes"] += len(SYNC)
                at += len(SYNC)
                continue
            identity = int.from_bytes(buffer[at + 4 : at + 6], "little")
            body = bytes(buffer[at + _HEADER : at + length])
            self.counters["sbf_blocks"] += 1
            found.append(Block(identity & 0x1FFF, identity >> 13, body))
            at += length
        del buffer[:at]


def _length(buffer: bytearray, at: int) -> int | None:
    """Length of the block at `at`; 0 for none, None if incomplete."""
    if len(buffer) < at + _HEADER:
        return None
    length = int.from_bytes(buffer[at + 6 : at + 8], "little")
    return length if _HEADER + 6 <= length <= MAX_BLOCK and length % 4 == 0 else 0


def _verifies(buffer: bytearray, at: int, end: int) -> bool:
    stated = int.from_bytes(buffer[at + 2 : at + 4], "little")
    return binascii.crc_hqx(memoryview(buffer)[at + 4 : end].tobytes(), 0) == stated
