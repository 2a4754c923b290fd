"""Files of measurements with their arrivals: `fusiond process --aid KIND=FILE`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Height,
    Measurement,
    MonotonicStamp,
    PositionFix,
    UtcStamp,
    WheelSpeed,
)
from drivers.quantization import rounded_speed
from drivers.raw.messages import Correction, RawEvent, RawGnssEpoch
from drivers.raw.weeks import leap_seconds, utc_ns
from drivers.standard_atmosphere import pressure_height_m
from fusiond.configuration.aiding import (
    Aiding,
    BarometerAiding,
    GnssAiding,
    RawAiding,
    RdssAiding,
    SarAiding,
    StarTrackerAiding,
    WheelAiding,
)
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import Rejection, TableError, rejections_from_counts
from fusiond.files.log_bytes import log_bytes
from fusiond.files.measurement_csv import (
    ImuTable,
    read_attitude,
    read_barometer,
    read_bearing,
    read_gnss,
    read_rdss,
    read_wheel,
)
from fusiond.files.mistaken_log_kind import mistaken_log_kind
from fusiond.offline.nmea_file import EARLIEST_DATE, Receiver, read_nmea, receiver_of

Array = NDArray[np.float64]

SECONDS_OF_WEEK = 604800.0
FEWEST_VALUES = 20
"""Fewest values for detecting steps. Of n different values without steps the two nearest are about
(range / n^2) apart: of twenty, a step of at most a four-hundredth of the range is found, which adds
nothing to a sigma."""


OF_A_RECEIVER = frozenset({"nmea", "ubx", "bestpos", "sbf"})
"""Kinds of a receiver's own protocol with fixes."""
_REFUSALS = ("unreadable", "bad", "checksum", "mixed", "cut", "invalid", "unset", "unknown")


class Arrival(NamedTuple):
    """Arrival of a measurement or broadcast message, with one sigma of its instant; `utc_ns`
    (POSIX) if the device's stamp has a date."""

    t_arrival_ns: int
    measurement: Measurement | RawEvent
    sd_time_s: float = 0.0
    utc_ns: int | None = None


_SECTIONS: dict[str, type[Aiding]] = {
    "gnss": GnssAiding,
    "nmea": GnssAiding,
    "ubx": GnssAiding,
    "bestpos": GnssAiding,
    "sbf": GnssAiding,
    "rdss": RdssAiding,
    "wheel": WheelAiding,
    "barometer": BarometerAiding,
    "attitude": StarTrackerAiding,
    "bearing": SarAiding,
    "raw": RawAiding,
}


def source_of(kind: str, config: Config) -> str:
    """Source to which a file's measurements are assigned.

    It has the name of the file's kind (`gnss` for a receiver, `sar` for `bearing`), or else of the
    first section for that kind of measurement in the configuration. An attitude belongs to a star
    tracker if there is one and no [aiding.attitude], raw data to the section of kind `raw`.
    """
    name = "gnss" if kind in OF_A_RECEIVER else {"bearing": "sar"}.get(kind, kind)
    if name in config.aiding or kind in config.aiding:
        return name if name in config.aiding else kind
    wanted = _SECTIONS[kind]
    return next((n for n, s in config.aiding.items() if isinstance(s, wanted)), name)


def _ns(t_s: float) -> int:
    return round(t_s * 1e9)


_Read = tuple[list[Arrival], list[Rejection]]


def _arrivals(
    t_s: Array, t_arrival_s: Array, make: Callable[[int, int, int], Measurement]
) -> list[Arrival]:
    valid = np.rint(t_s * 1e9).astype(np.int64)
    arrival = np.where(np.isnan(t_arrival_s), valid, np.rint(t_arrival_s * 1e9))
    instants = zip(valid.tolist(), arrival.astype(np.int64).tolist(), strict=True)
    return [Arrival(seen, make(i, t_ns, seen)) for i, (t_ns, seen) in enumerate(instants)]


def _vector(row: list[float]) -> tuple[float, float, float] | None:
    x, y, z = row
    return None if math.isnan(x + y + z) else (x, y, z)


