"""`fusiond simulate`: a scenario as the CSV files that `fusiond process` and `compare` read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusiond.files.fixed_decimal import MAX_CELL, format_rows
from fusiond.simulation.barometer import BAROMETER_COLUMNS, Barometer, barometer_stream
from fusiond.simulation.gnss.raw import GnssRaw
from fusiond.simulation.gnss.raw_stream import GnssRawStream, RawFormat
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssCentre
from fusiond.simulation.scenarios import Scenario, random_streams
from fusiond.simulation.star_tracker_radar import sensor_tables

Array = NDArray[np.float64]

TRUTH_RATE_HZ = 20.0
"""Rows of truth.csv a second: a line between two of them is 1.6 mm off at 5 m/s^2."""
_NO_LABELS = np.zeros((1, 1), dtype=np.uint8)
_CHUNK_ROWS = 4096

# Decimals: 1 us, 0.1 mm (1e-9 deg), 0.1 mm/s, 2e-5 deg/h, 1e-9 m/s^2.
_TIME = ("t_s", 6)
_PLACE = (("lat_deg", 9), ("lon_deg", 9), ("height_m", 4))
_V = tuple((f"v_{axis}_m_s", 5) for axis in "ned")
_IMU = (
    _TIME,
    *((f"gyro_{axis}_rad_s", 9) for axis in "xyz"),
    *((f"accel_{axis}_m_s2", 8) for axis in "xyz"),
)
_GNSS = (
    _TIME,
    ("t_arrival_s", 6),
    *_PLACE,
    ("quality", 0),
    ("satellites", 0),
    *((f"sd_{axis}_m", 4) for axis in "ned"),
    *_V,
    *((f"sd_v{axis}_m_s", 4) for axis in "ned"),
)
_RDSS = (_TIME, ("t_arrival_s", 6), *_PLACE, ("precision_class_m", 0), ("multi_value", 0))
_TRUTH = (_TIME, *_PLACE, *_V, *((f"{angle}_deg", 7) for angle in ("roll", "pitch", "yaw")))


@dataclass(frozen=True, slots=True)
class Simulated:
    """Files written, and the number of rows of each without the header (epochs of a raw stream)."""

    scenario: str
    seed: int
    duration_s: float
    files: dict[str, Path]
    rows: dict[str, int]


def simulate(
    scenario: Scenario,
    out_dir: Path,
    seed: int = 0,
    duration_s: float | None = None,
    *,
    gnss_raw: RawFormat | None = None,
) -> Simulated:
    """Write imu.csv, gnss.csv, rdss.csv and truth.csv into `out_dir`, created on demand;
    attitude.csv, bearing.csv and barometer.csv for a star tracker, radar and barometer on board.

    With `gnss_raw` also the receiver's raw stream, gnss.ubx or gnss.rtcm3. The same scenario, seed
    and duration write the same bytes. `t_s` counts from the start of the trajectory, which is the
    start of a GPS week in the raw stream (`gnss_raw.START`). Raises OSError where the files cannot
    be written.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    imu_rng, gnss_rng, rdss_rng, raw_rng = random_streams(seed)
    truth = scenario.truth(duration_s)
    imu = scenario.imu_output(truth, imu_rng)
    stamps = truth.t_s[1:] - scenario.imu.time_offset_s
    tables = {
        "imu": (_IMU, np.column_stack((stamps, imu.gyro, imu.accel))),
        "gnss": (_GNSS, _gnss_rows(GnssReceiver(truth, scenario.gnss, gnss_rng))),
        "rdss": (_RDSS, _rdss_rows(truth, scenario, rdss_rng)),
        "truth": (_TRUTH, truth_rows(truth)),
        **sensor_tables(truth, scenario.star_tracker, scenario.sar, seed),
    }
    if scenario.barometer is not None:
        barometer = Barometer(truth, scenario.barometer, barometer_stream(seed))
        tables["barometer"] = (BAROMETER_COLUMNS, barometer.rows)
    files = {name: out_dir / f"{name}.csv" for name in tables}
    for name, (columns, rows) in tables.items():
        _write(files[name], columns, rows)
    count = {name: len(rows) for name, (_, rows) in tables.items()}
    if gnss_raw is not None:
        files["raw"] = out_dir / f"gnss.{gnss_raw}"
        stream = GnssRawStream(GnssRaw(truth, scenario.gnss_raw, raw_rng), gnss_raw)
        count["raw"] = len(stream.receiver)
        with files["raw"].open("wb") as raw_file:
            for k in range(len(stream.receiver)):
                raw_file.write(stream.bytes_of(k))
    return Simulated(scenario.name, seed, truth.duration_s, files, count)


