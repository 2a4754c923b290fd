"""Reader of receivers' logs (UBX-NAV, BESTPOS, SBF, RINEX) as measurements with arrivals."""

from __future__ import annotations

import codecs
import importlib
import importlib.resources
import subprocess
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from drivers.bestpos.decoder import BestposDecoder
from drivers.decoder_options import SolutionDecoding
from drivers.measurements import Heading, Measurement, MonotonicStamp, PositionFix, UtcStamp
from drivers.nmea.unsupported_protocols import protocol_sentence
from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    NavigationMessage,
    RawGnssEpoch,
    SignalDelays,
)
from drivers.raw.rinex import (
    COMPRESSED_LABEL,
    FIRST_LABEL,
    LABEL,
    ObservationReader,
    RinexError,
    version_and_type,
)
from drivers.raw.rinex2_to_3 import as_version_3
from drivers.raw.rinex_nav import Broadcast, navigation
from drivers.raw.weeks import GPS_EPOCH_S, WEEK_S, leap_seconds
from drivers.sbf.decoder import SbfDecoder
from drivers.solution import REFUSALS
from drivers.ubx.decoder import UbxDecoder
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import (
    MissingPackageError,
    Rejection,
    TableError,
    rejections_from_counts,
)
from fusiond.files.install_extra import install_command
from fusiond.files.log_bytes import log_bytes
from fusiond.files.measurement_csv import ImuTable
from fusiond.files.mistaken_log_kind import mistaken_log_kind
from fusiond.navigation.gps_time import utc_ns_to_gps_week_seconds
from fusiond.offline.measurement_files import SECONDS_OF_WEEK, Arrival
from fusiond.offline.nmea_file import EARLIEST_DATE

Read = tuple[list[Arrival], list[Rejection]]


class _Decoder(Protocol):
    counters: Counter[str]

    @property
    def refusal(self) -> str: ...

    @property
    def cautions(self) -> dict[str, str]: ...

    def feed(self, data: bytes, t_seen_ns: int) -> Sequence[Measurement]: ...

    def flush(self) -> Sequence[Measurement]: ...


_DECODERS: dict[str, Callable[[str, SolutionDecoding], _Decoder]] = {
    "ubx": UbxDecoder,
    "bestpos": BestposDecoder,
    "sbf": SbfDecoder,
}
_NAMES = {
    "ubx": "UBX navigation message (UBX-NAV-PVT)",
    "bestpos": "log of the BESTPOS family (#BESTPOSA, #BESTNAVA)",
    "sbf": "SBF position (PVTGeodetic)",
}
_USED = frozenset(
    {"epochs", "fixes", "headings", "sentences", "ubx_frames", "rtcm_frames", "nav_messages"}
    | {"relposned", "logs", "logs_used", "sbf_blocks", "blocks_used", "garbage_bytes"}
    | {"other_bytes", "ubx_not_used", "logs_not_used", "blocks_not_used", "velocity_latent"}
)
"""Counters of used items and of items that are not fixes; all others are refusals."""
_COMPRESSED = (b"\x1f\x9d", b"PK", b"BZ")
"""Packings of RINEX files but gzip: compress, zip, bzip2."""


def decoding_of(source: str, config: Config) -> SolutionDecoding:
    """Options of the configured receiver, as in the daemon, but for a log of any date."""
    points = driver_entry_points()
    found: dict[str, Any] = {}
    for name, section in config.sources.items():
        options = points[section.driver].load().Options(**section.options)
        fields = set(type(options).model_fields)
        if set(SolutionDecoding.model_fields) <= fields and (not found or name == source):
            found = {key: getattr(options, key) for key in SolutionDecoding.model_fields}
    return SolutionDecoding(**{**found, "earliest_date": EARLIEST_DATE})


def read_solutions(
    kind: str, path: Path, imu: ImuTable, source: str, decoding: SolutionDecoding
) -> Read:
    """Read fixes and headings in a receiver's own protocol. They contain UTC, so the IMU's `t_s`
    must be GPS second of week or POSIX seconds. TableError without a fix."""
    decoder = _DECODERS[kind](source, decoding)
    log = log_bytes(path)
    found = [*decoder.feed(log.data, 0), *decoder.flush()]
    of_week = is_of_week(imu)
    rows = []
    undated = 0
    for m in found:
        if not isinstance(m, PositionFix | Heading):
            continue
        if not isinstance(m.stamp, UtcStamp):
            undated += 1
            continue
        utc_ns = t_ns = m.stamp.utc_ns
        if of_week:
            t_ns = round(utc_ns_to_gps_week_seconds(utc_ns) * 1e9)
        valid = replace(m, t_seen_ns=t_ns, stamp=MonotonicStamp(t_ns))
        rows.append(Arrival(t_ns, valid, utc_ns=utc_ns))
    if not rows:
        if why := REFUSALS.get(decoder.refusal):
            raise TableError(f"{path}: no fix: {why}")
        other = mistaken_log_kind(log.data) or protocol_sentence(log.data)
        raise TableError(f"{path}: {other or f'no {_NAMES[kind]}'}")
    refused = {name: n for name, n in decoder.counters.items() if name not in _USED}
    notes = [Rejection(0, *note, 0) for note in decoder.cautions.items()]
    return rows, [*log.notes, *notes, *rejections_from_counts({**refused, "undated": undated})]