def _horizontal(row: list[float]) -> tuple[float, float, float | None] | None:
    x, y, z = row
    if math.isnan(x + y):
        return None
    return x, y, None if math.isnan(z) else z


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _read_gnss(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_gnss(path)
    lat, lon, height = table.lat_rad.tolist(), table.lon_rad.tolist(), table.height_m.tolist()
    quality = np.where(np.isnan(table.quality), 1, table.quality).astype(int).tolist()
    sd, v, sd_v = table.sd_position.tolist(), table.v.tolist(), table.sd_v.tolist()

    def fix(i: int, t_ns: int, seen: int) -> Measurement:
        return PositionFix(
            source,
            seen,
            MonotonicStamp(t_ns),
            lat[i],
            lon[i],
            _or_none(height[i]),
            quality=quality[i],
            sd_ned_m=_vector(sd[i]),
            v_ned_m_s=_horizontal(v[i]),
            sd_v_ned_m_s=_horizontal(sd_v[i]),
        )

    return _arrivals(table.t_s, table.t_arrival_s, fix), table.rejected


def _read_rdss(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_rdss(path)

    def fix(i: int, t_ns: int, seen: int) -> Measurement:
        return DelayedFix(
            source,
            seen,
            MonotonicStamp(t_ns),
            float(table.lat_rad[i]),
            float(table.lon_rad[i]),
            float(table.height_m[i]),
            float(table.precision_class_m[i]),
            bool(table.multi_value[i]),
        )

    return _arrivals(table.t_s, table.t_arrival_s, fix), table.rejected


def _read_attitude(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_attitude(path)

    def attitude(i: int, t_ns: int, seen: int) -> Measurement:
        roll, pitch, yaw = (float(a) for a in table.rpy[i])
        sd_roll, sd_pitch, sd_yaw = (float(a) for a in table.sd_rpy[i])
        return Attitude(
            source, seen, MonotonicStamp(t_ns), (roll, pitch, yaw), (sd_roll, sd_pitch, sd_yaw)
        )

    return _arrivals(table.t_s, table.t_arrival_s, attitude), table.rejected


def _read_bearing(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_bearing(path)

    def bearing(i: int, t_ns: int, seen: int) -> Measurement:
        azimuth, elevation = (float(a) for a in table.angles[i])
        lat, lon, height = (float(x) for x in table.point[i])
        sd_azimuth, sd_elevation = (float(s) for s in table.sd[i])
        sd = None if math.isnan(sd_azimuth) else (sd_azimuth, sd_elevation)
        stamp, point = MonotonicStamp(t_ns), (lat, lon, height)
        return Bearing(source, seen, stamp, azimuth, elevation, sd, "", point)

    return _arrivals(table.t_s, table.t_arrival_s, bearing), table.rejected


def _step_of(values: Array) -> float:
    """Rounding step of values: the smallest difference of two; 0 for too few values."""
    found = np.unique(values)
    return float(np.diff(found).min()) if len(found) >= FEWEST_VALUES else 0.0


def _read_wheel(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_wheel(path)
    seen_step = _step_of(table.speed_m_s)

    def speed(i: int, t_ns: int, seen: int) -> Measurement:
        value, step = float(table.speed_m_s[i]), _or_none(float(table.step_m_s[i]))
        r = rounded_speed(
            value, seen_step if step is None else step, "unknown" if step is None else "nearest"
        )
        return WheelSpeed(
            source,
            seen,
            MonotonicStamp(t_ns),
            r.mean_m_s,
            sd_m_s=_or_none(float(table.sd_m_s[i])),
            rounding_sd_m_s=r.sd_m_s,
            signed=r.mean_m_s == 0.0 or table.unsigned[i] != 1.0,
            shared_step_m_s=r.shared_step_m_s,
        )

    return _arrivals(table.t_s, table.t_arrival_s, speed), table.rejected


def _read_barometer(path: Path, _: ImuTable, source: str) -> _Read:
    table = read_barometer(path)

    def height(i: int, t_ns: int, seen: int) -> Measurement:
        height_m = pressure_height_m(float(table.pressure_pa[i]))
        sd_m = _or_none(float(table.sd_m[i]))
        return Height(source, seen, MonotonicStamp(t_ns), height_m, sd_m, barometric=True)

    return _arrivals(table.t_s, table.t_arrival_s, height), table.rejected


def _read_nmea(path: Path, imu: ImuTable, source: str) -> _Read:
    """Read NMEA with the decoders' default options."""
    return read_nmea_by(path, imu, receiver_of(source, Config()))


def read_nmea_by(path: Path, imu: ImuTable, by: Receiver) -> _Read:
    """Read recorded NMEA bytes. They contain UTC, so the IMU's `t_s` must be GPS second of week
    (below 604800) or POSIX seconds."""
    of_week = bool(len(imu.t_s)) and float(imu.t_s[-1]) < SECONDS_OF_WEEK
    posix = len(imu.t_s) and not of_week
    imu_s = (float(imu.t_s[0]), float(imu.t_s[-1])) if posix else None
    received, refused = read_nmea(path, imu_s, by)
    return [Arrival(each.t_ns, each.measurement, utc_ns=each.utc_ns) for each in received], refused


def _read_raw(path: Path, imu: ImuTable, source: str) -> _Read:
    """Read recorded UBX or RTCM 3 bytes, or RINEX. Epochs have GPS time, so the IMU's `t_s` must be
    GPS second of week or POSIX seconds.

    Broadcast data are known from the first epoch on, as if the receiver had been on for some
    minutes; otherwise they would be missing for half a minute or more.
    """
    from drivers.raw.decoder import RawDecoder  # noqa: PLC0415
    from fusiond.offline.receiver_logs import read_rinex, rinex_text  # noqa: PLC0415

    log = log_bytes(path)
    unpacked = rinex_text(path, log.data)
    if unpacked is not None:
        text, lost = unpacked
        rows, refused = read_rinex(path, text, imu, source)
        return rows, [*log.notes, *lost, *refused]
    decoder = RawDecoder(source, earliest=EARLIEST_DATE)
    of_week = bool(len(imu.t_s)) and float(imu.t_s[-1]) < SECONDS_OF_WEEK
    if not of_week and len(imu.t_s):
        decoder.note_utc(_ns(float(imu.t_s[0])))  # weeks of ten bits are resolved by the IMU's time
    epochs: list[Arrival] = []
    broadcast: list[RawEvent] = []
    corrections: list[Correction] = []
    for event in [*decoder.feed(log.data, 0), *decoder.flush()]:
        if isinstance(event, Correction):
            corrections.append(event)
            continue
        if not isinstance(event, RawGnssEpoch):
            broadcast.append(event)
            continue
        now = _ns(event.tow_s)
        if not of_week and isinstance(event.stamp, UtcStamp):
            now = event.stamp.utc_ns
        epochs.append(Arrival(now, replace(event, t_seen_ns=now, stamp=MonotonicStamp(now))))
    corrected = [_corrected(c, of_week) for c in corrections]
    if not epochs and corrected:
        return corrected, log.notes
    if not epochs and decoder.counters["week_unknown"]:
        raise TableError(
            f"{path}: SSR corrections say no week, nor does an IMU file in seconds of the week:"
            " append them to the file of the epochs, or give the IMU's times as POSIX time"
        )
    if not epochs:
        nothing = "no epoch of raw observations (UBX-RXM-RAWX, RTCM 3 MSM, RINEX)"
        raise TableError(f"{path}: {mistaken_log_kind(log.data) or nothing}")
    refused = [r for r in rejections_from_counts(decoder.counters) if r.reason.endswith(_REFUSALS)]
    first_ns = min(epoch.t_arrival_ns for epoch in epochs)
    known = (Arrival(first_ns, event) for event in broadcast)
    return [*known, *corrected, *epochs], [*log.notes, *refused]


def _corrected(correction: Correction, of_week: bool) -> Arrival:
    """Arrival of a correction: the instant of its epoch less half an interval."""
    c = correction
    tow_s = c.tow_s - (0.5 * c.interval_s if c.interval_s > 1.0 else 0.0)
    now = _ns(tow_s) if of_week else utc_ns(c.week, tow_s, leap_seconds(c.week, tow_s))
    return Arrival(now, replace(c, t_seen_ns=now))


READERS: dict[str, Callable[[Path, ImuTable, str], _Read]] = {
    "gnss": _read_gnss,
    "rdss": _read_rdss,
    "attitude": _read_attitude,
    "bearing": _read_bearing,
    "wheel": _read_wheel,
    "barometer": _read_barometer,
    "nmea": _read_nmea,
    "raw": _read_raw,
}
