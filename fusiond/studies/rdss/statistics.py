r"""Figures of the `rdss-*` studies: errors, NEES and innovation tests by filter, over all runs.

NEES (`fusiond.studies.rdss.runs`) is averaged over runs and over instants `NEES_EVERY` grid points
apart. Runs are independent, instants are not; `nees_interval` is that of the average over the runs
at *one* instant, and `nees_inside_rate` the share of instants at which that average lies in it
(Bar-Shalom, Li, Kirubarajan, 2001, section 5.4.2). NIS is a degree of freedom's, so 1 is expected,
as paper 000 prints it. Windows of K innovations, and the eight before, stand one behind the other;
`nis_pass_rate` and `rho_pass_rate` are shares of averages and of lags inside their 95 % intervals,
`verdicts` those at 1 % (`fusiond.integrity.consistency`).
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import norm

from fusiond.integrity.consistency import LAGS, Consistency, judge
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter
from fusiond.studies.rdss import paper
from fusiond.studies.rdss.runs import (
    NEES_DOF,
    RDSS_ALONE,
    Array,
    Case,
    Filter,
    Navigation,
    Trace,
    draw_fixes,
    fix_covariance,
    grid,
    imu_samples,
    monte_carlo,
)

Runs = Sequence[dict[str, Trace]]

CONFIDENCE = 0.95
TIMED_CYCLES, TIMED_REPEATS = 50, 5
SERIES_POINTS = 200
PAPER = {
    "source": "paper 000: static 55 steps of about 1.5 s; the dynamic trajectory is only a picture",
    "static": {
        "k": 50,
        "dof": 100,
        "nis_mean": 0.893,
        "nis_interval": [0.74, 1.3],
        "rho": [-0.4054, -0.0259, -0.0411, -0.0881, 0.1637, -0.1903, 0.0842, 0.1781],
        "rho_interval": [-0.2772, 0.2772],
        "fix_sd_m": 30.0,
    },
    "dynamic": {"duration_min": 26},
}


def run_cases(
    name: str, cases: Sequence[Case], count: int, seed: int, progress: Progress | None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run each case `count` times; return the head of the result and the `figures` of the cases."""
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, count * len(cases))
    found = [figures(case, monte_carlo(case, count, seed, step)) for case in cases]
    sd = np.sqrt(np.diag(fix_covariance()))
    head = {
        "study": name,
        "runs": count,
        "seed": seed,
        "fix_sd_north_m": float(sd[0]),
        "fix_sd_east_m": float(sd[1]),
        "paper": PAPER,
    }
    return head, found


def figures(case: Case, results: Runs) -> dict[str, Any]:
    """Case, figures of each filter, and the course of the horizontal RMS over time."""
    t_s, _ = grid(case)
    counted = np.zeros(len(t_s), dtype=bool)
    for start, end in case.counted_s:
        counted |= (t_s >= start) & (t_s < end)
    names = [f.name for f in case.filters] + [RDSS_ALONE]
    reference = case.filters[0].name
    every = math.ceil(len(t_s) / SERIES_POINTS)
    return {
        "case": case.name,
        "duration_s": case.duration_s,
        "spacing_s": case.spacing_s,
        "delay_s": case.delay_s,
        "away_s": [list(w) for w in case.away_s],
        "counted_s": [[start, min(end, case.duration_s)] for start, end in case.counted_s],
        "imu_rate_hz": case.imu.rate_hz,
        "strategies": {
            name: {
                **_errors(results, name, reference, counted),
                **_consistency(results, name, case.window),
            }
            for name in names
        },
        "first_run": paper.first_run(case, results[0]) if paper.SHOWN in names else None,
        "series": {
            "t_s": t_s[::every].tolist(),
            "horizontal_rms_m": {name: _course(results, name)[::every].tolist() for name in names},
        },
    }


def add_times(found: dict[str, Any], case: Case, seed: int) -> None:
    """Write `time_per_step_us` of each filter into the figures of a case."""
    for f in case.filters:
        found["strategies"][f.name]["time_per_step_us"] = time_per_step_us(case, f, seed)
    found["strategies"][RDSS_ALONE]["time_per_step_us"] = None


