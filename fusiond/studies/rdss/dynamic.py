"""Study `rdss-dynamic`: a drive of 26 min with turns and stops, the IMU and noise of paper 000.

The paper's trajectory is only a picture; this one is the drive of `fusiond simulate`, without its
hills, as the paper's model has no height. Beside the paper's cycle of 1.5 s:

`slow`   a fix every 10.5 s that is 4.5 s late, as a terminal with a 10 s card has them
`away`   the paper's cycle with RDSS away twice for 5 min: when it comes back the INS velocity is
         poor, which is what the paper holds against position compensation. Errors count for 60 s
         from the first fix after each return; `away_slow` the same with the slow terminal, 120 s
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fusiond.simulation.trajectories import Path, Profile, drive
from fusiond.studies.monte_carlo import Progress
from fusiond.studies.rdss.runs import Case
from fusiond.studies.rdss.statistics import add_times, plot, run_cases, tables

__all__ = ["CASES", "level_drive", "plot", "run_study", "tables"]
DEFAULT_RUNS = 100


def level_drive(duration_s: float) -> Path:
    """The simulated car's drive on level ground."""
    return replace(drive(duration_s), climb=Profile([0.0], [0.0]))


_CYCLE = Case("cycle", level_drive, 1560.0, counted_s=((120.0, 1e9),))
_AWAY = ((400.0, 700.0), (1000.0, 1300.0))
_SLOW = replace(_CYCLE, name="slow", spacing_s=10.5, delay_s=4.5)


def _away(case: Case, name: str, counted_s: float) -> Case:
    """Case with an RDSS outage; errors count from the arrival of its first fix after it."""
    first = case.spacing_s + case.delay_s
    counted = tuple((end + first, end + first + counted_s) for _, end in _AWAY)
    return replace(case, name=name, away_s=_AWAY, counted_s=counted)


CASES = (_CYCLE, _SLOW, _away(_CYCLE, "away", 60.0), _away(_SLOW, "away_slow", 120.0))


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 100) of each case. All but times repeat
    exactly."""
    head, found = run_cases("rdss-dynamic", CASES, runs or DEFAULT_RUNS, seed, progress)
    add_times(found[0], CASES[0], seed)
    variants = {case["case"]: case for case in found[1:]}
    return {**head, **found[0], "variants": variants, "finding": _finding(*found)}


def _finding(
    cycle: dict[str, Any], slow: dict[str, Any], away: dict[str, Any], away_slow: dict[str, Any]
) -> str:
    s = cycle["strategies"]
    best = s["rewind"]
    low, high = best["nees_interval"]
    where = "inside" if low <= best["nees_mean"] <= high else "outside"

    def loss(case: dict[str, Any], name: str) -> str:
        figure = case["strategies"][name]
        half = figure["loss_interval_m"][1] - figure["loss_m"]
        return f"{figure['loss_m']:+.2f} +- {half:.2f} m"

    return (
        f"Rewind {best['horizontal_rms_m']:.2f} m RMS, optimal prediction the same to "
        f"{s['optimal_prediction']['distance_rms_m']:.1e} m; against them `none` loses "
        f"{loss(cycle, 'none')}, position compensation {loss(cycle, 'position_compensation')} "
        f"(slow terminal {loss(slow, 'position_compensation')}; RDSS back after 5 min, with the "
        f"velocity poor, {loss(away, 'position_compensation')}, and on the slow terminal "
        f"{loss(away_slow, 'position_compensation')}); the matched filter's NEES "
        f"{best['nees_mean']:.2f} lies {where} [{low:.2f}, {high:.2f}]."
    )
