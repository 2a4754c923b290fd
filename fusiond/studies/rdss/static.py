"""Study `rdss-static`: paper 000's static test, with its IMU, initial errors and noise.

55 steps of 1.5 s. The paper takes K = 50 from 55 steps; rho(8) over K pairs needs K + 8
innovations, so K is 47 here.
"""

from __future__ import annotations

from typing import Any

from fusiond.simulation.trajectories import static
from fusiond.studies.monte_carlo import Progress
from fusiond.studies.rdss.runs import Case
from fusiond.studies.rdss.statistics import add_times, plot, run_cases, tables

__all__ = ["CASE", "plot", "run_study", "tables"]

CASE = Case("static", static, 84.0, counted_s=((30.0, 1e9),), window=47)
"""Case of 55 fixes, from 1.5 to 82.5 s. The first 20 steps, in which an initial error of 100 m
decays, do not count."""

DEFAULT_RUNS = 500


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 500). All but times repeat exactly."""
    head, (found,) = run_cases("rdss-static", [CASE], runs or DEFAULT_RUNS, seed, progress)
    add_times(found, CASE, seed)
    return {**head, **found, "finding": _finding(found)}


def _finding(found: dict[str, Any]) -> str:
    s = found["strategies"]
    best, none = s["rewind"], s["none"]
    low, high = best["nees_interval"]
    where = "inside" if low <= best["nees_mean"] <= high else "outside"
    return (
        f"At rest the delay hardly matters: {best['horizontal_rms_m']:.2f} m with rewind, optimal "
        f"prediction the same to {s['optimal_prediction']['distance_rms_m']:.1e} m, `none` "
        f"{none['loss_m']:+.2f} m (a fix of a vehicle that stands is still true when it arrives), "
        f"INS alone {s['ins_alone']['horizontal_rms_m']:.0f} m, fixes alone "
        f"{s['rdss_alone']['horizontal_rms_m']:.1f} m; the matched filter's NEES "
        f"{best['nees_mean']:.2f} lies {where} [{low:.2f}, {high:.2f}]."
    )
