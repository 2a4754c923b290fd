"""Input of a run: samples and measurements from files or a recorded bus, in order of arrival."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.measurements import ImuSample, Measurement, MonotonicStamp
from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    Klobuchar,
    RawEvent,
    RawGnssEpoch,
    SignalDelays,
    System,
)
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import Rejection, TableError, rejection_counts
from fusiond.files.measurement_csv import ImuTable, read_imu
from fusiond.offline.failure_reasons import FileRead
from fusiond.offline.measurement_files import (
    OF_A_RECEIVER,
    READERS,
    Arrival,
    read_nmea_by,
    source_of,
)
from fusiond.offline.nmea_file import receiver_of
from fusiond.offline.outages import Outage, named, withheld


@dataclass(slots=True)
class Recorded:
    """Input with its files; `withheld` measurements by source."""

    config: Config
    imu: ImuTable
    arrivals: list[Arrival]
    files: dict[str, FileRead]
    events: list[dict[str, str]]
    withheld: Counter[str]
    units: list[tuple[int, ImuSample]]
    """Samples of all inertial units if one is a spare; else none."""


def read_recorded(
    config: Config,
    imu_path: Path | None,
    measurements: list[tuple[str, Path]],
    outages: Sequence[Outage],
    systems: tuple[System, ...] | None,
    can_log: Path | None,
) -> Recorded:
    """Read the input without the measurements of outages. Raises as
    `fusiond.offline.process.process` does."""
    if any(kind == "raw" for kind, _ in measurements):
        config = _with_raw(config, systems)
    events: list[dict[str, str]] = []
    arrivals: list[Arrival] = []
    files: dict[str, FileRead] = {}
    units: list[tuple[int, ImuSample]] = []
    if can_log is not None:
        # Import python-can and the DBC reader only for a recorded bus.
        from fusiond.offline.can_through_drivers import read_can_log  # noqa: PLC0415

        log = read_can_log(can_log, config)
        imu, arrivals, units = log.imu, log.arrivals, log.units
        events += [{"code": code, "text": text} for code, text in log.events]
        files["imu"] = _imu_read(imu)
        for name, rejected in log.rejected.items():
            rows = [row for row in arrivals if row.measurement.source == name]
            used = (
                log.frames - sum(rejection_counts(rejected).values())
                if name == "can"
                else len(rows)
            )
            if used or rejected:
                files[name] = FileRead(_span_s(rows), max(0, used), rejected, name != "can")
    else:
        assert imu_path is not None
        imu = read_imu(imu_path)
        files["imu"] = _imu_read(imu)
    for kind, path in measurements:
        rows, rejected = _read_measurement(kind, path, imu, config)
        name = kind if kind not in files else f"{kind}:{path.name}"
        files[name] = FileRead(_span_s(rows), len(rows), rejected)
        arrivals += rows
    _check_observed(measurements, arrivals)
    held = Counter[str]()
    if outages:
        there = {row.measurement.source for row in arrivals}
        unknown = sorted(named(outages) - there - set(config.sources))
        if unknown:
            known = ", ".join(sorted(there))
            raise TableError(
                f"outage of {unknown[0]}: no measurement comes from it; there are {known}"
            )
        kept = [row for row in arrivals if not _withheld(row.measurement, outages)]
        held += Counter(row.measurement.source for row in arrivals)
        held -= Counter(row.measurement.source for row in kept)
        arrivals = kept
    arrivals.sort(key=lambda a: a.t_arrival_ns)
    return Recorded(config, imu, arrivals, files, events, held, units)


def _check_observed(measurements: list[tuple[str, Path]], arrivals: list[Arrival]) -> None:
    """Check raw data for observations. Raises `TableError`."""
    raw = [path for kind, path in measurements if kind == "raw"]
    if raw and not any(isinstance(row.measurement, RawGnssEpoch) for row in arrivals):
        names = ", ".join(map(str, raw))
        raise TableError(
            f"{names}: what satellites broadcast, and no observation: give that file as well, with "
            "--aid raw=FILE"
        )


def _read_measurement(
    kind: str, path: Path, imu: ImuTable, config: Config
) -> tuple[list[Arrival], list[Rejection]]:
    source = source_of(kind, config)
    if kind == "nmea":
        return read_nmea_by(path, imu, receiver_of(source, config))
    if kind in OF_A_RECEIVER:  # import their decoders only for such a file
        from fusiond.offline.receiver_logs import decoding_of, read_solutions  # noqa: PLC0415

        return read_solutions(kind, path, imu, source, decoding_of(source, config))
    return READERS[kind](path, imu, source)


BROADCAST = Ephemeris, Klobuchar, Bdgim, SignalDelays, Correction
"""Navigation messages are valid at no instant. (A union would be made anew at each question.)"""


def valid_ns(m: Measurement | RawGnssEpoch) -> int:
    """Instant of validity of a recorded measurement, by the IMU's clock."""
    stamp = getattr(m, "stamp", None)
    assert isinstance(stamp, MonotonicStamp)
    return stamp.t_ns


def _imu_read(imu: ImuTable) -> FileRead:
    span_s = (float(imu.t_s[0]), float(imu.t_s[-1])) if len(imu.t_s) else None
    return FileRead(span_s, len(imu.t_s), imu.rejected)


def _with_raw(config: Config, systems: tuple[System, ...] | None) -> Config:
    """Configuration with a section for a raw file's data, and the requested systems."""
    name = source_of("raw", config)
    section = config.aiding.get(name)
    raw = section if isinstance(section, RawAiding) else RawAiding()
    if systems is not None:
        raw = raw.model_copy(update={"systems": systems})
    return config.model_copy(update={"aiding": {**config.aiding, name: raw}})


def _span_s(rows: list[Arrival]) -> tuple[float, float] | None:
    """First and last instant (s) of the measurements, or of the arrivals in a file of broadcast
    messages, which have no instants."""
    instants = [
        valid_ns(row.measurement) for row in rows if not isinstance(row.measurement, BROADCAST)
    ] or [row.t_arrival_ns for row in rows]
    return (min(instants) * 1e-9, max(instants) * 1e-9) if instants else None


def _withheld(m: Measurement | RawEvent, outages: Sequence[Outage]) -> bool:
    if isinstance(m, BROADCAST):
        return False
    return withheld(m.source, valid_ns(m) * 1e-9, outages)