def write_truth(path: Path, truth: Truth) -> None:
    """Write truth.csv. Raises OSError."""
    _write(path, _TRUTH, truth_rows(truth))


def truth_rows(truth: Truth) -> Array:
    """Rows of truth.csv at `TRUTH_RATE_HZ`."""
    t = np.arange(math.floor(truth.duration_s * TRUTH_RATE_HZ + 1e-9) + 1) / TRUTH_RATE_HZ
    states = truth.at(t)
    rpy = np.degrees(states.rpy)
    rpy[:, 2] = (rpy[:, 2] + 180.0) % 360.0 - 180.0
    place = np.column_stack((np.degrees(states.position[:, :2]), states.position[:, 2]))
    return np.column_stack((t, place, states.v_ned, rpy))


def _gnss_rows(receiver: GnssReceiver) -> Array:
    ok = receiver.valid
    n = int(np.count_nonzero(ok))
    position, o = receiver.position[ok], receiver.options
    return np.column_stack(
        (
            receiver.t_s[ok],
            receiver.t_arrival_s[ok],
            np.degrees(position[:, :2]),
            position[:, 2],
            np.tile((o.quality, o.satellites, *receiver.sd_ned_m), (n, 1)),
            receiver.v_ned[ok],
            np.tile(receiver.sd_v_ned_m_s, (n, 1)),
        )
    )


def _rdss_rows(truth: Truth, scenario: Scenario, rng: np.random.Generator) -> Array:
    """Rows of RDSS fixes, requested as a host may: as soon as the card allows, after the previous
    fix, and after a command and its reply."""
    o = scenario.rdss
    centre = RdssCentre(truth, o, rng)
    spacing = o.service_frequency_s + 2.0 * o.reply_s
    rows = []
    at_s = spacing
    while at_s <= truth.duration_s:
        asked_s, at_s = at_s, at_s + spacing
        if centre.dropped():
            continue
        fix = centre.fix(asked_s, None)
        at_s = max(at_s, fix.t_arrival_s + 2.0 * o.reply_s)
        if fix.t_arrival_s <= truth.duration_s:
            rows.append(
                (
                    fix.t_s,
                    fix.t_arrival_s,
                    fix.lat_deg,
                    fix.lon_deg,
                    fix.height_m,
                    fix.precision_class_m,
                    fix.multi_value,
                )
            )
    return np.array(rows, dtype=np.float64).reshape(-1, len(_RDSS))


def _write(path: Path, columns: tuple[tuple[str, int], ...], rows: Array) -> None:
    decimals = np.array([digits for _, digits in columns], dtype=np.int64)
    buffer = np.empty(_CHUNK_ROWS * (MAX_CELL * len(columns) + 2), dtype=np.uint8)
    with path.open("wb") as stream:
        stream.write((",".join(name for name, _ in columns) + "\n").encode("ascii"))
        for start in range(0, len(rows), _CHUNK_ROWS):
            part = np.ascontiguousarray(rows[start : start + _CHUNK_ROWS])
            codes = np.zeros(len(part), dtype=np.int64)
            size = format_rows(part, decimals, codes, _NO_LABELS, buffer)
            # `format_rows` puts a comma before the label, which is empty here.
            stream.write(buffer[:size].tobytes().replace(b",\n", b"\n"))
