r"""Study `vehicle`: honesty of the filter's estimates of a vehicle's parameters.

Cars are drawn from the filter's own priors (fusiond.studies.vehicle_parameters.car) and driven
twice: on a drive that shows everything, and straight on at one speed, which shows little. Of each
block

    NEES = e^T P^-1 e / k,   e true minus estimated (k,) at the end, P the filter's

averaged over the runs is 1 for an honest sigma; `interval` is that of a matched filter (99 %, one
block at a time). `kept` is sigma at the end over sigma at the start: 1 without information.

A third set has an IMU with non-orthogonal axes, with and without noise for it in the filter. Its
attitude is that of the housing, and P is the published one, which includes the non-orthogonality.

Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4.2.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, map_runs, nees_interval, step_counter
from fusiond.studies.vehicle_parameters.car import configuration
from fusiond.studies.vehicle_parameters.runs import Run, run_once

DEFAULT_RUNS = 60
TAIL = 0.005
SQUARE, MISALIGNED = {"misalignment_deg": 0.0}, {"misalignment_deg": 0.2}
CASES: dict[str, tuple[str, dict[str, float], bool]] = {
    "shown": ("shown", SQUARE, True),
    "hidden": ("hidden", SQUARE, True),
    "askew": ("shown", MISALIGNED, True),
    "askew, no noise for it": ("shown", MISALIGNED, False),
}
"""Path and IMU, and True if the filter has the noise of non-orthogonal axes."""


def _one(case: str, seed: int, number: int) -> Run:
    path, imu, known = CASES[case]
    return run_once(configuration(**imu), path, seed, number, known)


def rows_of(case: str, runs: list[Run]) -> list[dict[str, Any]]:
    """Rows of the result, one for each block."""
    rows = []
    for block in runs[0].nees:
        k = len(runs[0].errors[block])
        low, high = nees_interval(len(runs), k, TAIL)
        nees = float(np.mean([run.nees[block] for run in runs])) / k
        errors = np.array([run.errors[block] for run in runs])
        sigmas = np.array([run.sigmas[block] for run in runs])
        rows.append(
            {
                "case": case,
                "block": block,
                "nees": nees,
                "interval": [low / k, high / k],
                "honest": bool(low / k <= nees <= high / k),
                "rms": np.sqrt(np.square(errors).mean(axis=0)).tolist(),
                "sigma": sigmas.mean(axis=0).tolist(),
                "kept": (sigmas.mean(axis=0) / runs[0].priors[block]).tolist(),
            }
        )
    return rows


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` cars a case. Equal arguments give equal results."""
    count = runs or DEFAULT_RUNS
    step = step_counter(progress, count * len(CASES))
    blocks: list[dict[str, Any]] = []
    for case in CASES:
        blocks += rows_of(case, map_runs(partial(_one, case, seed), count, step))
    wrong = [f"{r['block']} ({r['case']}) {r['nees']:.1f}" for r in blocks if not r["honest"]]
    verdict = f"outside: {', '.join(wrong)}" if wrong else "none outside"
    return {
        "study": "vehicle",
        "runs": count,
        "seed": seed,
        "blocks": blocks,
        "finding": f"{len(blocks) - len(wrong)} of {len(blocks)} inside their 99 %; {verdict}",
    }


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot NEES by block and case with the interval of a matched filter, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    names = list(dict.fromkeys(row["block"] for row in result["blocks"]))
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = figure.subplots()
    for row in result["blocks"]:
        at = names.index(row["block"])
        case = list(CASES).index(row["case"])
        axes.plot(row["interval"], [at, at], color="lightgray", linewidth=6, zorder=0)
        label = row["case"] if at == 0 else None
        axes.plot(row["nees"], at + 0.12 * (case - 1.5), "o", color=f"C{case}", label=label)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("NEES a degree of freedom")
    axes.legend()
    save_figure(figure, path)