def _errors(results: Runs, name: str, reference: str, counted: Array) -> dict[str, Any]:
    """RMS errors, and the filter's loss against the first one, paired run by run."""
    e = np.array([traces[name].error[counted] for traces in results])
    v = np.array([traces[name].velocity[counted] for traces in results])
    best = np.array([traces[reference].error[counted] for traces in results])
    loss = _rms(e, axis=1) - _rms(best, axis=1)
    half = float(norm.isf((1.0 - CONFIDENCE) / 2.0) * loss.std(ddof=1) / math.sqrt(len(loss)))
    return {
        "horizontal_rms_m": float(_rms(e)),
        "north_rms_m": float(np.sqrt(np.nanmean(e[..., 0] ** 2))),
        "east_rms_m": float(np.sqrt(np.nanmean(e[..., 1] ** 2))),
        "velocity_rms_m_s": float(_rms(v)) if np.isfinite(v).any() else None,
        "loss_m": float(loss.mean()),
        "loss_interval_m": [float(loss.mean()) - half, float(loss.mean()) + half],
        "distance_rms_m": float(_rms(e - best)),
    }


def _rms(e: Array, axis: int | None = None) -> Array:
    """RMS length of the vectors (..., 2), without undefined ones."""
    return np.asarray(np.sqrt(np.nanmean(np.square(e).sum(axis=-1), axis=axis)))


def _course(results: Runs, name: str) -> Array:
    """Horizontal RMS over the runs at each grid point; nan where there is no solution yet."""
    square = np.array([np.square(traces[name].error).sum(axis=-1) for traces in results])
    return np.asarray(np.sqrt(square.mean(axis=0)))


def _consistency(results: Runs, name: str, k: int) -> dict[str, Any]:
    """NEES and innovation tests; None where the filter has no covariance or no innovations."""
    nees = np.array([traces[name].nees for traces in results])
    position = np.array([traces[name].position_nees for traces in results])
    rows = [traces[name].innovations for traces in results]
    windows = [w for nu in rows for w in judged_windows(nu, k)]
    interval, position_interval = (nees_interval(len(results), dof) for dof in (NEES_DOF, 2))
    by_instant = nees.mean(axis=0)
    inside = (by_instant >= interval[0]) & (by_instant <= interval[1])
    has_nees, innovations = bool(nees.size), sum(len(nu) for nu in rows)
    return {
        "nees_mean": float(nees.mean()) if has_nees else None,
        "nees_interval": interval if has_nees else None,
        "nees_inside_rate": float(inside.mean()) if has_nees else None,
        "position_nees_mean": float(position.mean()) if has_nees else None,
        "position_nees_interval": position_interval if has_nees else None,
        "nis_mean": sum(float(np.square(nu).sum()) for nu in rows) / (2 * innovations)
        if innovations
        else None,
        "nis_pass_rate": float(np.mean([w.nis_inside for w in windows])) if windows else None,
        "rho_pass_rate": float(np.mean([w.rho_inside for w in windows])) if windows else None,
        "rho_1_mean": float(np.mean([w.rho[0] for w in windows])) if windows else None,
        "rho_mean": np.mean([w.rho for w in windows], axis=0).tolist() if windows else None,
        "first_window": {
            "k": windows[0].k,
            "nis": windows[0].nis_average,
            "nis_interval": list(windows[0].nis_interval),
            "rho": list(windows[0].rho),
        }
        if windows
        else None,
        "verdicts": dict(Counter(w.verdict for w in windows)),
        "gated": sum(traces[name].gated for traces in results),
    }


