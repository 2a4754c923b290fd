"""Study `drives`: random drives through the daemon's navigator, each a row of figures.

A run is 60 s from rest on: speeds, bends and stops drawn as for the fault matrix, a receiver of 1
to 10 Hz and an RDSS terminal, the car and the devices of `config/vehicle.toml`. Its figures have
the names that `fusiond batch` gives a drive, so that `fusiond report --batch` shows both.

Drives and devices of run k are drawn from the child k of the seed's `SeedSequence`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable
from fusiond.files.resumable_parquet import Row, flattened
from fusiond.files.solutions_to_table import trajectory_of
from fusiond.navigation.solution import Solution
from fusiond.navigator.navigator import Navigator
from fusiond.offline.compare import NothingToCompareError, compare
from fusiond.offline.process import outcomes_of
from fusiond.simulation.imu_truth import Truth
from fusiond.studies.faults.random_drives import random_drive
from fusiond.studies.faults.runs import VEHICLE, navigate
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, map_runs, run_generator, step_counter

DEFAULT_RUNS = 200
DURATION_S = 60.0
EXPECTED_NEES = 3.0
"""Expected NEES of a position with an honest sigma (Bar-Shalom, Li, Kirubarajan (2001), 5.4.2)."""
SHARES = (5.0, 50.0, 95.0, 99.0, 100.0)
SHOWN = {
    "horizontal RMS m": "error.horizontal_rms_m",
    "horizontal largest m": "error.horizontal_max_m",
    "height RMS m": "error.down_rms_m",
    "heading RMS deg": "error.yaw_rms_deg",
    "NEES of 3": "error.position_nees",
    "inside 2 sigma": "error.horizontal_inside_2_sigma",
}


def drive_run(duration_s: float, seed: int, number: int) -> Row:
    """Run one drive and return its figures."""
    path, devices = run_generator(seed, number).spawn(2)
    drive = replace(random_drive(np.random.default_rng(path)), duration_s=duration_s)
    truth, recording = drive.recorded(VEHICLE, devices)
    solutions: list[Solution] = []
    navigators: list[Navigator] = []

    def watch(navigator: Navigator) -> None:
        navigators[:] = [navigator]
        if navigator.started is not None:
            solutions.append(navigator.solution(navigator.imu.latest_ns))

    course = navigate(VEHICLE, recording, truth, watch)
    if course.crash:
        raise RuntimeError(course.crash)
    modes = Counter(sample.mode for sample in course.samples)
    row: dict[str, Any] = {
        "gnss_rate_hz": drive.gnss_rate_hz,
        "samples": len(recording.stamps),
        "aligned_s": solutions[0].t_ns * 1e-9 if solutions else None,
        "modes": {str(mode): count / len(course.samples) for mode, count in modes.items()},
        "events": len(course.events),
    }
    if navigators:
        row["outcomes"] = outcomes_of(navigators[0], {})
        reports = navigators[0].verdicts.reports()
        row["consistency"] = {name: str(report.verdict) for name, report in reports.items()}
    if solutions:
        table = trajectory_of(solutions)
        try:
            said = compare(table, _true(truth, table.t_s))
            row["error"] = {k: v for k, v in said.items() if not k.startswith(("expected_", "t_"))}
        except NothingToCompareError as error:
            row["not_compared"] = str(error)
    return flattened(row)


def _true(truth: Truth, t_s: Floats) -> TrajectoryTable:
    at = truth.at(t_s)
    unknown = np.full((len(t_s), 3), np.nan)
    return TrajectoryTable(
        t_s=t_s,
        lat_rad=at.position[:, 0],
        lon_rad=at.position[:, 1],
        height_m=at.position[:, 2],
        v=at.v_ned,
        rpy=at.rpy,
        sd_position=unknown,
        sd_v=unknown,
        sd_rpy=unknown,
        status=[],
        rejected=[],
    )


def run_study(
    runs: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    duration_s: float = DURATION_S,
) -> dict[str, Any]:
    """Run the study with `runs` drives. Equal arguments give equal results."""
    count = runs or DEFAULT_RUNS
    rows = map_runs(partial(drive_run, duration_s, seed), count, step_counter(progress, count))
    figures = []
    for name, key in SHOWN.items():
        values = np.array([row[key] for row in rows if key in row])
        if len(values):
            at = np.percentile(values, SHARES).tolist()
            figures.append({"figure": name, "mean": float(values.mean()), "percentiles": at})
    nees = np.array([row["error.position_nees"] for row in rows if "error.position_nees" in row])
    half = 2.576 * float(nees.std(ddof=1)) / math.sqrt(len(nees)) if len(nees) > 1 else math.nan
    navigated = sum("aligned_s" in row for row in rows)
    return {
        "study": "drives",
        "runs": count,
        "seed": seed,
        "duration_s": duration_s,
        "navigated": navigated,
        "figures": figures,
        "nees": nees.tolist(),
        "finding": (
            f"{navigated} of {len(rows)} drives navigated; NEES of the position "
            f"{nees.mean():.3f} +- {half:.3f} (99 %), {EXPECTED_NEES:g} expected"
        )
        if len(nees)
        else "no drive navigated",
    }


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Table of the distribution of each figure over the drives."""
    header = ["", "mean", *(f"{share:g} %" for share in SHARES)]
    rows = [
        [f["figure"], f"{f['mean']:.3f}", *(f"{v:.3f}" for v in f["percentiles"])]
        for f in result["figures"]
    ]
    return [(f"{result['runs']} drives of {result['duration_s']:g} s", header, rows)]


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the distribution of position NEES over drives, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.hist(result["nees"], bins=60)
    axes.axvline(EXPECTED_NEES, color="black", label="expected")
    axes.set_xlabel("NEES of the position, mean of a drive")
    axes.set_ylabel("drives")
    axes.legend()
    save_figure(figure, path)
