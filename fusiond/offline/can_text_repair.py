r"""Normalisation of text CAN logs for python-can's readers, which skips bad lines.

The lines that a reader pulls are repaired before: encoding, and blocks of zeros that a file system
leaves after a power cut. Forms that python-can does not read are converted:

    candump's terminal form    (t) can0  7E8  [8]  03 41 ...    ->  (t) can0 7E8#0341...
    dates, raw length codes    candump -L -t A, -8: (2026-03-24 07:33:02.1) can0 7E8#0341..._9
    stamps as differences      candump -t d, ASC "timestamps relative": summed
    months of another Windows  ASC "date Di Mrz 24 ...": in English
    stamps before the trigger  ASC -0.5: without the sign, which `before_trigger_s` remembers
    decimal commas             ASC and TRC 0,5 of a German or French Windows
    CANFD without a channel    ASC "CANFD   Start of measurement" and the like: no frame

Sources: can-utils, candump.c and lib.c (`snprintf_long_canframe`); Vector, ASC format description.
"""

from __future__ import annotations

import codecs
import gzip
import io
import re
import zlib
from collections.abc import Callable, Iterator
from datetime import datetime
from itertools import islice, pairwise
from typing import BinaryIO

from fusiond.files.log_bytes import utf_16

LONGEST = 16_384
"""Bytes of a line. A frame of CAN XL, the longest there is, has 2048 bytes: 6144 characters in the
terminal's form."""
SHOWN = 60
"""Characters shown of a refused line."""
_ERROR_FRAME = 0x2000_0000
"""CAN_ERR_FLAG of the identifier of an error frame (linux/can.h)."""

Plain = Callable[[str], str | None]


class TextLines:
    """Lines of a log, as a file for a reader of python-can.

    `plain(line)` converts a line to a form that the reader knows, two lines at most; None: no
    frame. `refused(line, text)` receives each lost line.
    """

    def __init__(self, stream: BinaryIO, plain: Plain, refused: Callable[[int, str], None]) -> None:
        self._stream = _decoded(stream)
        self._plain = plain
        self._refused = refused
        self._refused_line = 0
        self._line = ""
        self._again: str | None = None
        self.number = 0
        """Number of the last line read, from 1."""
        self.damage: Exception | None = None
        """Cause of a premature end: a zipped one that is cut."""

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._again is not None:
            line, self._again = self._again, None
            return line
        while raw := self._read():
            self.number += 1
            self._line = text = self._text(raw)
            if not text or text.isspace():
                continue
            if (plain := self._plain(text)) is not None:
                first, _, second = plain.rstrip("\r\n").partition("\n")
                self._again = second or None
                return first
        raise StopIteration

    def close(self) -> None:
        """Keep the file open: the reader closes its input, and the opener closes the file."""

    def refuse(self) -> None:
        """Refuse the line that was pulled last."""
        if self.number > self._refused_line:
            self._refused_line = self.number
            shown = self._line.strip()
            cut = repr(shown[:SHOWN] + ("..." if shown[SHOWN:] else ""))
            self._refused(self.number, cut if shown else "a block of zeros")

    def put_before(self, line: str) -> None:
        """Insert a line, not of the file, before the next one."""
        self._again = line

    def _read(self) -> bytes:
        """Read the next line; of a line that is too long or contains zeros, only the part
        behind."""
        try:
            raw = self._stream.readline(LONGEST)
            if b"\0" not in raw and len(raw) < LONGEST:
                return raw
            kept, more = raw, raw
            while len(more) == LONGEST and not more.endswith(b"\n"):
                more = self._stream.readline(LONGEST)
                kept = (kept + more).rpartition(b"\0")[2][-LONGEST:]
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self.damage = error
            return b""
        self.number += 1
        self._line = self._text(raw.partition(b"\0")[0])
        self.refuse()
        self.number -= 1
        return kept.rpartition(b"\0")[2] or b"\n" if b"\0" in raw else b"\n"

    def _text(self, raw: bytes) -> str:
        """Decode UTF-8, else a western European Windows code page."""
        if self.number == 1:
            raw = raw.removeprefix(codecs.BOM_UTF8)
        try:
            return raw.decode()
        except UnicodeDecodeError:
            return raw.decode("cp1252", "replace")


def _decoded(stream: BinaryIO) -> BinaryIO:
    """Convert UTF-16 (PowerShell's `>`) to UTF-8, and carriage returns alone to line feeds."""
    try:
        first = stream.read(LONGEST)
        encoding = utf_16(first)
        if not encoding and (b"\r" not in first or b"\n" in first):
            stream.seek(0)
            return stream
        whole = first + stream.read()
    except (EOFError, zlib.error, gzip.BadGzipFile):
        stream.seek(0)  # the first line shows it
        return stream
    if encoding:
        return io.BytesIO(whole.decode(encoding, "replace").encode())
    return io.BytesIO(whole.replace(b"\r", b"\n"))


