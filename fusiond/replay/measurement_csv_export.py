"""Conversion of a log's measurements to CSV tables for `fusiond process` (docs/files.md).

The recorded bytes pass drivers and clock as they did live; each measurement is written with the
instant that the clock assigns. t_s is the log's time: POSIX seconds where the daemon knew the date
at its start.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from drivers.measurements import (
    Attitude,
    DelayedFix,
    Heading,
    ImuSample,
    Measurement,
    PositionFix,
    WheelSpeed,
)
from drivers.raw.messages import RawGnssEpoch
from fusiond.clock.results import Instant
from fusiond.configuration.schema import Config
from fusiond.recording.reader import Log
from fusiond.replay.replay import Replay

Row = list[str]
_PLACE = ("lat_deg", "lon_deg", "height_m")
_SD = ("sd_n_m", "sd_e_m", "sd_d_m")
_V = ("v_n_m_s", "v_e_m_s", "v_d_m_s", "sd_vn_m_s", "sd_ve_m_s", "sd_vd_m_s")
_GNSS = ("t_s", "t_arrival_s", *_PLACE, "quality", "satellites", *_SD, *_V)
_RDSS = ("t_s", "t_arrival_s", *_PLACE, "precision_class_m", "multi_value")
_IMU = ("t_s", *(f"gyro_{a}_rad_s" for a in "xyz"), *(f"accel_{a}_m_s2" for a in "xyz"))
_ANGLES = ("roll", "pitch", "yaw")
_ATTITUDE = (
    "t_s",
    "t_arrival_s",
    *(f"{a}_deg" for a in _ANGLES),
    *(f"sd_{a}_deg" for a in _ANGLES),
)
_WHEEL = ("t_s", "t_arrival_s", "speed_m_s", "sd_m_s", "unsigned")


def replay_measurements(
    recording: Log,
    config: Config,
    on_arrival: Callable[[Measurement | RawGnssEpoch, Instant], None],
) -> None:
    """Report every measurement of the log with its instant, without a filter."""
    replay = Replay(recording, config, navigate=False, on_arrival=on_arrival)
    for _ in replay.ticks():
        pass


def write_tables(recording: Log, config: Config, folder: Path) -> dict[str, int]:
    """Write `SOURCE.csv` for each source that has a table and return the number of rows by file."""
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as files:
        tables = _Tables(folder, recording.about.epoch_ns, files)
        replay_measurements(recording, config, tables.add)
        return tables.rows


class _Tables:
    def __init__(self, folder: Path, epoch_ns: int, files: ExitStack) -> None:
        self._folder, self._epoch_ns, self._files = folder, epoch_ns, files
        self._writers: dict[str, Any] = {}
        self.rows: dict[str, int] = {}

    def add(self, m: Measurement | RawGnssEpoch, instant: Instant) -> None:
        t_s = _seconds(instant.t_valid_ns + self._epoch_ns)
        seen_s = _seconds(m.t_seen_ns + self._epoch_ns)
        match m:
            case ImuSample():
                self._write(m.source, _IMU, [t_s, *_cells(m.gyro_rad_s), *_cells(m.accel_m_s2)])
            case PositionFix():
                self._write(m.source, _GNSS, [t_s, seen_s, *_gnss(m)])
            case DelayedFix():
                place = *_degrees((m.lat_rad, m.lon_rad)), _cell(m.height_m)
                quality = [_cell(m.precision_class_m), str(int(m.multi_value))]
                self._write(m.source, _RDSS, [t_s, seen_s, *place, *quality])
            case Attitude():
                angles = *_degrees(m.rpy_rad), *_degrees(m.sd_rpy_rad)
                self._write(m.source, _ATTITUDE, [t_s, seen_s, *angles])
            case Heading():
                yaw = *_degrees((m.yaw_rad,)), "", "", *_degrees((m.sd_rad,))
                self._write(f"{m.source}_heading", _ATTITUDE, [t_s, seen_s, "", "", *yaw])
            case WheelSpeed():
                speed = _cell(m.speed_m_s), _cell(m.sd_m_s), str(int(not m.signed))
                self._write(m.source, _WHEEL, [t_s, seen_s, *speed])

    def _write(self, name: str, columns: tuple[str, ...], row: Row) -> None:
        writer = self._writers.get(name)
        if writer is None:
            path = self._folder / f"{name}.csv"
            file: TextIO = self._files.enter_context(path.open("w", encoding="ascii", newline=""))
            writer = self._writers[name] = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            self.rows[name] = 0
        writer.writerow(row)
        self.rows[name] += 1


def _gnss(m: PositionFix) -> Row:
    none = (None, None, None)
    return [
        *_degrees((m.lat_rad, m.lon_rad)),
        _cell(m.height_m),
        str(m.quality),
        _cell(m.satellites),
        *_cells(m.sd_ned_m or none),
        *_cells(m.v_ned_m_s or none),
        *_cells(m.sd_v_ned_m_s or none),
    ]


def _seconds(t_ns: int) -> str:
    """Seconds as text, to the nanosecond: a double of seconds since 1970 has no room for them."""
    return f"{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000:09d}"


def _cell(value: float | int | None) -> str:
    return "" if value is None or not math.isfinite(value) else repr(value)


def _cells(values: tuple[float | None, ...]) -> Row:
    return [_cell(v) for v in values]


def _degrees(values: tuple[float | None, ...]) -> Row:
    return [_cell(None if v is None else math.degrees(v)) for v in values]
