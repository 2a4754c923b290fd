"""A recorded CAN bus through the drivers that would serve it live: `fusiond process --can LOG`.

Frames go to the very drivers that the configuration names, and their stamps to the daemon's own
`Clock`, whose host lives by the log: the recorder's stamp of a frame is the instant at which it
came. Times are those of the log, POSIX seconds where the recorder knew the date.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib.util
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivers.base import Emitted
from drivers.can.bus import CanFrame
from drivers.can.driver import CanDriver
from drivers.can.imu import CanImuDriver
from drivers.can.python_can import can, with_mf4
from drivers.measurements import (
    DeviceEvent,
    ImuSample,
    MonotonicStamp,
    TimeReport,
)
from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch
from fusiond.clock.clock import Clock
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import MissingPackageError, Rejection, TableError, counted
from fusiond.files.tables import ImuTable
from fusiond.offline.aid_files import Arrival

FORMATS = (".log", ".asc", ".blf", ".mf4")
"""candump -L or -l, Vector's text and binary, ASAM MDF 4; each may end in .gz but for the last."""
AHEAD_NS = 1_000_000_000
"""A stamp that is later than the next by more is damaged: a recorder writes as frames come, and two
controllers' clocks agree better. Taken for the time, it would make all others too old."""
REFUSALS = {
    "wrong_length",
    "undecodable",
    "not_finite",
    "out_of_range",
    "not_valid",
    "no_fix",
    "bad_date",
    "no_steering",
    "unpaired",
    "refused",
    "several_frames",
    "time_backward",
}
"""Counters of frames that were meant for a driver and made no measurement."""


class CanLog(NamedTuple):
    """What a log holds: IMU samples with what was refused of them, aids with their arrivals,
    refusals of frames (`can`) and by source of an aid; `events` (code, text)."""

    imu: ImuTable
    arrivals: list[Arrival]
    rejected: dict[str, list[Rejection]]
    events: list[tuple[str, str]]


class _LogTime:
    """A host whose clocks are the log's: monotonic, real and boot time are that of the frame."""

    def __init__(self) -> None:
        self.t_ns = 0

    def monotonic_ns(self) -> int:
        return self.t_ns

    realtime_ns = boottime_ns = monotonic_ns


def read_can_log(path: Path, config: Config) -> CanLog:
    """Take the log apart by the drivers of the configuration. Raises `TableError`."""
    return _Replay(path, config).run()


class _Replay:
    """Drivers, clock and what came of them."""

    def __init__(self, path: Path, config: Config) -> None:
        self._path = path
        self._host = _LogTime()
        self._clock = Clock(config.clock, self._host)
        self._events: list[tuple[str, str]] = []
        self._clock.on_event = lambda code, text: self._events.append((code, text))
        self._arrivals: list[Arrival] = []
        self._imu: list[tuple[int, ImuSample]] = []
        self._drivers = self._make_drivers(config)
        if not self._drivers:
            raise TableError(f"{path}: the configuration has no source on a CAN bus")

    def _make_drivers(self, config: Config) -> dict[str, CanDriver[Any]]:
        points = driver_entry_points()
        drivers: dict[str, CanDriver[Any]] = {}
        for name, section in config.sources.items():
            make = points[section.driver].load()
            if issubclass(make, CanDriver):
                options = make.Options(**section.options)
                drivers[name] = make(name, options, self._emit, self._host.monotonic_ns)
        return drivers

    def run(self) -> CanLog:
        """Read the log to its end."""
        buses = self._buses()
        frames = Counter[str]()
        damage: list[str] = []
        whole = messages(self._path, damage.append)
        for message, following in pairwise(chain(whole, (None,))):
            assert message is not None
            kind = _not_data(message)
            if kind is not None:
                frames[kind] += 1
                continue
            t_ns = round(message.timestamp * 1e9)
            if t_ns < self._host.t_ns:
                frames["time_backwards"] += 1
                continue
            after_ns = t_ns if following is None else round(following.timestamp * 1e9)
            if self._host.t_ns <= after_ns < t_ns - AHEAD_NS:
                frames["time_ahead"] += 1
                continue
            self._host.t_ns = t_ns
            can_id, extended = message.arbitration_id, message.is_extended_id
            frame = CanFrame(can_id, extended, bytes(message.data), t_ns, t_ns)
            for driver in buses[message.channel]:
                driver.feed(frame)
        cut = [Rejection(0, "cut", f"the log ends in damage: {text}") for text in damage]
        rejected, imu = {"can": [*counted(frames), *cut]}, self._imu_table()
        for name, driver in self._drivers.items():
            refused = counted({n: c for n, c in driver.counters.items() if n in REFUSALS})
            if isinstance(driver, CanImuDriver):
                imu.rejected.extend(refused)
            else:
                rejected[name] = refused
        return CanLog(imu, self._arrivals, rejected, self._events)

    def _buses(self) -> dict[Any, list[CanDriver[Any]]]:
        """Whose frames those of each channel of the log are.

        A log of one channel is everybody's bus. In one of several each source has the channel of
        its name, or `canN` of number N.
        """
        channels = sorted(_channels(self._path), key=str)
        if not channels:
            raise TableError(f"{self._path}: no CAN frame")
        if len(channels) == 1:
            return {channels[0]: list(self._drivers.values())}
        buses: dict[Any, list[CanDriver[Any]]] = {channel: [] for channel in channels}
        for name, driver in self._drivers.items():
            wanted = driver.options.channel
            mine = [c for c in channels if wanted in (str(c), f"can{c}")]
            if not mine:
                there = ", ".join(map(str, channels))
                raise TableError(
                    f"{self._path}: there are the channels {there}, and none is {wanted} of "
                    f"[sources.{name}]"
                )
            buses[mine[0]].append(driver)
        return buses

    def _emit(self, item: Emitted) -> None:
        """As `fusiond.live.sources` does, at the instant of the frame."""
        match item:
            case DeviceEvent():
                self._events.append((item.code, f"{item.source}: {item.text}"))
            case TimeReport():
                self._clock.report(item)
            case Ephemeris() | Klobuchar() | RawGnssEpoch():
                raise AssertionError("no driver on a CAN bus has raw observations")
            case _:
                instant = self._clock.resolve(item.stamp, item.source, item.t_seen_ns)
                if isinstance(item, ImuSample):
                    self._imu.append((instant.t_valid_ns, item))
                    return
                held = replace(item, stamp=MonotonicStamp(instant.t_valid_ns))
                self._arrivals.append(Arrival(item.t_seen_ns, held, instant.sd_s))

    def _imu_table(self) -> ImuTable:
        """Of the first source that has sent any, as the daemon does."""
        first = self._imu[0][1].source if self._imu else ""
        kept = [(t_ns, m) for t_ns, m in self._imu if m.source == first]
        rejected = []
        if len(kept) < len(self._imu):
            others = len(self._imu) - len(kept)
            rejected.append(Rejection(0, "second_imu", f"{others} samples", others))
        times = np.array([t_ns for t_ns, _ in kept], dtype=np.int64)
        samples = [(*m.gyro_rad_s, *m.accel_m_s2) for _, m in kept]
        t_s = times.astype(np.float64) * 1e-9
        return ImuTable(t_s, np.array(samples, dtype=np.float64).reshape(-1, 6), rejected)


