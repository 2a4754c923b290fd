"""Splitter of a byte stream into ASCII logs of NovAtel and Unicore: no I/O.

    # header ; body * hhhhhhhh      CRC-32 (reflected, EDB88320 hex, from 0) between # and *
    NovAtel   NAME,port,sequence,idle,time status,week,seconds,receiver status,reserved,version
    Unicore   NAME,load,GPS|BDS,time status,week,milliseconds,reserved,reserved,leap seconds,delay

Everything else on the line (NMEA, replies to commands, binary logs) is skipped. A damaged log does
not affect the next one. Sources: NovAtel OEM7 Commands and Logs Reference Manual, "ASCII" and
"32-bit CRC"; Unicore Reference Commands Manual for N4 High Precision Products.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from zlib import crc32

from drivers.framing_base import Splitter
from drivers.plausible import LEAP_SECONDS, within
from drivers.raw.weeks import (
    BDT_BEHIND_GPS_S,
    BDT_WEEK,
    LAST_WEEK,
    WEEK_S,
)

MAX_LOG = 2048
"""Most bytes from `#` to the CRC. A position has 300; longer logs such as RANGE are not read."""
_NOT_BODY = re.compile(rb"[^\x20-\x22\x24-\x29\x2b-\x7e]")  # anything but text, and # and *
_NAME = re.compile(r"[A-Z][A-Z0-9_]{2,31}\Z")
_BODY = 9
_ALL = 0xFFFFFFFF
TIMED = frozenset(
    {"COARSE", "COARSESTEERING", "FREEWHEELING", "FINEADJUSTING", "FINE"}
    | {"FINEBACKUPSTEERING", "FINESTEERING", "SATTIME", "EXTERN", "EXACT"}
)
"""Time statuses with a week and seconds that can be used."""
BELIEVED = frozenset({"FINEADJUSTING", "FINE", "FINEBACKUPSTEERING", "FINESTEERING", "EXACT"})
"""Time states in which the receiver knows its clock to a microsecond."""


def log_crc(data: bytes) -> int:
    """CRC of the characters between `#` and `*`."""
    return crc32(data, _ALL) ^ _ALL


@dataclass(frozen=True, slots=True)
class Log:
    """Verified log: `name` without its A, GPS time (`week` None if unknown), leap seconds if the
    header has them, and the fields of the body."""

    name: str
    week: int | None
    tow_s: float
    believed: bool
    leap_seconds: int | None
    fields: tuple[str, ...]


class LogSplitter(Splitter[Log]):
    """Splitter of bytes, in pieces of any size, into verified logs.

    Counts `logs`; refused `crc_bad`, `log_too_long`, `log_cut` (text without a CRC, or the end of
    the stream), `header_bad`; and `other_bytes`, all that belonged to no good log.
    """

    def _refuse(self, why: str, length: int) -> int:
        self.counters[why] += 1
        self.counters["other_bytes"] += length
        return length

    def _scan(self, found: list[Log], *, final: bool) -> None:
        buffer, at = self._buffer, 0
        while True:
            start = buffer.find(b"#", at)
            end = len(buffer) if start < 0 else start
            self.counters["other_bytes"] += end - at
            at = end
            if start < 0:
                break
            used = self._log(at, found)
            if used is None and final:
                used = self._refuse("log_cut", len(buffer) - at)
            if used is None:
                break
            at += used
        del buffer[:at]

    def _log(self, at: int, found: list[Log]) -> int | None:
        """Length of the log that starts at `at`, good or not; None if it is incomplete."""
        buffer = self._buffer
        stop = _NOT_BODY.search(buffer, at + 1, at + MAX_LOG)
        if stop is None:
            if len(buffer) - at < MAX_LOG:
                return None
            return self._refuse("log_too_long", MAX_LOG)
        end = stop.start()
        if buffer[end] != 0x2A:
            return self._refuse("log_cut", end - at)
        if len(buffer) < end + _BODY:
            return None
        raw, stated = bytes(buffer[at + 1 : end]), bytes(buffer[end + 1 : end + _BODY])
        if b"%08X" % log_crc(raw) != stated.upper():
            return self._refuse("crc_bad", end - at + 1)
        log = _parsed(raw.decode("ascii"))
        if log is None:
            return self._refuse("header_bad", end - at + _BODY)
        self.counters["logs"] += 1
        found.append(log)
        return end - at + _BODY


def _parsed(text: str) -> Log | None:
    head, semicolon, body = text.partition(";")
    header = head.split(",")
    if not semicolon or len(header) < 7 or not _NAME.match(header[0]):
        return None
    leap: int | None = None
    beidou = False
    try:
        week, seconds = int(header[5]), float(header[6])
        status = header[4]
        if header[2] in ("GPS", "BDS"):
            status, week, seconds = header[3], int(header[4]), int(header[5]) * 1e-3
            beidou = header[2] == "BDS"
            leap = int(header[8]) if len(header) > 8 and header[8].isdecimal() else None
    except ValueError:
        return None
    if beidou:
        week, seconds = week + BDT_WEEK, seconds + BDT_BEHIND_GPS_S
        if seconds >= WEEK_S:
            week, seconds = week + 1, seconds - WEEK_S
    if leap is not None and not within(leap, LEAP_SECONDS):
        leap = None
    timed = status in TIMED and 0 < week <= LAST_WEEK and 0.0 <= seconds < WEEK_S
    name = header[0].removesuffix("A")
    return Log(
        name,
        week if timed else None,
        seconds if timed else 0.0,
        timed and status in BELIEVED,
        leap,
        tuple(body.split(",")),
    )
