"""Figures of one drive through the navigator, as a row.

A log is a recording of the daemon (`.mcap`, or a folder with the parts of one), a recorded CAN bus,
or a folder with the tables of `fusiond process`: `imu.csv` and, as far as they are there,
`gnss.csv`, `rdss.csv`, `attitude.csv`, `bearing.csv`, `wheel.csv`, `barometer.csv`, `gnss.nmea`,
`gnss.ubx` or `gnss.rtcm3`; with a `truth.csv` the row has the errors, too.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fusiond.navigator.raw_gnss  # noqa: F401 - compiled before there are workers
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import TableError
from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.files.resumable_parquet import Row, flattened
from fusiond.offline.compare import NothingToCompareError, compare
from fusiond.offline.measurement_files import READERS
from fusiond.offline.process import process

MEASUREMENT_FILES = {
    **{f"{kind}.csv": kind for kind in READERS if kind not in ("nmea", "raw")},
    "gnss.nmea": "nmea",
    "gnss.ubx": "raw",
    "gnss.rtcm3": "raw",
}
IMU, TRUTH = "imu.csv", "truth.csv"
# Of a replay's summary: what took time differs from run to run, what compares bits with the log's
# has nothing to compare where the configuration is another.
_NOT_OF_THE_DRIVE = frozenset(
    ("times_real_time", "compared", "identical", "first_difference", "differing_ticks")
)


def drive_row(config_path: Path, log: Path) -> Row:
    """Figures of one log, flat; parts of a name are joined by dots.

    `not_navigated` says why there is no solution. Errors of the readers pass.
    """
    if not log.exists():
        raise FileNotFoundError(f"{log}: there is none")
    recording = sorted(log.glob("*.mcap")) if log.is_dir() else [log]
    if recording and recording[0].suffix == ".mcap":
        return {"kind": "recording", **_recording(config_path, recording)}
    if not log.is_dir():
        return {"kind": "can", **_processed(process(_config(config_path), None, [], can_log=log))}
    if not (log / IMU).exists():
        raise TableError(f"{log}: neither {IMU} nor a recording in it")
    return {"kind": "tables", **_tables(_config(config_path), log)}


@lru_cache(maxsize=1)
def _config(path: Path) -> Config:
    return load_config(path)


def _recording(config_path: Path, files: list[Path]) -> Row:
    # The daemon's parts come only where there is a recording.
    from fusiond.replay.replay_output import ReplayOptions, replay  # noqa: PLC0415

    summary = replay(files, ReplayOptions(config=config_path))
    problems = [*summary.pop("problems"), *summary.pop("driver_faults")]
    figures = {k: v for k, v in summary.items() if k not in _NOT_OF_THE_DRIVE}
    row = flattened({"modes": figures.pop("modes"), **figures})
    return row | ({"problems": "\n".join(map(str, problems))} if problems else {})


def _tables(config: Config, folder: Path) -> Row:
    measurements = [
        (kind, folder / name)
        for name, kind in MEASUREMENT_FILES.items()
        if (folder / name).exists()
    ]
    if not (folder / TRUTH).exists():
        return _processed(process(config, folder / IMU, measurements))
    with TemporaryDirectory(prefix="fusiond-batch-") as made:
        out = Path(made) / "solution.csv"
        result = process(config, folder / IMU, measurements, out=out)
        row = _processed(result)
        if not result["solution_rows"]:
            return row
        try:
            errors = compare(read_solution(out), read_truth(folder / TRUTH))
        except NothingToCompareError as error:
            return row | {"not_compared": str(error)}
    said = {k: v for k, v in errors.items() if not k.startswith(("expected_", "t_"))}
    return row | flattened({"error": said})


def _processed(result: dict[str, Any]) -> Row:
    """Figures of a run of `process`."""
    rows = result["solution_rows"]
    files = result["files"]
    return flattened(
        {
            "samples": files["imu"]["rows"],
            "rejected_rows": sum(sum(f["rejected"].values()) for f in files.values()),
            "solution_rows": rows,
            "solution_from_s": result["solution_from_s"],
            "not_navigated": result["why"],
            "modes": {mode: count / rows for mode, count in result["solution_modes"].items()},
            "outcomes": result["sources"],
            "consistency": {n: report["verdict"] for n, report in result["consistency"].items()},
            "events": len(result["events"]),
            "rewinds": result["rewinds"],
        }
    )