def judged_windows(nu: Array, k: int) -> list[Consistency]:
    """Windows of K whitened innovations (n, m) with the `LAGS` before them, judged separately."""
    found = []
    for start in range(0, len(nu) - k - LAGS + 1, k + LAGS):
        rows = nu[start : start + k + LAGS]
        energy = np.square(rows).sum(axis=1)
        total = energy[LAGS:].sum()
        rho = [
            float((rows[LAGS:] * rows[LAGS - lag : -lag]).sum())
            / math.sqrt(total * energy[LAGS - lag : -lag].sum())
            for lag in range(1, LAGS + 1)
        ]
        dof = k * nu.shape[1]
        found.append(judge(k, dof, float(total) / dof, rho))
    return found


def time_per_step_us(case: Case, f: Filter, seed: int) -> float:
    """Processor time of one cycle, from one arrival to the next: IMU samples at the case's rate
    propagated, the fix used and, where its strategy says so, everything since run again. Median
    over cycles, least of some repeats."""
    rng = np.random.default_rng([seed, 0])
    samples, _ = imu_samples(case, rng)
    fixes = draw_fixes(case, rng)
    best = math.inf
    for _ in range(TIMED_REPEATS):
        run = Navigation(case, f, samples, np.zeros(9))
        spent = []
        for k in range(min(TIMED_CYCLES, len(fixes.t_s))):
            start = time.process_time_ns()
            run.advance(float(fixes.arrival_s[k]))
            if f.strategy:
                run.arrive(fixes, k)
            spent.append(time.process_time_ns() - start)
        best = min(best, median(spent[1:]) * 1e-3)
    return best


# --------------------------------------------------------------------------- for people

COLUMNS = {
    "RMS m": ("horizontal_rms_m", "{:.2f}"),
    "north": ("north_rms_m", "{:.2f}"),
    "east": ("east_rms_m", "{:.2f}"),
    "loss m": ("loss_m", "{:+.3f}"),
    "NEES / 12": ("nees_mean", "{:.2f}"),
    "NEES / 2": ("position_nees_mean", "{:.2f}"),
    "NIS": ("nis_mean", "{:.3f}"),
    "NIS ok": ("nis_pass_rate", "{:.3f}"),
    "rho ok": ("rho_pass_rate", "{:.3f}"),
    "us/step": ("time_per_step_us", "{:.0f}"),
}


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, header and rows of each case, for `fusiond study`."""
    found = []
    for case in (result, *result.get("variants", {}).values()):
        title = (
            f"{case['case']}: a fix every {case['spacing_s']:g} s, {case['delay_s']:g} s late, "
            f"{result['runs']} runs"
        )
        rows = [
            [name, *(_cell(figure.get(key), form) for key, form in COLUMNS.values())]
            for name, figure in case["strategies"].items()
        ]
        found.append((title, ["", *COLUMNS], rows))
    if result["study"] == "rdss-static":
        found.append(paper.rows(result))
    return found


def _cell(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def plot(result: dict[str, Any], path: Path) -> None:
    """Horizontal RMS over time by filter, one panel a case; below them the paper's figures 1 and 2,
    or 3 and 4, of run 0; to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    cases = [result, *result.get("variants", {}).values()]
    own = 2 if paper.SHOWN in result["strategies"] else 0
    figure = Figure(figsize=(9.0, 3.6 * (len(cases) + own)), layout="constrained")
    panels = figure.subplots(len(cases) + own, squeeze=False)[:, 0]
    if own:
        paper.draw(panels[len(cases) :], result)
    for axes, case in zip(panels, cases, strict=False):
        series = case["series"]
        for number, (name, values) in enumerate(series["horizontal_rms_m"].items()):
            width = 4.0 if number == 0 else 1.2  # others may lie on the first
            label = name.replace("_", " ")
            axes.plot(
                series["t_s"], values, linewidth=width, alpha=0.4 + 0.6 * (number > 0), label=label
            )
        axes.set_yscale("log")
        axes.set_xlabel("s")
        axes.set_ylabel("horizontal RMS, m")
        axes.set_title(
            f"{case['case']}: every {case['spacing_s']:g} s, {case['delay_s']:g} s late", loc="left"
        )
        axes.legend(fontsize="small", ncols=3)
        axes.grid(alpha=0.3)
    save_figure(figure, path)
