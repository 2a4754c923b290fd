"""Statistics of a log's input: lateness of ticks, regularity and spectrum of inertial samples.

The driver that decoded the samples live decodes them again: the first minute, then ten seconds of
each minute.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import PermanentDriverError
from drivers.measurements import (
    DeviceStamp,
    ImuSample,
    KernelStamp,
    MonotonicStamp,
    Stamp,
)
from fusiond.clock.host import MILLISECOND_NS, SECOND_NS
from fusiond.configuration.load import driver_entry_points
from fusiond.files.csv_tables import Floats
from fusiond.recording.log_metadata import CONFIG, dbc_name
from fusiond.recording.reader import About
from fusiond.recording.records import (
    NO_SOURCE,
    DamagedRecordError,
    Kind,
    Record,
    input_of,
    tick_of,
)
from fusiond.report.run import ImuStatistics

WHOLE_S, EVERY_S, STRETCH_S = 60.0, 60.0, 10.0
_SEGMENT_S = 4.0
"""Segment of the spectrum (s): a resolution of 0.25 Hz."""
_TRIAL = 200
"""Inputs after which a driver without inertial samples is not an inertial unit."""


class InputStatistics:
    """Collector of statistics from input records, in order; `folder` is for the log's DBC files."""

    def __init__(self, about: About, folder: Path) -> None:
        self._epoch_ns = about.epoch_ns
        self._units = _Units(about, folder)
        self._tick_delays: list[tuple[int, int]] = []
        self._first_ns: int | None = None

    def read(self, record: Record) -> None:
        if self._first_ns is None:
            self._first_ns = record.t_ns
        if record.kind is Kind.TICK:
            with suppress(DamagedRecordError):
                self._tick_delays.append((record.t_ns, tick_of(record).latency_ns))
        elif record.source != NO_SOURCE:
            since_s = (record.t_ns - self._first_ns) / SECOND_NS
            if since_s < WHOLE_S:
                self._units.read(0, record)
            elif since_s % EVERY_S < STRETCH_S:
                self._units.read(int(since_s / EVERY_S), record)

    def tick_delay_ms(self) -> tuple[Floats, Floats] | None:
        """Latency of each tick (ms), and its instant."""
        if not self._tick_delays:
            return None
        table = np.array(self._tick_delays, dtype=np.int64)
        return (table[:, 0] + self._epoch_ns) / SECOND_NS, table[:, 1] / MILLISECOND_NS

    def imu(self) -> ImuStatistics | None:
        """Source with the most inertial samples; None without any."""
        return self._units.look(self._epoch_ns)


class _Units:
    """Collector of the inertial unit's samples; it finds the unit among the sources."""

    def __init__(self, about: About, folder: Path) -> None:
        self._names = about.sources
        self._about, self._folder = about, folder
        self._takers: dict[int, Callable[[Record], None] | None] = {}
        self._taken: dict[int, int] = {}
        self._samples: dict[str, list[tuple[int, ImuSample]]] = {}
        self._stretch = self._now_ns = 0

    def read(self, stretch: int, record: Record) -> None:
        number = record.source
        if number not in self._takers:
            self._takers[number] = self._driver(self._names[number])
            self._taken[number] = 0
        taker = self._takers[number]
        if taker is None or record.kind is Kind.SENT:
            return
        self._stretch, self._now_ns = stretch, record.t_ns
        try:
            taker(record)
        except Exception:  # a driver may raise anything: the daemon starts it anew
            self._takers[number] = None
        self._taken[number] += 1
        if self._taken[number] == _TRIAL and self._names[number] not in self._samples:
            self._takers[number] = None

    def _driver(self, name: str) -> Callable[[Record], None] | None:
        try:
            section: dict[str, Any] = json.loads(self._about.attachments[CONFIG])["sources"][name]
            section = dict(section)
            make = driver_entry_points()[section.pop("driver")].load()
            dbc = self._about.attachments.get(dbc_name(name))
            if dbc is not None:
                path = self._folder / dbc_name(name).replace("/", "_")
                path.write_bytes(dbc)
                section["dbc"] = str(path)
            driver = make(name, make.Options(**section), self._emitted, lambda: self._now_ns)
        except (KeyError, TypeError, ValueError, OSError, ImportError, PermanentDriverError):
            return None  # a log of another version, or a driver that is not installed here

        def feed(record: Record) -> None:
            kind, payload = input_of(record)
            driver.inputs.take(kind, payload, record.t_ns)

        return feed

    def _emitted(self, item: object) -> None:
        if isinstance(item, ImuSample):
            self._samples.setdefault(item.source, []).append((self._stretch, item))

    def look(self, epoch_ns: int) -> ImuStatistics | None:
        if not self._samples:
            return None
        source, found = max(self._samples.items(), key=lambda pair: len(pair[1]))
        if len(found) < 3:
            return None
        stretch = np.array([k for k, _ in found])
        seen_ns = np.array([s.t_seen_ns for _, s in found], dtype=np.int64)
        stamps_ns = np.array([_instant_ns(s.stamp, s.t_seen_ns) for _, s in found], dtype=np.int64)
        values = np.array([(*s.gyro_rad_s, *s.accel_m_s2) for _, s in found])
        same = stretch[1:] == stretch[:-1]
        stamped_ms = np.diff(stamps_ns) / MILLISECOND_NS
        step_s = float(np.median(stamped_ms[same])) * 1e-3
        frequency, density = spectrum(values, stretch, step_s)
        return ImuStatistics(
            source=source,
            t_s=(seen_ns[1:] + epoch_ns) / SECOND_NS,
            stamped_ms=np.where(same, stamped_ms, np.nan),
            arrived_ms=np.where(same, np.diff(seen_ns) / MILLISECOND_NS, np.nan),
            samples=len(found),
            seconds=float(step_s * len(found)),
            frequency_hz=frequency,
            gyro=density[:, :3] * degrees(1.0),
            accel=density[:, 3:],
        )


def _instant_ns(stamp: Stamp, t_seen_ns: int) -> int:
    """Instant of a stamp on its own time axis; only differences count."""
    match stamp:
        case DeviceStamp():
            return stamp.ticks_ns
        case KernelStamp():
            return stamp.realtime_ns
        case MonotonicStamp():
            return stamp.t_ns
        case _:
            return t_seen_ns


def spectrum(values: Floats, stretch: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Amplitude spectral density (m, k) in units per root Hz, one-sided, and its frequencies (m,),
    of columns (n, k). Welch's mean of periodograms (IEEE Trans. Audio 15, 1967, 70), Hann window,
    half overlapped, mean removed. The samples are taken as equally spaced. Empty without a whole
    segment."""
    if not step_s > 0.0:
        return np.empty(0), np.empty((0, values.shape[1]))
    size = max(16, round(_SEGMENT_S / step_s))
    window = np.hanning(size + 1)[:-1]
    sums, count = np.zeros((size // 2 + 1, values.shape[1])), 0
    for one in np.unique(stretch):
        part = values[stretch == one]
        for start in range(0, len(part) - size + 1, size // 2):
            segment = part[start : start + size]
            lines = np.fft.rfft((segment - segment.mean(axis=0)) * window[:, None], axis=0)
            sums += np.abs(lines) ** 2
            count += 1
    if not count:
        return np.empty(0), np.empty((0, values.shape[1]))
    density: Floats = np.sqrt(2.0 * sums / count * step_s / float(np.sum(window**2)))
    frequency: Floats = np.fft.rfftfreq(size, step_s).astype(np.float64)
    return frequency[1:], density[1:]