# --------------------------------------------------------------------------- candump

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_TERMINAL = re.compile(
    r"\s*(?:\((?P<t>[^()]*)\)\s+)?(?P<channel>[^\s()]+)\s+(?:(?:RX|TX)(?:\s+[-A-Z])*\s+)?"
    r"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+(?:\[(?P<length>\d{1,4})\]|\{[9A-F]\})"
    r"(?P<data>(?:\s+[0-9A-Fa-f]{2})*)(?P<rest>\s.*|$)"
)
_COMPACT = re.compile(r"\s*\((?P<t>[^()]*)\)\s+(?=\S+\s+[0-9A-Fa-f]{3,8}#)")
_RAW_LENGTH = re.compile(r"(?<=#)([0-9A-Fa-f]{16})_[9A-F](?=\s|$)")
"""Eight bytes with a length code above 8 (CAN 2.0; `candump -8`)."""
_FIRST_LINES = 1000
"""Lines examined for relative stamps; zero-based stamps never fall."""
_BEGINS = 1.0
"""Least absolute stamp (s): a log with a smaller first one counts from its beginning."""


class Candump:
    """Lines of candump, converted to the form of `candump -L`; `[length]` marks the terminal's
    form."""

    def __init__(self, stamps: list[float], *, is_dated: bool = False) -> None:
        """`stamps` are those of the first lines."""
        self._differences = bool(stamps) and stamps[0] < _BEGINS and _fall_or_stand(stamps)
        self._sum_s = 0.0
        self._converts = self._differences or is_dated
        self.unstamped = False
        """True if a frame without a time was found."""

    def plain(self, line: str) -> str:
        """Convert a line to the form of `candump -L`."""
        if "\x1b" in line:
            line = _COLOUR.sub("", line)
        if "[" not in line and "{" not in line:
            if self._converts:
                line = self._restamped(line)
            if "_" in line:
                line = _RAW_LENGTH.sub(r"\1", line)
            hash_at = line.find("#")
            if hash_at >= 0 and "." in line[hash_at:]:  # 123#11.22.33, a form that canplayer reads
                line = line[:hash_at] + line[hash_at:].replace(".", "")
            if hash_at >= 8 and line[hash_at - 8 : hash_at - 7] in "2367":
                return _with_error_flag(line, hash_at)
            return line
        found = _TERMINAL.fullmatch(line.rstrip())
        if found is None:
            return line
        if found["t"] is None:
            self.unstamped = True
            return line
        stamp = self._stamp_s(found["t"])
        if stamp is None:
            return line
        head = f"({stamp:.6f}) {found['channel']} {found['id']}#"
        stated, data = found["length"] or "8", found["data"].split()
        length = int(stated)
        if int(found["id"], 16) & _ERROR_FRAME:
            return _with_error_flag(head, len(head) - 1)
        if "remote request" in found["rest"]:
            return f"{head}R{length}"
        if len(data) < length:
            return line
        # Two digits mark CAN FD, whose flags this form lacks.
        fd = "#0" if len(stated) > 1 else ""
        return head + fd + "".join(data[:length])

    def _restamped(self, line: str) -> str:
        """Line of `candump -L` whose stamp is a date or a difference, with seconds."""
        found = _COMPACT.match(line)
        stamp = None if found is None else self._stamp_s(found["t"])
        return line if found is None or stamp is None else f"({stamp:.6f}) {line[found.end() :]}"

    def _stamp_s(self, text: str) -> float | None:
        """Seconds of a stamp in brackets; None if it is none."""
        stamp = stamp_s(text)
        if stamp is None or not self._differences:
            return stamp
        self._sum_s += max(0.0, stamp)
        return self._sum_s


def _with_error_flag(line: str, hash_at: int) -> str:
    """Convert an error frame's line for python-can, which requires CAN_ERR_BUSERROR."""
    return f"{line[: hash_at - 8]}20000080{line[hash_at:]}"


