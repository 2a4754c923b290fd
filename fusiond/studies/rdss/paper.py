"""Tables and figures of paper 000 beside the study's, from a single run as in the paper.

Innovations are whitened (in sigmas), since the paper's curves in metres have no legible scale. K is
of the case; the paper has 50 of 55 steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fusiond.studies.navigation_error import metres_per_unit
from fusiond.studies.rdss.runs import RDSS_ALONE, YANTAI_DEG_M, Array, Case, Trace, grid

SHOWN = "optimal_prediction"
"""The paper's filter."""
INS = "ins_alone"


def first_run(case: Case, traces: dict[str, Trace]) -> dict[str, Any]:
    """Position errors, innovations by step, and tracks of one run, for the figures."""
    t_s, true = grid(case)
    scale = metres_per_unit(float(true[0, 0]), YANTAI_DEG_M[2])[:2]
    way = (true[:, :2] - true[0, :2]) * scale
    return {
        "t_s": t_s.tolist(),
        "error_m": traces[SHOWN].error.T.tolist(),
        "innovations": traces[SHOWN].innovations.T.tolist(),
        "way_m": {
            "truth": way.T.tolist(),
            **{name: _there(way + traces[name].error) for name in (SHOWN, INS, RDSS_ALONE)},
        },
    }


def _there(way: Array) -> list[list[float]]:
    return [axis.tolist() for axis in way[np.isfinite(way).all(axis=1)].T]


def rows(result: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    """Rows of the static test, printed and of the study: average NIS with its interval, rho(1) to
    rho(8)."""
    paper = result["paper"]["static"]
    table = [
        _row("paper, one test", paper["k"], paper["nis_mean"], paper["nis_interval"], paper["rho"]),
    ]
    for name in (SHOWN, "rewind"):
        of = result["strategies"][name]
        first = of["first_window"]
        what = f"{name.replace('_', ' ')}, run 0"
        table.append(_row(what, first["k"], first["nis"], first["nis_interval"], first["rho"]))
        what = f"{name.replace('_', ' ')}, mean of the runs"
        table.append(_row(what, first["k"], of["nis_mean"], None, of["rho_mean"]))
    low, high = paper["rho_interval"]
    outside = [k for k, rho in enumerate(paper["rho"], 1) if not low <= rho <= high]
    title = (
        f"as paper 000 prints it: rho inside [{low}, {high}], which its "
        f"{', '.join(f'rho({k})' for k in outside)} is not, though it says that all are"
    )
    return title, ["", "K", "NIS", "95 %", *(f"rho({k})" for k in range(1, 9))], table


def _row(
    what: str, k: int, nis: float, interval: list[float] | None, rho: list[float]
) -> list[str]:
    inside = "" if interval is None else f"{interval[0]:.2f} to {interval[1]:.2f}"
    return [what, str(k), f"{nis:.3f}", inside, *(f"{r:+.3f}" for r in rho)]


def draw(panels: Any, result: dict[str, Any]) -> None:
    """Draw figures 1 and 2 of the paper, or 3 and 4 for a moving vehicle, on two panels."""
    first, second = panels
    run = result["first_run"]
    moves = any(abs(x) > 1.0 for x in run["way_m"]["truth"][0])
    if moves:
        for name, (north, east) in run["way_m"].items():
            style = ":" if name == RDSS_ALONE else "-"
            first.plot(east, north, style, linewidth=1.0, label=name.replace("_", " "))
        east = np.array(run["way_m"]["truth"][1])
        north = np.array(run["way_m"]["truth"][0])
        first.set_xlim(east.min() - 1000.0, east.max() + 1000.0)
        first.set_ylim(north.min() - 1000.0, north.max() + 1000.0)
        first.set_title("figure 3: the ways of run 0", loc="left")
        first.set_xlabel("east, m")
        first.set_ylabel("north, m")
    else:
        for axis, values in zip(("north", "east"), run["error_m"], strict=True):
            first.plot(run["t_s"], values, label=axis)
        first.set_title("figure 1: position error of run 0", loc="left")
        first.set_xlabel("s")
        first.set_ylabel("error, m")
    for axis, values in zip(("latitude", "longitude"), run["innovations"], strict=True):
        second.plot(values[:55], label=axis)
    second.axhspan(-1.96, 1.96, alpha=0.1)
    number = 4 if moves else 2
    second.set_title(f"figure {number}: innovations of 55 steps", loc="left")
    second.set_xlabel("step")
    second.set_ylabel("innovation, sigma")
    for panel in panels:
        panel.legend(fontsize="small")
        panel.grid(alpha=0.3)