def is_of_week(imu: ImuTable) -> bool:
    """True if the IMU's times are seconds of a week."""
    return bool(len(imu.t_s)) and float(imu.t_s[-1]) < SECONDS_OF_WEEK


# --------------------------------------------------------------------------- RINEX


_LINE = 200
"""Longest first line, in characters."""


def rinex_text(path: Path, data: bytes) -> tuple[str, list[Rejection]] | None:
    """Text of a RINEX file, unpacked (Hatanaka, compress, zip), and a text on lost data; None for
    any other file. MissingPackageError, TableError."""
    data = data.removeprefix(codecs.BOM_UTF8).lstrip(b"\r\n")
    first = data[:_LINE].partition(b"\n")[0].decode("ascii", "replace")
    label = first[LABEL].strip()
    packed = label == COMPRESSED_LABEL or data.startswith(_COMPRESSED)
    if FIRST_LABEL.casefold() in first.casefold() and label != FIRST_LABEL and not packed:
        raise TableError(
            f"{path}: the first line of this RINEX file has its label elsewhere than from column "
            "61 on, or in small letters: it has been edited, take it as it was written"
        )
    if label == FIRST_LABEL:
        return data.decode("ascii", "replace"), []
    if not packed:
        return None
    try:
        hatanaka: Any = importlib.import_module("hatanaka")
    except ImportError as error:
        raise MissingPackageError(
            f"{path}: RINEX packed by Hatanaka's or another way needs the package hatanaka: "
            f"{install_command('rinex')}"
        ) from error
    try:
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always")
            text = str(hatanaka.decompress(data).decode("ascii", "replace"))
        return text, [Rejection(0, "damaged", _said(doubt), 0) for doubt in doubts]
    except Exception as error:  # it passes on errors of zip, ncompress and crx2rnx
        text = _before_damage(data) if label == COMPRESSED_LABEL else ""
        if not text:
            raise TableError(f"{path}: cannot be unpacked as RINEX ({error})") from error
        why = str(error).partition(".")[0]
        return text, [Rejection(0, "file_cut", f"used up to the damage: {why}", 0)]


def _said(doubt: warnings.WarningMessage) -> str:
    """Unpacking program's message on omitted data, in one line."""
    return f"the unpacking says: {' '.join(str(doubt.message).split())}"


def _before_damage(data: bytes) -> str:
    """Epochs of a damaged Hatanaka file that the unpacking program has written before the damage;
    "" without any."""
    program = importlib.resources.files("hatanaka.bin") / "crx2rnx"
    with importlib.resources.as_file(program) as path:
        done = subprocess.run([path, "-"], input=data, capture_output=True, check=False)
    text = done.stdout.decode("ascii", "replace")
    return text[: text.rfind("\n") + 1] if "\n>" in text or "END OF HEADER" in text else ""


def read_rinex(path: Path, text: str, imu: ImuTable, source: str) -> Read:
    """Read epochs of an observation file, or messages of a navigation file.

    An ephemeris arrives when it was sent, but the first of each satellite is known from the start,
    as if the receiver had been on before. TableError for any other file."""
    counters = Counter[str]()
    try:
        text = as_version_3(text)
        if version_and_type(text)[1] == "N":
            rows = _broadcast(navigation(source, text, counters), imu)
        else:
            rows = [_arrival(e, imu) for e in ObservationReader(source, text, counters).epochs()]
    except RinexError as error:
        raise TableError(f"{path}: {error}") from None
    if not rows:
        raise TableError(f"{path}: a RINEX file without a record that is read")
    taken = ("epochs_raw", "ephemerides", "ionospheres", "events_passed")
    refused = {
        name: n
        for name, n in counters.items()
        if name not in taken and not name.startswith("measured_")
    }
    return rows, rejections_from_counts(refused)


def _arrival(epoch: RawGnssEpoch, imu: ImuTable) -> Arrival:
    now = round(epoch.tow_s * 1e9)
    if not is_of_week(imu) and isinstance(epoch.stamp, UtcStamp):
        now = epoch.stamp.utc_ns
    return Arrival(now, replace(epoch, t_seen_ns=now, stamp=MonotonicStamp(now)))


def _kind(message: NavigationMessage) -> tuple[str, str]:
    """Key of a message, by which a later one replaces it: satellite and message, or ionosphere
    model."""
    if isinstance(message, Correction):
        return message.satellite, message.part
    if isinstance(message, Ephemeris):
        return message.satellite, message.message
    if isinstance(message, SignalDelays):
        return message.satellite, "delays"
    return ("C", "bdgim") if isinstance(message, Bdgim) else (message.system, "")


def _broadcast(records: list[Broadcast], imu: ImuTable) -> list[Arrival]:
    start_ns = round(float(imu.t_s[0]) * 1e9) if len(imu.t_s) else 0
    of_week = is_of_week(imu)
    known = set[tuple[str, str]]()
    rows = []
    for gps_s, message in sorted(records, key=lambda r: r.gps_s):
        week, tow_s = divmod(gps_s, WEEK_S)
        t_s = tow_s if of_week else gps_s + GPS_EPOCH_S - leap_seconds(int(week), tow_s)
        kind = _kind(message)
        t_ns = start_ns if kind not in known else max(start_ns, round(t_s * 1e9))
        known.add(kind)
        rows.append(Arrival(t_ns, message))
    return rows
