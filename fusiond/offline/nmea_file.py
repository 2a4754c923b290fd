"""Reader of NMEA files by the daemon's decoders: `--aid nmea=FILE`.

The receiver's decoder has the options of its source in the configuration, so the file is read like
the daemon's line: fixes, headings and attitudes of its antennas. HDG, HDM and HDT of other talkers
belong to a compass, and are used if one is configured; so is any HDT in a file without a receiver.

A file has no arrival times, so a measurement arrives at its instant of validity. A sentence without
a time belongs to the preceding epoch; several of one kind in an epoch are spread evenly over it:

    t = t_epoch + (k / n) (t_next - t_epoch),    k = 0 ... n - 1
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from datetime import date
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from drivers.measurements import (
    ArrivalStamp,
    Measurement,
    MonotonicStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.compass import CompassDecoder, CompassDecoding
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.nmea.driver import REFUSALS
from drivers.nmea.epoch_assembly import TALKERS
from fusiond.configuration.aiding import CompassAiding
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import Rejection, TableError, rejections_from_counts
from fusiond.files.log_bytes import log_bytes
from fusiond.files.mistaken_log_kind import mistaken_log_kind
from fusiond.navigation.gps_time import utc_ns_to_gps_week_seconds
from fusiond.offline.week_rollover import rollover_of

# Earliest date: the end of selective availability, before which fixes were too poor to be of use.
EARLIEST_DATE = date(2000, 5, 1)
_COMPASS = re.compile(
    rb"\$(?:[A-Z]{2}HD[GM]|(?!(?:%s)HDT)[A-Z]{2}HDT)," % "|".join(sorted(TALKERS)).encode()
)
"""HDT of another talker than a receiver's is a gyrocompass' (HE)."""
_POSITION = re.compile(rb"\$[A-Z]{2}(?:GGA|GNS|RMC|GLL),")
_TIMED = re.compile(rb"\$[A-Z]{2}(?:(?:GGA|GNS|RMC|ZDA),|GLL,(?:[^,]*,){4})(?P<time>\d{6}[\d.]*),")
_LEFT_OUT = ("_refused", "_implausible", "no_fix", "checksum_bad", "bad_field")
"""Endings of counters of refusals, beside `REFUSALS`."""


class Receiver(NamedTuple):
    """Sources of the sentences by the configuration: names and options of the receiver, and of a
    compass, if any."""

    source: str
    decoding: NmeaDecoding
    compass: str | None = None
    compass_decoding: CompassDecoding | None = None


class Received(NamedTuple):
    """Measurement with its instant of validity, on the IMU's time axis and in UTC (ns)."""

    t_ns: int
    measurement: Measurement
    utc_ns: int


def receiver_of(source: str, config: Config) -> Receiver:
    """Sources of the configuration that deliver NMEA."""
    points = driver_entry_points()
    decoding: NmeaDecoding | None = None
    compass: str | None = None
    compass_decoding: CompassDecoding | None = None
    for name, section in config.sources.items():
        options = points[section.driver].load().Options(**section.options)
        if isinstance(options, NmeaDecoding) and (decoding is None or name == source):
            decoding = options
        elif isinstance(options, CompassDecoding) and compass is None:
            compass, compass_decoding = name, options
    if compass is None:
        compass = next((n for n, s in config.aiding.items() if isinstance(s, CompassAiding)), None)
    read = decoding or NmeaDecoding()
    earliest = min(read.earliest_date, EARLIEST_DATE)
    decoding = read.model_copy(update={"earliest_date": earliest})
    return Receiver(source, decoding, compass, compass_decoding)


