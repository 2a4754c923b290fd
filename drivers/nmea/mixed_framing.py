"""Splitter of NMEA 0183 sentences, UBX and RTCM 3 frames in one byte stream: no I/O.

    sentence    $ address , fields * hh          hh = XOR of what stands between $ and *
    UBX         B5 62 class id length16 payload ck_a ck_b     8-bit Fletcher from class on
    RTCM 3      D3 000000 length10 payload crc24q             from D3 on

A binary frame is taken as a whole, so that a `$` inside it starts no sentence. If its check fails,
or a whole sentence inside it verifies, it was no frame, and scanning continues one byte after its
first. Each byte is summed once, whatever false headers claim (drivers.nmea.incremental_checksum).
Sources: NMEA 0183 4.11 section 5.3; u-blox ZED-F9P interface description section 3; RTCM 10403.3
section 4.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Literal

from drivers.framing_base import Splitter
from drivers.nmea.incremental_checksum import RunningCrc24q, RunningFletcher

MAX_SENTENCE = 256
"""Bytes from `$` to the checksum. The standard says 82, receivers exceed it; a longer run of text
is lines merged by an overrun."""
MAX_UBX_PAYLOAD = 8192
"""A RXM-RAWX of 255 measurements takes 8176; a longer length is a false header."""
MOST_UNREAD = 4096
"""Most unrecognised bytes kept for identification: two seconds at 19,200 baud."""

# Little-endian, up to the greatest, whose low byte is zero.
_UBX_LENGTH = rb"(?:.[\x00-\x%02x]|\x00\x%02x)" % (
    (MAX_UBX_PAYLOAD >> 8) - 1,
    MAX_UBX_PAYLOAD >> 8,
)
# Message numbers, the 12 bits behind the length: RTCM 10403.3 assigns 1001 to 1300 and 4001 on.
_RTCM_NUMBER = rb"(?:\x3e[\x90-\xff]|[\x3f-\x50].|\x51[\x00-\x4f]|\xfa[\x10-\xff]|[\xfb-\xff].)"
_START = re.compile(
    rb"\$+"
    rb"|\xb5(?:\Z|\x62(?:.{0,3}\Z|.." + _UBX_LENGTH + rb"))"
    rb"|\xd3(?:\Z|[\x00-\x03](?:.{0,2}\Z|." + _RTCM_NUMBER + rb"))",
    re.DOTALL,
)
"""Prefixes of a sentence or frame, possibly incomplete. All other bytes are skipped here, a stream
of 0xD3 twelve times as fast as byte by byte."""
_NOT_BODY = re.compile(rb"[^\x20-\x23\x25-\x29\x2b-\x7e]")  # anything but text, and $ and *
_WHOLE = re.compile(rb"\$([\x20-\x23\x25-\x29\x2b-\x7e]{1,252})\*([0-9A-Fa-f]{2})")
_ADDRESS = re.compile(r"[A-Z][A-Z0-9]{2,9}\Z")

# Sentences of an RDSS terminal of the text family 2.1 (and its BDS-3 successor), talker BD.
_RDSS = frozenset(
    {"BSI", "BSS", "DWR", "FKI", "GXM", "HZR", "ICI", "ICP", "ICZ", "KLS", "KLT"}
    | {"LZM", "PWI", "SBX", "SNR", "TCI", "TXR", "WAA", "WBA", "ZTI"}
)
_RDSS_ZDA_FIELDS = 11
_LINE_ENDS = b"\r\n"


@dataclass(frozen=True, slots=True)
class Sentence:
    """Verified sentence: `address` such as GNGGA, fields between commas, `raw` from `$` to `hh`."""

    address: str
    fields: tuple[str, ...]
    raw: bytes

    @property
    def talker(self) -> str:
        """Two letters, or `P` for a proprietary sentence."""
        return "P" if self.address.startswith("P") else self.address[:2]

    @property
    def formatter(self) -> str:
        return self.address[len(self.talker) :]


def is_rdss_sentence(sentence: Sentence) -> bool:
    """True for a sentence of a BeiDou RDSS terminal, false for a GNSS receiver's.

    Both have BDZDA. The RDSS form has 11 fields, the first a mode of one digit; the NMEA form has
    6, the first a time of at least six digits.
    """
    if sentence.talker == "CC":
        return True
    if sentence.talker != "BD":
        return False
    if sentence.formatter == "ZDA":
        fields = sentence.fields
        return len(fields) == _RDSS_ZDA_FIELDS or (bool(fields) and len(fields[0]) == 1)
    return sentence.formatter in _RDSS


@dataclass(frozen=True, slots=True)
class Frame:
    """Verified binary frame, `raw` from its first sync byte to its last check byte."""

    kind: Literal["ubx", "rtcm"]
    raw: bytes


Item = Sentence | Frame


class StreamSplitter(Splitter[Item]):
    """Splitter of bytes, in pieces of any size, into verified sentences and binary frames.

    Counts in `counters`: `sentences`, `ubx_frames`, `rtcm_frames`; refused `checksum_bad`,
    `checksum_missing`, `sentence_too_long`, `inner_dollar`, `not_text`, `address_bad`,
    `ubx_damaged`, `rtcm_damaged`, `frame_cut` (the stream ended inside it); and `garbage_bytes`,
    all that belonged to nothing.
    """

    def __init__(self, counters: Counter[str] | None = None) -> None:
        super().__init__(counters)
        self._unread = bytearray()
        self._whole = _WholeSentences()
        self._fletcher = RunningFletcher()
        self._crc = RunningCrc24q()

    @property
    def unread(self) -> bytes:
        """Last unrecognised bytes, line ends included."""
        return bytes(self._unread[-MOST_UNREAD:])

    @property
    def summed(self) -> int:
        """Number of bytes that both checks of binary frames have processed."""
        return self._fletcher.taken + self._crc.taken

    def _scan(self, items: list[Item], *, final: bool) -> None:
        buffer, at = self._buffer, 0
        while True:
            start = _START.search(buffer, at)
            if start is None:
                self._garbage(buffer[at:])
                at = len(buffer)
                break
            if start.start() > at:
                self._garbage(buffer[at : start.start()])
                at = start.start()
            before = len(items)
            if buffer[at] == 0x24:
                if start.end() - at > 1:  # the last byte may begin a sentence
                    at += self._inner_dollars(start.end() - at - 1)
                used = self._sentence(at, items)
            elif buffer[at] == 0xB5:
                used = self._binary(at, _ubx_length(buffer, at), "ubx", items)
            else:
                used = self._binary(at, _rtcm_length(buffer, at), "rtcm", items)
            if used is None:
                if not final:
                    break
                used = 1
                self.counters["garbage_bytes"] += 1
                if buffer[at] != 0x24:
                    self.counters["frame_cut"] += 1
            if len(items) == before:
                self._keep(buffer[at : at + used])
            at += used
        if at:
            del buffer[:at]
            self._whole.drop(at)
            if self.summed:
                self._fletcher.drop(at)
                self._crc.drop(at)

    def _keep(self, nothing: bytearray) -> None:
        self._unread += nothing
        if len(self._unread) > 2 * MOST_UNREAD:
            del self._unread[:-MOST_UNREAD]

    def _garbage(self, skipped: bytearray) -> None:
        self._keep(skipped)
        self.counters["garbage_bytes"] += len(skipped) - skipped.count(0x0D) - skipped.count(0x0A)

    def _refuse(self, why: str, length: int) -> int:
        self.counters[why] += 1
        self.counters["garbage_bytes"] += length
        return length

    def _inner_dollars(self, count: int) -> int:
        self.counters["inner_dollar"] += count
        self.counters["garbage_bytes"] += count
        return count

    def _sentence(self, at: int, items: list[Item]) -> int | None:
        """Length of the sentence that starts at `at`, good or not; None if it is incomplete."""
        buffer = self._buffer
        stop = _NOT_BODY.search(buffer, at + 1, at + MAX_SENTENCE - 2)
        if stop is None:
            if len(buffer) - at < MAX_SENTENCE - 2:
                return None
            return self._refuse("sentence_too_long", MAX_SENTENCE - 2)
        end = stop.start()
        byte = buffer[end]
        if byte == 0x2A:
            if len(buffer) < end + 3:
                return None
            return self._verify(at, end, items)
        why = {0x24: "inner_dollar", 0x0D: "checksum_missing", 0x0A: "checksum_missing"}
        return self._refuse(why.get(byte, "not_text"), end - at)

    def _verify(self, at: int, star: int, items: list[Item]) -> int:
        raw = bytes(self._buffer[at : star + 3])
        if not _verifies(raw):
            # The two bytes behind the star may begin something else.
            why = "checksum_missing" if raw[-2] in b"\r\n" else "checksum_bad"
            return self._refuse(why, star + 1 - at)
        if raw[-1:] in _LINE_ENDS:
            raw = raw[:-1]
        address, *fields = raw[1 : star - at].decode("ascii").split(",")
        if not _ADDRESS.match(address):
            return self._refuse("address_bad", len(raw))
        self.counters["sentences"] += 1
        items.append(Sentence(address, tuple(fields), raw))
        return len(raw)

    def _binary(
        self, at: int, length: int | None, kind: Literal["ubx", "rtcm"], items: list[Item]
    ) -> int | None:
        """Handle a frame of `length` (None: unknown yet), as `_sentence`."""
        if length is None:
            return None
        buffer = self._buffer
        end = at + length
        if self._whole.inside(buffer, at, end):
            return self._refuse(f"{kind}_damaged", 1)
        if len(buffer) < end:
            return None
        good = (
            self._fletcher.holds(buffer, at + 2, end)
            if kind == "ubx"
            else self._crc.holds(buffer, at, end)
        )
        if not good:
            return self._refuse(f"{kind}_damaged", 1)
        frame = bytes(buffer[at:end])
        self.counters[f"{kind}_frames"] += 1
        items.append(Frame(kind, frame))
        return length


class _WholeSentences:
    """Positions of verified sentences in a growing buffer; what was searched is not searched
    again."""

    def __init__(self) -> None:
        self._found: deque[tuple[int, int]] = deque()
        self._searched = 0

    def inside(self, buffer: bytearray, start: int, end: int) -> bool:
        """True if start..end contains a verified sentence, as far as received."""
        self._search(buffer)
        found = self._found
        while found and found[0][0] < start:
            found.popleft()
        return bool(found) and found[0][1] <= end

    def _search(self, buffer: bytearray) -> None:
        if self._searched == len(buffer):
            return
        after = self._searched
        for match in _WHOLE.finditer(buffer, after):
            after = match.end()
            if _verifies(match.group()):
                self._found.append(match.span())
        # The rest of a sentence that has begun may follow.
        begin_at = buffer.rfind(b"$", max(after, len(buffer) - MAX_SENTENCE))
        self._searched = len(buffer) if begin_at < 0 else begin_at

    def drop(self, count: int) -> None:
        """Forget the first `count` bytes of the buffer."""
        self._searched = max(0, self._searched - count)
        if self._found:
            self._found = deque((a - count, b - count) for a, b in self._found if a >= count)


class NmeaSplitter:
    """`StreamSplitter` for sentences only."""

    def __init__(self, counters: Counter[str] | None = None) -> None:
        self._stream = StreamSplitter(counters)
        self.counters = self._stream.counters

    @property
    def waiting(self) -> int:
        """Bytes kept until more come."""
        return self._stream.waiting

    @property
    def unread(self) -> bytes:
        """Unrecognised bytes, as `StreamSplitter.unread`."""
        return self._stream.unread

    def feed(self, data: bytes) -> list[Sentence]:
        """The sentences that `data` completes, in order."""
        return [item for item in self._stream.feed(data) if isinstance(item, Sentence)]

    def finish(self) -> list[Sentence]:
        """Finish, as `StreamSplitter.finish`."""
        return [item for item in self._stream.finish() if isinstance(item, Sentence)]


def _verifies(raw: bytes) -> bool:
    """True if `hh` of `$`...`*hh` is the XOR of the characters between `$` and `*`. Below 16 it may
    be one digit before the line's end (`%X` of small devices)."""
    found, printed = reduce(xor, raw[1:-3], 0), raw[-2:].upper()
    if printed[1:] in _LINE_ENDS:
        return b"%X" % found == printed[:1]
    return b"%02X" % found == printed


def _ubx_length(buffer: bytearray, at: int) -> int | None:
    """Length of the UBX frame at `at`; None while its header is cut."""
    if len(buffer) < at + 6:
        return None
    return int.from_bytes(buffer[at + 4 : at + 6], "little") + 8


def _rtcm_length(buffer: bytearray, at: int) -> int | None:
    """Length of the RTCM 3 frame at `at`; None while its header is cut."""
    if len(buffer) < at + 5:
        return None
    return (int.from_bytes(buffer[at + 1 : at + 3], "big") & 0x3FF) + 6