# --------------------------------------------------------------------------- frames


def messages(path: Path, damaged: Callable[[str], None]) -> Iterator[can.Message]:
    """The messages of a log in its order; `damaged` hears of what ends it before its end.

    Raises `TableError` where there is no message to be read, `MissingPackageError` for MF4 without
    asammdf, OSError for a file that cannot be opened.
    """
    suffix, zipped = _format(path)
    count = 0
    with contextlib.ExitStack() as stack:
        try:
            for message in _reader(path, suffix, zipped, stack):
                count += 1
                yield message
        except _DAMAGE as error:
            if not count:
                raise TableError(f"{path}: cannot be read as {suffix}: {error}") from error
            damaged(f"{type(error).__name__} after {count} frames: {error}")


def _format(path: Path) -> tuple[str, bool]:
    """One of `FORMATS`, and whether it is zipped; by the name. Raises `TableError`."""
    suffixes = [s.lower() for s in path.suffixes]
    zipped = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if zipped else suffixes[-1:])
    if suffix not in FORMATS or (zipped and suffix == ".mf4"):
        raise TableError(f"{path}: no CAN log by its name: {', '.join(FORMATS)} are read")
    return suffix, zipped


def _channels(path: Path) -> set[Any]:
    """The channels of a log, up to where it is damaged. Raises as `messages` does.

    What candump wrote says them in the second word of its lines: to parse every frame for that
    takes as long as to parse it for the drivers.
    """
    suffix, zipped = _format(path)
    found: set[Any] = set()
    if suffix == ".log":
        with contextlib.suppress(*_DAMAGE), (gzip.open if zipped else open)(path, "rt") as lines:
            for words in filter(None, map(str.split, lines)):
                if not words[2].partition("#")[1]:
                    break
                found.add(int(words[1]) if words[1].isdigit() else words[1])
    return found or {m.channel for m in messages(path, lambda text: None)}


_DAMAGE = (ValueError, LookupError, EOFError, struct.error, zlib.error, can.CanError)
"""What the readers of python-can raise for a file that is not what it is called."""


def _reader(path: Path, suffix: str, zipped: bool, stack: contextlib.ExitStack) -> Any:
    """The reader of python-can; what it reads of is closed by `stack`."""
    if suffix == ".mf4":
        if importlib.util.find_spec("asammdf") is None:
            raise MissingPackageError(
                "MF4 logs need the package asammdf: pip install 'fusiond[mf4]'"
            )
        with_mf4()
        return can.MF4Reader(path)
    opened = gzip.open if zipped else open
    source: Any = stack.enter_context(opened(path, "rb" if suffix == ".blf" else "rt"))
    if suffix == ".blf":
        return can.BLFReader(source)
    if suffix == ".asc":
        return can.ASCReader(source, relative_timestamp=False)
    return can.CanutilsLogReader(source)


def _not_data(message: can.Message) -> str | None:
    """Whether a message is none of a device, as the bus counts it."""
    if message.is_error_frame:
        return "error_frames"
    return "remote_frames" if message.is_remote_frame else None
