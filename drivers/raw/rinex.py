"""RINEX 3 and 4 observation files: text to epochs; no I/O.

    > yyyy mm dd hh mm ss.sssssss  flag  n        epoch; flag 0 or 1 has n satellites, 2 to 6 events
    Gnn + 16 characters an observable             F14.3, loss of lock, strength
    rate = -D c / f                               a positive Doppler approaches

An observable is C, L, D or S and a signal's code. BeiDou's B1I, "1I" in 3.02, is "2I" here as in
all others. Epochs may be in GPS, Galileo or BeiDou time. A blank or 0 means not measured. Source:
RINEX 3.05 and 4.01, sections 5 and A2.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date

from drivers.measurements import UtcStamp
from drivers.plausible import LEAP_SECONDS, within
from drivers.raw.messages import (
    CARRIER_HZ,
    SPEED_OF_LIGHT_M_S,
    RawGnssEpoch,
    RawSignal,
    System,
)
from drivers.raw.ubx import MAX_PRN, MAX_RATE_M_S, PSEUDORANGE_M
from drivers.raw.weeks import BDT_BEHIND_GPS_S, WEEK_S, leap_seconds, utc_ns

SYSTEMS: dict[str, System] = {"G": "G", "E": "E", "C": "C"}
OTHERS = {"R": "glonass", "S": "sbas", "J": "qzss", "I": "navic"}
_GPS_ORDINAL = date(1980, 1, 6).toordinal()
_WIDTH = 16
_LOCK_LOST, _HALF_CYCLE = 1, 2
"""Bits of the loss-of-lock indicator: since the epoch before; half a cycle may be missing."""
LABEL = slice(60, 80)
FIRST_LABEL = "RINEX VERSION / TYPE"
COMPRESSED_LABEL = "CRINEX VERS   / TYPE"


class RinexError(ValueError):
    """Error: an unreadable file; the text is the reason."""


def version_and_type(text: str) -> tuple[float, str]:
    """Version and type such as (3.05, "O"). RinexError unless it is RINEX 3 or 4 (for 2:
    `rinex2.as_version_3`)."""
    first = text.partition("\n")[0]
    if first[LABEL].strip() != FIRST_LABEL:
        raise RinexError("no RINEX file: the first line does not say so")
    try:
        version = float(first[:20])
    except ValueError:
        raise RinexError(f"no RINEX version in {first[:20]!r}") from None
    if not 3.0 <= version < 5.0:
        raise RinexError(f"RINEX {version:.2f}; versions 2 to 4 are read")
    return version, first[20:21]


def gps_seconds(numbers: list[str]) -> float:
    """Seconds since 1980-01-06 of a printed year, month, day, hour, minute, second; no leap
    seconds. ValueError."""
    if len(numbers) < 6:
        raise ValueError("no date")
    year, month, day, hour, minute = (int(x) for x in numbers[:5])
    second = float(numbers[5])
    if year < 1980 or not (0 <= hour <= 24 and 0 <= minute < 60 and 0.0 <= second < 61.0):
        raise ValueError("no such time of day")
    days = date(year, month, day).toordinal() - _GPS_ORDINAL
    return days * 86_400 + hour * 3_600 + minute * 60 + second


@dataclass(slots=True)
class _Header:
    version: float
    observables: dict[str, list[str]] = field(default_factory=dict)
    factors: dict[tuple[str, str], float] = field(default_factory=dict)
    time_system: str = "GPS"
    leap_seconds: int | None = None
    listed: str = ""

    def read(self, line: str) -> None:
        """Read a header line, of the file's head or of an event. ValueError if invalid."""
        label = line[LABEL].strip()
        if label == "SYS / # / OBS TYPES":
            if line[:1] != " ":
                self.listed = line[0]
                self.observables[self.listed] = []
            if self.listed in self.observables:
                self.observables[self.listed] += line[6:60].split()
        elif label == "SYS / SCALE FACTOR" and line[:1] != " ":
            factor, names = float(line[2:6]), line[10:60].split()
            for name in names or self.observables.get(line[0], []):
                self.factors[line[0], name] = factor
        elif label == "TIME OF FIRST OBS":
            self.time_system = line[48:51].strip() or "GPS"
        elif label == "LEAP SECONDS" and line[24:27].strip() in ("", "GPS"):
            leap = int(line[:6])
            self.leap_seconds = leap if within(leap, LEAP_SECONDS) else None


@dataclass(slots=True)
class _Columns:
    """Columns of C, L, D and S of each signal of a system, None if absent."""

    signals: list[tuple[str, list[int | None]]]
    factors: list[float]


