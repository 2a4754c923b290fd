"""Study `ukf`: unscented against extended filter on double-star ranges and on pseudoranges.

The problems are those of `fusiond.studies.ukf.runs`, each from a fair start and from one that is
off by 10 km and 5 deg, and pseudoranges from a heading that is off by 90 deg. `ukf` has sigma
points for measurements and propagation, `ukf_measurements` for measurements alone, `ekf` none;
nor has `invariant`, in whose updates velocity and position turn with the heading. Errors and NEES
count from 30 s on; `nees_first` is that right after the first epoch, where a range from a start
that is 10 km off is not linear; `refused` counts rows that gate or residual test refused, over all
runs. NEES has 9 degrees of freedom; `nees_interval` is the 95 % interval of its average over the
runs at one instant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusiond.studies.daemon_fed_filter import DURATION_S
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter
from fusiond.studies.ukf.runs import (
    COUNTED_S,
    FILTERS,
    NEES_EVERY_S,
    PROBLEMS,
    Problem,
    Trace,
    epochs,
    monte_carlo,
)

DEFAULT_RUNS = 50
DOF = 9
PAPER = {
    "source": "paper 003: BDS/INS tight coupling, UKF, 500 s; it prints curves, no figures, and no "
    "extended filter to compare with",
    "duration_s": 500.0,
    "filter": "UKF",
    "clock": "drift first-order Markov",
    "finding": "errors of position and velocity much smaller than those of the parts",
}


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 50) of each problem. It repeats
    exactly."""
    count = runs or DEFAULT_RUNS
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, count * len(PROBLEMS))
    problems = {}
    for problem in PROBLEMS:
        results = monte_carlo(problem, count, seed, step)
        problems[problem.name] = {
            **{name: _figures(problem, [r[name] for r in results]) for name in FILTERS},
            "series": _series(problem, results),
        }
    return {
        "study": "ukf",
        "runs": count,
        "seed": seed,
        "paper": PAPER,
        "duration_s": DURATION_S,
        "counted_from_s": COUNTED_S,
        "nees_dof": DOF,
        "nees_interval": nees_interval(count, DOF, 0.025),
        "problems": problems,
        "finding": _finding(problems),
    }


def _figures(problem: Problem, traces: Sequence[Trace]) -> dict[str, Any]:
    counted = epochs(problem) >= COUNTED_S
    off = np.array([t.horizontal for t in traces])[:, counted]
    nees = np.array([t.nees for t in traces])[:, math.ceil(COUNTED_S / NEES_EVERY_S) - 1 :]
    return {
        "horizontal_rms_m": math.sqrt(float(np.mean(off**2))),
        "nees_mean": float(nees.mean()),
        "nees_first": float(np.mean([t.nees_first for t in traces])),
        "converged_rate": float(np.mean([t.converged for t in traces])),
        "refused": sum(t.refused for t in traces),
    }


def _series(problem: Problem, results: Sequence[dict[str, Trace]]) -> dict[str, Any]:
    """Horizontal RMS at each epoch and mean NEES at its instants."""
    rms = {
        name: np.sqrt(np.mean([r[name].horizontal ** 2 for r in results], axis=0)).tolist()
        for name in FILTERS
    }
    nees = {name: np.mean([r[name].nees for r in results], axis=0).tolist() for name in FILTERS}
    instants = NEES_EVERY_S * np.arange(1, len(nees["ekf"]) + 1)
    return {
        "t_s": epochs(problem).tolist(),
        "horizontal_rms_m": rms,
        "nees_t_s": instants.tolist(),
        "nees_mean": nees,
    }


def _finding(problems: dict[str, Any]) -> str:
    def pair(problem: str, key: str, form: str = ".2f") -> str:
        p = problems[problem]
        return f"{p['ukf'][key]:{form}} against {p['ekf'][key]:{form}}"

    fair, poor = "pseudorange", "pseudorange_poor"
    return (
        "From a fair start the unscented filter gives what the extended one gives (RMS "
        f"{pair('double_star', 'horizontal_rms_m')} m on double-star ranges, "
        f"{pair(fair, 'horizontal_rms_m')} m on pseudoranges); from 10 km and 5 deg, where a range "
        "bends by d^2 / 2 rho, 2 m for 10 km and 20 m for 30 km, it is alike on double-star ranges "
        f"of 15 m ({pair('double_star_poor', 'horizontal_rms_m')} m, NEES of 9 "
        f"{pair('double_star_poor', 'nees_mean')}), but on pseudoranges of 3 m the extended filter "
        "is too sure after the first epoch, refuses what follows and may stay wrong: NEES "
        f"{pair(poor, 'nees_first', '.1f')} after it, rows refused "
        f"{pair(poor, 'refused', 'd')}, converged {pair(poor, 'converged_rate')}, RMS "
        f"{pair(poor, 'horizontal_rms_m')} m."
    )


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Table with a row a problem and filter, and a column a figure."""
    low, high = result["nees_interval"]
    rows = [
        [
            problem,
            name.replace("_", " "),
            f"{f['horizontal_rms_m']:.2f}",
            f"{f['nees_first']:.2f}",
            f"{f['nees_mean']:.2f}",
            f"{f['converged_rate']:.2f}",
            str(f["refused"]),
        ]
        for problem, found in result["problems"].items()
        for name, f in found.items()
        if name != "series"
    ]
    title = (
        f"{result['runs']} runs of {result['duration_s']:.0f} s; NEES of {result['nees_dof']} "
        f"degrees, mean of one instant in [{low:.2f}, {high:.2f}]"
    )
    header = ["problem", "filter", "horizontal m", "NEES first", "NEES", "converged", "refused"]
    return [(title, header, rows)]


TITLES = {
    "double_star": "double-star fixes",
    "double_star_poor": "double-star fixes, poor start",
    "pseudorange": "pseudoranges",
    "pseudorange_poor": "pseudoranges, poor start",
    "pseudorange_heading": "pseudoranges, heading unknown",
}


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot horizontal RMS and mean NEES over time, one row a problem, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    problems = result["problems"]
    figure = Figure(figsize=(11.0, 2.8 * len(problems)), layout="constrained")
    low, high = result["nees_interval"]
    for axes, (name, found) in zip(
        figure.subplots(len(problems), 2), problems.items(), strict=True
    ):
        s = found["series"]
        for number, label in enumerate(FILTERS):
            style = {
                "linewidth": 4.0 - number,  # the later may lie on the earlier
                "alpha": 0.4 + 0.2 * number,
                "label": label.replace("_", " "),
            }
            axes[0].plot(s["t_s"], s["horizontal_rms_m"][label], **style)
            axes[1].plot(s["nees_t_s"], s["nees_mean"][label], **style)
        axes[0].set_yscale("log")
        axes[0].set_ylabel("horizontal RMS, m")
        axes[0].set_title(TITLES[name], loc="left")
        axes[1].axhspan(low, high, alpha=0.15)
        axes[1].set_ylabel("mean NEES, 9 degrees of freedom")
        for ax in axes:
            ax.set_xlabel("s")
            ax.grid(alpha=0.3)
        axes[0].legend(fontsize="small")
    save_figure(figure, path)
