r"""Study `multiscale`: paper 001's block filter against federated and centralised, same runs.

Standard deviations are about the mean error over all runs and counted seconds, one axis: the root
of the axes' mean square (position and velocity north and east, attitude n, e, d), just after each
second's aids. `*_sigma_*` is what the filter states for the same. NEES (10 degrees of freedom) is
averaged over runs and counted seconds; `nees_interval` is that of the average over the runs at
*one* second, `nees_inside_rate` the share of seconds at which that average lies in it
(Bar-Shalom, Li, Kirubarajan, 2001, section 5.4.2). `std_ratio` is to the centralised filter, paired
run by run. What is simulated: `fusiond.studies.multiscale.runs`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter
from fusiond.studies.multiscale.runs import (
    BIAS_MG,
    COUNTED_FROM_S,
    DURATION_S,
    GPS_M,
    GPS_M_S,
    GROUPS,
    PERIOD_S,
    RATE_HZ,
    Array,
    Case,
    Trace,
    monte_carlo,
    times_per_step_us,
)

__all__ = ["plot", "run", "tables"]


DEFAULT_RUNS = 100
STATES = 10
CONFIDENCE = 0.95
CASES = (Case("matched"), Case("bias", BIAS_MG))
REFERENCE = "centralised"
UNITS = {"position": ("m", 1.0), "velocity": ("m_s", 1.0), "attitude": ("deg", 180.0 / math.pi)}
PAPER_FIGURES: dict[str, Any] = {
    "source": "paper 001, tables 1 and 2; north is latitude, east longitude; one run",
    "multiscale": {
        "position_std_m": [1.1627, 1.4540],
        "velocity_std_m_s": [0.0070, 0.0063],
        "attitude_std_deg": [0.0032, 0.0031, 0.0031],
        "time_per_step": 0.09350,
    },
    "federated": {
        "position_std_m": [6.0023, 5.2128],
        "velocity_std_m_s": [0.0219, 0.0180],
        "attitude_std_deg": [0.0032, 0.0031, 0.0031],
        "time_per_step": 0.06312,
    },
    "position_ratio": [5.16, 3.59],
    "time_ratio": 1.48,
}
"""Axes north, east; attitude roll, pitch, heading."""


def run(runs: int | None = None, seed: int = 0, progress: Progress | None = None) -> dict[str, Any]:
    """The study with `runs` Monte Carlo runs (default 100) of each case. All but times repeat."""
    count = runs or DEFAULT_RUNS
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, count * len(CASES))
    found = {case.name: _figures(monte_carlo(case, count, seed, step)) for case in CASES}
    spent = times_per_step_us(CASES[0], seed)
    for case in found.values():
        for name, figures in case["filters"].items():
            figures["time_per_step_us"] = spent[name]
            figures["time_ratio"] = spent[name] / spent[REFERENCE]
    return {
        "study": "multiscale",
        "paper": {"source": "paper 001, GPS/star tracker/SINS", **PAPER_FIGURES},
        "runs": count,
        "seed": seed,
        "duration_s": DURATION_S,
        "counted_s": [COUNTED_FROM_S, DURATION_S],
        "imu_rate_hz": RATE_HZ,
        "gps_sd_m": GPS_M,
        "gps_sd_m_s": GPS_M_S,
        "star_tracker_sd_arcsec": 200.0,
        **found["matched"],
        "variants": {"bias": found["bias"]},
        "finding": _finding(found["matched"]["filters"], found["bias"]["filters"]),
    }


def _figures(results: Sequence[dict[str, Trace]]) -> dict[str, Any]:
    counted = slice(round(COUNTED_FROM_S / PERIOD_S), None)
    interval = nees_interval(len(results), STATES)
    reference = np.array([traces[REFERENCE].error[counted] for traces in results])
    filters = {}
    for name in results[0]:
        error = np.array([traces[name].error[counted] for traces in results])
        sigma = np.array([traces[name].sigma[counted] for traces in results])
        nees = np.array([traces[name].nees[counted] for traces in results])
        by_second = nees.mean(axis=0)
        inside = (by_second >= interval[0]) & (by_second <= interval[1])
        figures: dict[str, Any] = {}
        for group, (unit, scale) in UNITS.items():
            part = GROUPS[group]
            std = error[..., part].std(axis=(0, 1)) * scale
            figures[f"{group}_std_{unit}"] = _root_mean_square(std)
            figures[f"{group}_std_by_axis_{unit}"] = std.tolist()
            figures[f"{group}_sigma_{unit}"] = _root_mean_square(sigma[..., part]) * scale
            figures[f"{group}_std_ratio"] = _ratio(error[..., part], reference[..., part])
        figures["nees_mean"] = float(nees.mean())
        figures["nees_interval"] = interval
        figures["nees_inside_rate"] = float(inside.mean())
        filters[name] = figures
    course = {
        name: np.sqrt(
            np.mean([np.square(t[name].error[:, GROUPS["position"]]) for t in results], axis=(0, 2))
        ).tolist()
        for name in results[0]
    }
    t_s = np.arange(1, len(results[0][REFERENCE].nees) + 1) * PERIOD_S
    return {"filters": filters, "series": {"t_s": t_s.tolist(), "position_rms_m": course}}


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _ratio(error: Array, reference: Array) -> dict[str, Any]:
    """Root-mean-square error as a multiple of the reference's: over all runs, and the interval that
    the runs' own ratios (as logarithms) give its mean."""
    own, theirs = (np.mean(np.square(e), axis=(1, 2)) for e in (error, reference))
    logs = 0.5 * np.log(own / theirs)
    half = float(norm.isf(0.5 * (1.0 - CONFIDENCE)) * logs.std(ddof=1) / math.sqrt(len(logs)))
    middle = float(logs.mean())
    return {
        "overall": float(np.sqrt(own.mean() / theirs.mean())),
        "interval": [math.exp(middle - half), math.exp(middle + half)],
    }