def read_nmea(
    path: Path, imu_s: tuple[float, float] | None, by: Receiver
) -> tuple[list[Received], list[Rejection]]:
    """Read measurements in the file's order. Times are POSIX, like the IMU's range `imu_s`, or GPS
    second of week if that is None. Notes state how to improve the receiver's output.

    Raises `TableError` for a file without a single measurement, with the reason.
    """
    decoder = NmeaDecoder(by.source, by.decoding)
    log = log_bytes(path)
    lines = log.data.splitlines(keepends=True)
    receiver: list[Any] = _fed(decoder, enumerate(lines))
    receiver += decoder.flush()
    refused = Counter(decoder.counters)
    of_compass = [(k, line) for k, line in enumerate(lines) if _COMPASS.search(line)]
    untimed: list[Any] = []
    if by.compass is not None:
        compass = CompassDecoder(
            by.compass, by.compass_decoding or CompassDecoding.model_validate({}), Counter()
        )
        if not any(map(_POSITION.search, lines)):  # then HDT is not the receiver's
            of_compass = list(enumerate(lines))
            receiver = [m for m in receiver if isinstance(m, TimeReport)]
        untimed += _fed(compass, of_compass)
        refused.update({name: compass.counters[name] for name in ("bad_field", "no_heading")})
    elif of_compass:
        refused["compass_not_configured"] += len(of_compass)
    epochs = _Epochs(lines, receiver)
    found: list[tuple[int, Any]] = []
    for m in receiver:
        if isinstance(m, TimeReport):
            continue
        if isinstance(m.stamp, UtcStamp):
            found.append((m.stamp.utc_ns, m))
        elif isinstance(m.stamp, ArrivalStamp):
            untimed.append(m)
        else:
            refused["undated"] += 1
    found += epochs.spread(untimed)
    refused["untimed"] += 0 if epochs.times else len(untimed)
    if not found:
        raise TableError(f"{path}: {_why_nothing(decoder, refused, mistaken_log_kind(log.data))}")
    add_ns, said = rollover_of([utc_ns for utc_ns, _ in found], imu_s)
    of_week = imu_s is None
    in_order = sorted(found, key=lambda each: each[0])
    received = [_received(utc_ns + add_ns, m, of_week) for utc_ns, m in in_order]
    cautions = decoder.cautions
    cautions.pop("compass_left_out", None)  # used here, or counted
    notes = [Rejection(0, *note, 0) for note in (*cautions.items(), *said)]
    return received, [
        *log.notes,
        *notes,
        *(r for r in rejections_from_counts(refused) if _is_refusal(r.reason)),
    ]


def _fed(decoder: NmeaDecoder | CompassDecoder, lines: Iterable[tuple[int, bytes]]) -> list[Any]:
    """Measurements of the lines; the arrival of each is its line number."""
    return [m for number, line in lines for m in decoder.feed(line, number)]


class _Epochs:
    """First lines of epochs, and the epochs' instants (UTC, ns)."""

    def __init__(self, lines: list[bytes], measurements: Iterable[Any]) -> None:
        begins = _begins(lines)
        places: dict[int, int] = {}
        for m in measurements:
            utc_ns = m.utc_ns if isinstance(m, TimeReport) else getattr(m.stamp, "utc_ns", None)
            if utc_ns is not None:
                k = max(0, bisect_right(begins, m.t_seen_ns) - 1)
                places[begins[k] if begins else m.t_seen_ns] = utc_ns
        self._lines = sorted(places)
        self.times = [places[line] for line in self._lines]

    def spread(self, untimed: list[Any]) -> list[tuple[int, Any]]:
        """Stamp measurements without time by the epochs' instants, less the stated latency."""
        if not self.times:
            return []
        found: list[tuple[int, Any]] = []
        for _, of_kind in groupby(sorted(untimed, key=_kind), _kind):
            for k, group in groupby(of_kind, lambda m: bisect_right(self._lines, m.t_seen_ns)):
                within = list(group)
                begin = self.times[max(0, k - 1)]
                end = self.times[min(k, len(self.times) - 1)]
                step = max(0, end - begin) // len(within)
                for i, m in enumerate(within):
                    latency_ns = round(m.stamp.latency_s * 1e9)
                    found.append((begin + i * step - latency_ns, m))
        return found


def _begins(lines: list[bytes]) -> list[int]:
    """Lines that begin an epoch: the first one of each time."""
    found: list[int] = []
    last = b""
    for number, line in enumerate(lines):
        timed = _TIMED.search(line)
        if timed is not None and timed["time"] != last:
            last = timed["time"]
            found.append(number)
    return found


def _kind(m: Measurement) -> tuple[str, str]:
    return m.source, type(m).__name__


def _received(utc_ns: int, m: Any, of_week: bool) -> Received:
    t_ns = round(utc_ns_to_gps_week_seconds(utc_ns) * 1e9) if of_week else utc_ns
    return Received(t_ns, replace(m, t_seen_ns=t_ns, stamp=MonotonicStamp(t_ns)), utc_ns)


def _is_refusal(name: str) -> bool:
    known = {"undated", "untimed", "compass_not_configured", "no_heading"}
    return name in REFUSALS or name in known or name.endswith(_LEFT_OUT)


def _why_nothing(decoder: NmeaDecoder, refused: Counter[str], kind: str) -> str:
    """Reason why the file has no measurements; `kind` is its probable kind."""
    if refused["undated"] or refused["untimed"]:
        absent = "that of RMC is empty" if decoder.received.used["RMC"] else "RMC or ZDA missing"
        cautions = decoder.cautions
        known = (cautions[name] for name in ("implausible_date", "bad_date") if name in cautions)
        return next(known, f"no measurement with a date ({absent})")
    if not decoder.counters["sentences"]:
        return kind or decoder.cause or "no NMEA sentence whose checksum is right"
    name = max(REFUSALS, key=lambda each: refused[each])
    if refused[name]:
        return REFUSALS[name]
    if refused["compass_not_configured"]:
        return "headings of a compass alone, and the configuration has none ([aiding.compass])"
    return decoder.cause