def stamp_s(text: str) -> float | None:
    """Seconds of a stamp in brackets: a number, or a date in local time (`candump -t A`)."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text.strip()).timestamp()
    except (ValueError, OverflowError, OSError):
        return None


def dated(stamp: str) -> bool:
    """True if a stamp in brackets is a date."""
    return "-" in stamp.strip()[1:] and stamp_s(stamp) is not None


def first_stamps(stream: BinaryIO) -> list[str]:
    """Stamps of the first lines."""
    lines = TextLines(stream, lambda line: line, lambda line, text: None)
    first = (_COLOUR.sub("", line).rstrip() for line in islice(lines, _FIRST_LINES))
    found = (_TERMINAL.fullmatch(line) or _COMPACT.match(line) for line in first)
    return [each["t"] for each in found if each is not None and each["t"] is not None]


def candump_of(stamps: list[str]) -> Candump:
    """Make the converter for a log with these first stamps."""
    seconds = [stamp_s(stamp) for stamp in stamps]
    found = [s for s in seconds if s is not None]
    return Candump(found, is_dated=bool(stamps) and dated(stamps[0]))


def _fall_or_stand(stamps: list[float]) -> bool:
    """True if the stamps are differences: they decrease, and end no later than they began; or they
    are equal from the second on. They also decrease in a log of two buses, one after the other."""
    falls = any(after < before for before, after in pairwise(stamps))
    half = len(stamps) // 2
    grows = max(stamps[half:]) > max(stamps[: half + 1])
    stands = len(stamps) > 3 and stamps[1] > 0.0 and len(set(stamps[1:])) == 1
    return stands or (falls and not grows)


# --------------------------------------------------------------------------- Vector's ASC

_STAMPED = re.compile(r"\s*(-?)(\d+)([.,])(\d+)(?=\s)")
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
_HEADER = re.compile(
    r"\s*(date\s+\w+\s|base\s|//|(no\s*)?internal\s+events\s+logged|begin\s)", re.IGNORECASE
)
_DATE = re.compile(r"(\s*date\s+)\S+\s+(?P<month>[^\W\d]+)\.?(?=\s)", re.IGNORECASE)
_MONTHS = {
    "Jan": "jan gen ene",
    "Feb": "feb fev fév",
    "Mar": "mar mär mrz mrt",
    "Apr": "apr avr abr",
    "May": "may mai mag mei",
    "Jun": "jun giu juin",
    "Jul": "jul lug juil",
    "Aug": "aug ago aoû aou",
    "Sep": "sep set",
    "Oct": "oct okt ott out",
    "Nov": "nov",
    "Dec": "dec dez dic déc",
}
"""Beginnings of the months' names: English, German, French, Italian, Spanish, Portuguese, Dutch."""
_ENGLISH = {name: month for month, names in _MONTHS.items() for name in names.split()}
_HEADER_OVER = re.compile(r"\s*((no\s*)?internal\s+events\s+logged|begin\s)", re.IGNORECASE)
_FD_EVENT = re.compile(r"\s*-?\d+[.,]\d+\s+CANFD\s+[^\d\s]", re.IGNORECASE)
HEADER_ENDS = "internal events logged"
"""Line after which python-can's ASC reader expects frames."""


class Asc:
    """Lines of an ASC file, converted to python-can's form."""

    def __init__(self) -> None:
        self.in_frames = False
        """True if the header is over: stamped lines have come."""
        self.before_trigger_s = 0.0
        """Time (s) of the last line before the start of the measurement."""
        self._relative = False
        self._sum_ns = 0
        self._header_ended = False

    def plain(self, line: str) -> str | None:
        """Convert a line: its stamp counts from the beginning, without sign; None for an event
        without channel. A missing last line of the header is added before the first frame."""
        said = self._plain(line)
        if said is None or self._header_ended or not self.in_frames:
            return said
        self._header_ended = True
        return said if _HEADER_OVER.match(line) else f"{HEADER_ENDS}\n{said}"

    def _plain(self, line: str) -> str | None:
        self.before_trigger_s = 0.0
        found = _STAMPED.match(line)
        if found is None:
            return line if self.in_frames else self._of_header(line)
        self.in_frames = True
        if _FD_EVENT.match(line):
            return None if not self._relative else self._counted(found, "")
        if self._relative:
            return self._counted(found, line[found.end() :])
        stamp = f"{found[2]}.{found[4]}"
        if found[1]:
            self.before_trigger_s = float(stamp)
        return f"{stamp}{line[found.end() :]}" if found[1] or found[3] == "," else line

    def _of_header(self, line: str) -> str | None:
        """Convert a line before the first frame. The reader ends the header at an unknown line,
        such as a date in another language, and would miss the lines after it."""
        self._relative |= _RELATIVE.match(line) is not None
        self.in_frames |= _HEADER_OVER.match(line) is not None
        if found := _DATE.match(line):
            word = found["month"].lower()
            month = _ENGLISH.get(word[:4]) or _ENGLISH.get(word[:3], found["month"])
            line = f"{found[1]}Thu {month}{line[found.end() :]}"
        return line if _HEADER.match(line) else None

    def _counted(self, found: re.Match[str], rest: str) -> str | None:
        """Sum the difference to the previous event, of whatever kind."""
        ns = int(found[2]) * 10**9 + int(found[4][:9].ljust(9, "0"))
        self._sum_ns += -ns if found[1] else ns
        seconds, fraction = divmod(max(0, self._sum_ns), 10**9)
        return f"{seconds}.{fraction:09d}{rest}" if rest else None


# --------------------------------------------------------------------------- PEAK's TRC

TRC_VERSIONS = ("1.0", "1.1", "1.3", "2.0", "2.1")
"""Versions of TRC that python-can reads."""
_VERSION = re.compile(r";\$FILEVERSION=([\d.]+)")
_COMMA = re.compile(r"(;\$STARTTIME=\d+|\s*\d+\)?\s+\d+),(\d+)(?=\s|$)")


class Trc:
    """Lines of a TRC file; `version` is the stated one, "" without one."""

    def __init__(self) -> None:
        self.version = ""

    def plain(self, line: str) -> str:
        """Convert a line to decimal points."""
        if found := _VERSION.match(line):
            self.version = found[1]
        return _COMMA.sub(r"\1.\2", line, count=1) if "," in line else line