def _finding(matched: dict[str, Any], biased: dict[str, Any]) -> str:
    block, rival, best = (matched[name] for name in ("multiscale", "federated", REFERENCE))
    off, off_rival, off_best = (biased[name] for name in ("multiscale", "federated", REFERENCE))
    low, high = best["nees_interval"]
    where = "inside" if low <= best["nees_mean"] <= high else "outside"
    return (
        "Of the claimed 3.6 to 5.2 times smaller position error than a federated filter's "
        f"{_times(rival, block)} appears at {_times(block, rival, 'time_per_step_us')} its time "
        f"(paper: 1.48), and none of it against the centralised filter: multi-scale "
        f"{block['position_std_m']:.2f} m, federated without reset {rival['position_std_m']:.2f} m "
        f"(with fusion reset it is the centralised one), centralised "
        f"{best['position_std_m']:.2f} m (the paper prints 1.16 and 1.45 m against 6.00 and "
        "5.21 m), for all use every measurement once and no filter beats the matched Kalman "
        "filter, while local filters that share the process noise without a reset lose a little; "
        "the averaged transition takes noise already in the block for new, so multi-scale states "
        f"too small a sigma (NEES {block['nees_mean']:.2f} where 10 is right; centralised "
        f"{best['nees_mean']:.2f}, {where} [{low:.2f}, {high:.2f}]); errors near those of the "
        "paper's rival come of 1e-3 g of accelerometer bias that no state models, for every "
        f"filter: federated {off_rival['position_std_m']:.2f} m, multi-scale "
        f"{off['position_std_m']:.2f} m, centralised {off_best['position_std_m']:.2f} m."
    )


def _times(one: dict[str, Any], other: dict[str, Any], key: str = "position_std_m") -> str:
    return f"{one[key] / other[key]:.2f} times"


# --------------------------------------------------------------------------- for people

COLUMNS = {
    "position m": ("position_std_m", "{:.3f}"),
    "stated": ("position_sigma_m", "{:.3f}"),
    "velocity m/s": ("velocity_std_m_s", "{:.4f}"),
    "stated ": ("velocity_sigma_m_s", "{:.4f}"),
    "attitude deg": ("attitude_std_deg", "{:.4f}"),
    "stated  ": ("attitude_sigma_deg", "{:.4f}"),
    "NEES / 10": ("nees_mean", "{:.2f}"),
    "us/step": ("time_per_step_us", "{:.0f}"),
    "ratio": ("time_ratio", "{:.2f}"),
}
TITLES = {
    "matched": "matched: the filters' model is the truth",
    "bias": "bias: the accelerometer has 1e-3 g that no state models",
}


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, header and rows of each case, and the paper's figures, for `fusiond study`."""
    found = []
    for case, figures in (("matched", result), ("bias", result["variants"]["bias"])):
        rows = [
            [name, *(form.format(f[key]) for key, form in COLUMNS.values())]
            for name, f in figures["filters"].items()
        ]
        found.append((f"{TITLES[case]}, {result['runs']} runs", ["", *COLUMNS], rows))
    rows = []
    for name in ("multiscale", "federated"):
        printed = result["paper"][name]
        values = (printed[f"{group}_std_{unit}"] for group, (unit, _) in UNITS.items())
        cells = [" / ".join(f"{v:g}" for v in value) for value in values]
        rows.append([name, *cells, f"{printed['time_per_step']:g}"])
    header = ["", "position m", "velocity m/s", "attitude deg", "time"]
    found.append(("as paper 001 prints it, north / east", header, rows))
    return found


def plot(result: dict[str, Any], path: Path) -> None:
    """Position error over time by filter, one panel a case, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[report]`)

    cases = (("matched", result), ("bias", result["variants"]["bias"]))
    figure = Figure(figsize=(9.0, 7.2), layout="constrained")
    for axes, (case, found) in zip(figure.subplots(2), cases, strict=True):
        series = found["series"]
        for number, (name, values) in enumerate(series["position_rms_m"].items()):
            width = 4.0 if number == 0 else 1.2  # others may lie on the first
            alpha = 0.4 + 0.6 * (number > 0)
            label = name.replace("_", " ")
            axes.plot(series["t_s"], values, linewidth=width, alpha=alpha, label=label)
        axes.set_xlabel("s")
        axes.set_ylabel("position RMS of an axis, m")
        axes.set_title(TITLES[case], loc="left")
        axes.legend(fontsize="small", ncols=3)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
