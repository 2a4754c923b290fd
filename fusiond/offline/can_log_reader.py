"""Reader of a recorded CAN bus, by python-can's readers; unreadable frames are skipped.

    .log   candump -L, -l, and its terminal form with stamps     .blf   Vector, binary
    .asc   Vector, text                                          .mf4   ASAM MDF 4 (asammdf)
    .trc   PEAK, versions 1.0 to 2.1

Each but the last may also end in .gz. The content takes precedence over the name. Dates without a
zone are interpreted as by python-can.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib.util
import logging
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from drivers.can.python_can_import import can
from fusiond.files.csv_tables import MissingPackageError, Rejection, TableError
from fusiond.files.install_extra import install_command
from fusiond.offline.blf_repair import DAY_S, Containers
from fusiond.offline.can_log_kind import FORMATS, LOOKED_AT, foreign_kind, kind_of
from fusiond.offline.can_text_repair import (
    HEADER_ENDS,
    TRC_VERSIONS,
    Asc,
    Candump,
    TextLines,
    Trc,
    candump_of,
    dated,
    first_stamps,
    stamp_s,
)
from fusiond.offline.mf4_frames import Mf4Error, frames

_GZIP = b"\x1f\x8b"
_MOST_NAMED = 20
"""Refusals that are kept in words; of the others the number."""
_STRAY = 1000
"""Least share of frames of a real channel; a smaller one is damage in a name, since a bus sends
more often than a rare device."""
_ZONES = {
    ".asc": "the dates of an ASC log have no zone: taken as local time of this computer, {zone}",
    ".blf": "the date of a BLF log has no zone: taken as UTC",
    ".trc": "the date of a TRC log has no zone: taken as UTC",
}
_UNDATED = "the log has no date that is understood: its times count from its beginning"
_DATED_LOG = "the dates of candump -t A have no zone: taken as local time of this computer, {zone}"


class Refusals:
    """Unreadable lines of a log: line and text of the first one, and the number of others."""

    def __init__(self) -> None:
        self._named: list[Rejection] = []
        self._more = Counter[str]()

    def add(self, line: int, reason: str, detail: str) -> None:
        """Count a refusal; `line` is 0 if unknown."""
        if len(self._named) < _MOST_NAMED:
            self._named.append(Rejection(line, reason, detail))
        else:
            self._more[reason] += 1

    def count(self, refused: Counter[str]) -> None:
        """Reasons that are only counted."""
        self._more.update(refused)

    @property
    def first(self) -> str:
        """First refusal in words."""
        return str(self._named[0]) if self._named else ""

    def all(self) -> list[Rejection]:
        """Refusals by reason: named ones, and the number of others."""
        named = Counter(each.reason for each in self._named)
        more = [
            Rejection(0, name, f"{n} {'more' if named[name] else 'times'}", n)
            for name, n in self._more.items()
            if n
        ]
        return [*self._named, *more]


def messages(
    path: Path,
    refusals: Refusals | None = None,
    on_zone: Callable[[str, str], None] = lambda code, text: None,
) -> Iterator[can.Message]:
    """Messages of a log in order. `on_zone(code, text)` receives the time zone of its dates.

    Raises `TableError` without a readable message, `MissingPackageError` for MF4 without asammdf,
    OSError for a file that cannot be opened.
    """
    log, lost = _format(path), Refusals() if refusals is None else refusals
    read = {".blf": _binary, ".mf4": _mf4}.get(log.suffix, _text)
    count, odd = 0, Counter[str]()
    with contextlib.ExitStack() as stack:
        stack.enter_context(_warned(lambda: odd.update(("length_or_type_odd",))))
        for message in read(log, lost, stack, on_zone):
            count += 1
            yield message
    if log.suffix != ".trc":  # lines are refused by number
        lost.count(odd)
    if not count and lost.first:
        hint = "; candump writes logs with -L or -l" if log.suffix == ".log" else ""
        raise TableError(f"{path}: cannot be read as {log.suffix}: {lost.first}{hint}")


def channels(path: Path) -> set[Any]:
    """Channels of a log, without spurious ones from damage. Raises as `messages` does."""
    frames: Counter[Any] = Counter(_channel_words(path))
    frames = frames or Counter(m.channel for m in messages(path))
    return {name for name, n in frames.items() if n * _STRAY >= frames.total()}


# --------------------------------------------------------------------------- formats


class _Log(NamedTuple):
    path: Path
    suffix: str

    def open(self) -> BinaryIO:
        """Open a log; a gzip file, whatever its name, is unpacked."""
        with self.path.open("rb") as file:
            zipped = file.read(len(_GZIP)) == _GZIP
        opened = gzip.open if zipped else open
        return cast(BinaryIO, opened(self.path, "rb"))


def _format(path: Path) -> _Log:
    """Format by content, or else by name. Raises `TableError`."""
    suffixes = [s.lower() for s in path.suffixes]
    zipped = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if zipped else suffixes[-1:])
    head = b""
    with contextlib.suppress(EOFError, zlib.error, gzip.BadGzipFile), _Log(path, "").open() as log:
        head = log.read(LOOKED_AT)
    if foreign := foreign_kind(head):
        raise TableError(f"{path}: {foreign}")
    suffix = kind_of(head) or suffix
    if suffix not in FORMATS or (zipped and suffix == ".mf4"):
        raise TableError(f"{path}: no CAN log by its name: {', '.join(FORMATS)} are read")
    return _Log(path, suffix)


def _channel_words(path: Path) -> Iterator[str | int]:
    """Channels by the second word of `candump -L`'s lines, which is much faster than parsing every
    frame. None for a log of another form."""
    log = _format(path)
    if log.suffix != ".log":
        return
    with log.open() as stream:
        for line in TextLines(stream, lambda line: line, lambda number, text: None):
            words = line.split(None, 3)
            if len(words) >= 3 and "#" in words[2] and words[0].startswith("("):
                yield int(words[1]) if words[1].isdigit() else words[1]


def _text(
    log: _Log, lost: Refusals, stack: contextlib.ExitStack, on_zone: Callable[[str, str], None]
) -> Iterator[can.Message]:
    """Messages of a text log. After a line that stops a reader, reading continues behind it."""
    stream = stack.enter_context(log.open())
    asc = Asc()
    candump = Candump([])
    if log.suffix == ".log":
        with log.open() as first:
            stamps = first_stamps(first)
        candump = candump_of(stamps)
        if stamps and dated(stamps[0]):
            on_zone("recorder_zone", _DATED_LOG.format(zone=_zone(stamp_s(stamps[0]))))
    trc = Trc()
    plain = {".log": candump.plain, ".asc": asc.plain, ".trc": trc.plain}[log.suffix]
    lines = TextLines(stream, plain, lambda line, text: lost.add(line, "unreadable", text))
    source = cast(Any, lines)
    reader: Any
    if log.suffix == ".asc":
        reader = can.ASCReader(source, relative_timestamp=False)
    else:
        reader = (can.TRCReader if log.suffix == ".trc" else can.CanutilsLogReader)(source)
    if log.suffix == ".trc":
        stack.enter_context(_warned(lines.refuse))
    began = False
    while True:
        pulled = lines.number
        try:
            for message in reader:
                if asc.before_trigger_s:
                    message.timestamp -= 2.0 * asc.before_trigger_s
                if not began:
                    began = True
                    _report_zone(log, getattr(reader, "start_time", None), on_zone)
                yield message
            break
        except Exception:  # a reader may raise anything for an invalid line
            lines.refuse()
            if lines.number == pulled:  # not of a line, but of an incomplete header, at the end
                break
            if asc.in_frames:
                lines.put_before(HEADER_ENDS)
    if lines.damage is not None:
        lost.add(0, "cut", f"the log ends in damage: {lines.damage}")
    if trc.version and trc.version not in TRC_VERSIONS and not began:
        read = ", ".join(TRC_VERSIONS)
        raise TableError(f"{log.path}: TRC of version {trc.version}; versions {read} are read")
    if candump.unstamped and not began:
        raise TableError(
            f"{log.path}: candump's terminal form without times: record with candump -L"
        )


def _binary(
    log: _Log, lost: Refusals, stack: contextlib.ExitStack, on_zone: Callable[[str, str], None]
) -> Iterator[can.Message]:
    stream = stack.enter_context(log.open())
    containers = Containers(stream, lambda text: lost.add(0, "unreadable", text))
    try:
        reader = can.BLFReader(cast(BinaryIO, containers))
    except Exception:  # it may raise anything for another file
        lost.add(0, "unreadable", "its header is cut, or none of BLF")
        return
    containers.body()
    _report_zone(log, reader.start_timestamp, on_zone)
    reader.start_timestamp -= DAY_S
    try:
        yield from reader
    except Exception as error:
        lost.add(0, "cut", f"the log ends in damage: {error}")
    if containers.damage is not None:
        lost.add(0, "cut", f"the log ends in damage: {containers.damage}")


def _mf4(
    log: _Log, lost: Refusals, stack: contextlib.ExitStack, on_zone: Callable[[str, str], None]
) -> Iterator[can.Message]:
    if importlib.util.find_spec("asammdf") is None:
        raise MissingPackageError(f"MF4 logs need the package asammdf: {install_command('mf4')}")
    log.path.open("rb").close()
    try:
        yield from frames(log.path)
    except Mf4Error as error:
        lost.add(0, "cut", f"the log ends in damage: {error}")


def _report_zone(log: _Log, start: Any, on_zone: Callable[[str, str], None]) -> None:
    """Report the time zone of the log's date, or its absence."""
    if log.suffix in _ZONES and not start:
        on_zone("recorder_zone", _UNDATED)
    elif log.suffix in _ZONES:
        zone = _zone(start) if log.suffix == ".asc" else ""
        on_zone("recorder_zone", _ZONES[log.suffix].format(zone=zone))


def _zone(t_s: float | None) -> str:
    """Time zone of this computer at an instant, such as "CEST (UTC+0200)"."""
    try:
        local = time.localtime(t_s)
    except (ValueError, OverflowError, OSError):
        local = time.localtime()
    return time.strftime("%Z (UTC%z)", local)


@contextlib.contextmanager
def _warned(call: Callable[[], None]) -> Iterator[None]:
    """Collect the lines for which python-can only logs a warning, and hide the warnings."""
    logger, handler = logging.getLogger("can.io"), _Forwarded(call)
    propagated, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagated


class _Forwarded(logging.Handler):
    def __init__(self, call: Callable[[], None]) -> None:
        super().__init__(logging.WARNING)
        self._call = call

    def emit(self, record: logging.LogRecord) -> None:
        self._call()