class ObservationReader:
    """Reader of one file. Counts `epochs_raw`, `lines_unreadable`, `events_passed`, `measured_G`
    and so on, `signal_unknown`, `prn_unknown`, `pseudorange_implausible`, `rate_implausible`,
    `half_cycle_open`."""

    def __init__(self, source: str, text: str, counters: Counter[str]) -> None:
        version, kind = version_and_type(text)
        if kind != "O":
            raise RinexError(f"RINEX type {kind!r} has no observations")
        self._source = source
        self._counters = counters
        self._header = _Header(version)
        self._lines = iter(text.splitlines())
        self._columns: dict[str, _Columns] = {}
        for line in self._lines:
            if line[LABEL].strip() == "END OF HEADER":
                break
            self._take_header(line)
        else:
            raise RinexError("its header has no end")
        if not self._header.observables:
            raise RinexError("its header names no observables (SYS / # / OBS TYPES)")
        if self._header.time_system not in ("GPS", "GAL", "BDT", "QZS"):
            raise RinexError(f"epochs in {self._header.time_system} time are not read")

    def epochs(self) -> Iterator[RawGnssEpoch]:
        """Epochs in the order of the file."""
        for line in self._lines:
            if line[:1] != ">":
                self._counters["lines_unreadable"] += bool(line.strip())
                continue
            try:
                flag, number = int(line[31:32] or "0"), int(line[32:35])
                gps_s = gps_seconds(line[1:29].split()) if flag <= 1 else 0.0
            except (ValueError, IndexError):
                self._counters["lines_unreadable"] += 1
                continue
            if flag > 1:
                self._pass_event(number)
                continue
            yield self._epoch(gps_s, number)

    def _take_header(self, line: str) -> None:
        try:
            self._header.read(line)
        except ValueError:
            self._counters["lines_unreadable"] += 1

    def _pass_event(self, number: int) -> None:
        """Skip an event (changed site or receiver, cycle slips), but read its header lines, which
        may rename observables."""
        self._counters["events_passed"] += 1
        for _ in range(number):
            line = next(self._lines, "")
            self._take_header(line)
        self._columns.clear()

    def _epoch(self, gps_s: float, number: int) -> RawGnssEpoch:
        if self._header.time_system == "BDT":
            gps_s += BDT_BEHIND_GPS_S
        week, tow_s = divmod(gps_s, WEEK_S)
        signals: dict[tuple[str, int, str], RawSignal] = {}
        for _ in range(number):
            line = next(self._lines, "")
            for signal in self._satellite(line):
                signals[signal.system, signal.prn, signal.signal] = signal
        self._counters["epochs_raw"] += 1
        leap = self._header.leap_seconds
        if leap is None:
            leap = leap_seconds(int(week), tow_s)
        stamp = UtcStamp(utc_ns(int(week), tow_s, leap))
        return RawGnssEpoch(self._source, 0, stamp, int(week), tow_s, tuple(signals.values()))

    def _satellite(self, line: str) -> Iterator[RawSignal]:
        system = SYSTEMS.get(line[:1])
        if system is None:
            self._counters[f"measured_{OTHERS.get(line[:1], 'unknown_system')}"] += 1
            return
        try:
            prn = int(line[1:3])
        except ValueError:
            self._counters["lines_unreadable"] += 1
            return
        if not 1 <= prn <= MAX_PRN[system]:
            self._counters["prn_unknown"] += 1
            return
        columns = self._columns.get(system) or self._make_columns(system)
        for name, at in columns.signals:
            try:
                values = [_value(line, k, columns.factors) for k in at]
            except ValueError:
                self._counters["lines_unreadable"] += 1
                continue
            signal = self._signal(system, prn, name, values, _flags(line, at[1]))
            if signal is not None:
                yield signal

    def _signal(
        self, system: System, prn: int, name: str, values: list[float | None], flags: int
    ) -> RawSignal | None:
        pseudorange, carrier, doppler, cno = values
        if pseudorange is None:
            return None
        self._counters[f"measured_{system}"] += 1
        if not within(pseudorange, PSEUDORANGE_M):
            self._counters["pseudorange_implausible"] += 1
            return None
        rate = None
        if doppler is not None:
            rate = -doppler * SPEED_OF_LIGHT_M_S / CARRIER_HZ[system, name[0]]
            if abs(rate) > MAX_RATE_M_S:
                self._counters["rate_implausible"] += 1
                return None
        if carrier is not None and flags & _HALF_CYCLE:
            self._counters["half_cycle_open"] += 1
            carrier = None
        lock_s = 0.0 if flags & _LOCK_LOST else math.inf
        return RawSignal(system, prn, name, pseudorange, rate, carrier, cno, None, None, lock_s)

    def _make_columns(self, system: System) -> _Columns:
        names = self._header.observables.get(system, [])
        found: dict[str, list[int | None]] = {}
        for k, observable in enumerate(names):
            kind, code = observable[:1], observable[1:3]
            if kind not in ("C", "L", "D", "S") or len(code) < 2:
                continue
            if system == "C" and self._header.version < 3.03 and code in ("1I", "1Q", "1X"):
                code = f"2{code[1]}"
            if (system, code[0]) not in CARRIER_HZ:
                self._counters["signal_unknown"] += 1
                continue
            found.setdefault(code, [None] * 4)["CLDS".index(kind)] = k
        factors = [self._header.factors.get((system, name), 1.0) or 1.0 for name in names]
        columns = _Columns(list(found.items()), factors)
        self._columns[system] = columns
        return columns


def _flags(line: str, k: int | None) -> int:
    """Loss-of-lock indicator of a carrier; 0 without one."""
    if k is None:
        return 0
    text = line[3 + _WIDTH * k + 14 : 3 + _WIDTH * k + 15]
    return int(text) if text.isdigit() else 0


def _value(line: str, column: int | None, factors: list[float]) -> float | None:
    """Value of an observable; None if not measured. ValueError if it is no number."""
    if column is None:
        return None
    start = 3 + _WIDTH * column
    text = line[start : start + 14].strip()
    if not text:
        return None
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value / factors[column] or None
