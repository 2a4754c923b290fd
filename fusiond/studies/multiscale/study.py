r"""Study `multiscale`: block filter of paper 001 against federated and centralised filters.

Standard deviations are about the mean error over all runs and counted seconds, one axis: the root
of the axes' mean square (position and velocity north and east, attitude n, e, d), just after each
second's measurements. `*_sigma_*` is what the filter states for the same. NEES (10 degrees of
freedom) is averaged over runs and counted seconds; `nees_interval` is that of the average over the
runs at
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

from fusiond.studies.figure_file import save_figure
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

__all__ = ["plot", "run_study", "tables"]


DEFAULT_RUNS = 100
STATES = 10
CONFIDENCE = 0.95
CASES = (Case("matched"), Case("bias", BIAS_MG))
REFERENCE = "centralised"
UNITS = {"position": ("m", 1.0), "velocity": ("m_s", 1.0), "attitude": ("deg", 180.0 / math.pi)}
PRINTED: dict[str, dict[str, list[float]]] = {
    "multiscale": {
        "position_m": [1.1627, 1.4540],
        "velocity_m_s": [0.0070, 0.0063],
        "attitude_deg": [0.0032, 0.0031, 0.0031],
        "position_max_m": [2.9373, 4.4962],
        "position_min_m": [-3.5929, -4.3270],
        "velocity_max_m_s": [0.3449, 0.3259],
        "velocity_min_m_s": [-0.3436, -0.3186],
        "attitude_max_deg": [0.2053, 0.2137, 0.1932],
        "attitude_min_deg": [-0.2212, -0.2092, -0.2392],
        "time": [0.09350, 0.79, 0.05763, 3.75e-5],
    },
    "federated": {
        "position_m": [6.0023, 5.2128],
        "velocity_m_s": [0.0219, 0.0180],
        "attitude_deg": [0.0032, 0.0031, 0.0031],
        "position_max_m": [8.0740, 5.4857],
        "position_min_m": [-5.0844, -8.1350],
        "velocity_max_m_s": [0.5977, 0.4055],
        "velocity_min_m_s": [-0.4613, -0.3624],
        "attitude_max_deg": [0.2047, 0.2140, 0.1925],
        "attitude_min_deg": [-0.2205, -0.2087, -0.2389],
        "time": [0.06312, 0.87, 0.02523, 3.59e-4],
    },
}
"""Tables 1 and 2 as printed; axes north (latitude), east (longitude); roll, pitch, heading. The
first three are headed "mean square deviation" and are variances: 0.0031 deg^2 is the square of the
star tracker's 200 arc seconds, and the extremes, of some hundred seconds, are 2.4 to 4.3 of their
roots (of the numbers themselves 49 to 77 in velocity and attitude). Time: mean, greatest, least,
variance; its unit is not printed."""


def _paper() -> dict[str, Any]:
    """Printed figures of the paper, as standard deviations instead of variances."""
    out: dict[str, Any] = {"source": "paper 001, tables 1 and 2: GPS/star tracker/SINS, one run"}
    for name, printed in PRINTED.items():
        out[name] = {"printed": printed}
        for group, (unit, _) in UNITS.items():
            roots = [math.sqrt(v) for v in printed[f"{group}_{unit}"]]
            out[name][f"{group}_std_{unit}"] = roots
    for group in ("position", "velocity"):
        unit = UNITS[group][0]
        own, theirs = (out[name][f"{group}_std_{unit}"] for name in ("multiscale", "federated"))
        out[f"{group}_ratio"] = [b / a for a, b in zip(own, theirs, strict=True)]
    times = [PRINTED[name]["time"][0] for name in ("multiscale", "federated")]
    out["time_ratio"] = times[0] / times[1]
    return out


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 100) of each case. All but times
    repeat."""
    count = runs or DEFAULT_RUNS
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, count * len(CASES))
    found = {case.name: _figures(monte_carlo(case, count, seed, step)) for case in CASES}
    spent = times_per_step_us(CASES[0], seed)
    for case in found.values():
        for name, figures in case["filters"].items():
            figures["time_per_step_us"] = spent[name].median
            figures["time_ratio"] = spent[name].median / spent[REFERENCE].median
            figures["time_spread_us"] = spent[name].spread
    return {
        "study": "multiscale",
        "paper": _paper(),
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
            # Of a run, as the paper has them; mean over the runs.
            for what, of_run in (("max", error.max(axis=1)), ("min", error.min(axis=1))):
                figures[f"{group}_{what}_{unit}"] = (of_run[:, part].mean(axis=0) * scale).tolist()
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
    velocity = GROUPS["velocity"]
    figures_1_to_3 = {
        name: {
            "error_m_s": results[0][name].error[:, velocity].T.tolist(),
            "sigma_m_s": results[0][name].sigma[:, velocity].T.tolist(),
        }
        for name in ("multiscale", "federated")
    }
    series = {"t_s": t_s.tolist(), "position_rms_m": course, "velocity": figures_1_to_3}
    return {"filters": filters, "series": series}


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
    paper = _paper()

    def pair(values: list[float], digits: int) -> str:
        return " to ".join(f"{v:.{digits}f}" for v in sorted(values))

    def each(key: str, digits: int) -> str:
        one, other = (
            " and ".join(f"{v:.{digits}f}" for v in paper[name][key])
            for name in ("multiscale", "federated")
        )
        return f"{one} against {other}"

    return (
        f"Of the claimed {pair(paper['position_ratio'], 1)} times smaller position error than a "
        f"federated filter's (table 1 holds variances; in velocity "
        f"{pair(paper['velocity_ratio'], 1)} times) "
        f"{_times(rival, block)} appears, in velocity {_times(rival, block, 'velocity_std_m_s')}, "
        f"at {_times(block, rival, 'time_per_step_us')} its time "
        f"(paper: {paper['time_ratio']:.2f}), and none of it against the centralised filter: "
        f"multi-scale {block['position_std_m']:.2f} m and {block['velocity_std_m_s']:.3f} m/s, "
        f"federated without reset {rival['position_std_m']:.2f} m and "
        f"{rival['velocity_std_m_s']:.3f} m/s "
        f"(with fusion reset it is the centralised one), centralised "
        f"{best['position_std_m']:.2f} m (the paper: {each('position_std_m', 2)} m, "
        f"{each('velocity_std_m_s', 3)} m/s), for all use every measurement once and no filter "
        "beats the matched Kalman "
        "filter, while local filters that share the process noise without a reset lose a little; "
        "the averaged transition takes noise already in the block for new, so multi-scale states "
        f"too small a sigma (NEES {block['nees_mean']:.2f} where 10 is right; centralised "
        f"{best['nees_mean']:.2f}, {where} [{low:.2f}, {high:.2f}]); 1e-3 g of accelerometer bias "
        "that no state models is more than the paper's figures have, and hurts every filter: "
        f"federated {off_rival['position_std_m']:.2f} m, multi-scale "
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
    found.extend(_beside_the_paper(result))
    return found


def _beside_the_paper(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Tables 1 and 2: the study's figures below the paper's."""
    names, first, second = ("multiscale", "federated"), [], []
    for name in names:
        paper, ours = result["paper"][name], result["filters"][name]
        for what, source in (("std", None), ("max", "max"), ("min", "min")):
            rows = [[f"{name} {what}, paper"], [f"{name} {what}"]]
            for group, (unit, _) in UNITS.items():
                if source is None:
                    pair = paper[f"{group}_std_{unit}"], ours[f"{group}_std_by_axis_{unit}"]
                else:
                    key = f"{group}_{source}_{unit}"
                    pair = paper["printed"][key], ours[key]
                for row, values in zip(rows, pair, strict=True):
                    row.append(" / ".join(f"{v:.4f}" for v in values))
            first.extend(rows)
        mean, most, least, variance = paper["printed"]["time"]
        second.append([f"{name}, paper", f"{mean:g}", f"{most:g}", f"{least:g}", f"{variance:g}"])
        spread = ours["time_spread_us"]
        second.append([name, *(f"{spread[k]:.0f}" for k in ("mean", "max", "min", "variance"))])
    return [
        (
            "table 1 of paper 001 (roots of its variances) and ours: north / east",
            ["", "position m", "velocity m/s", "attitude deg"],
            first,
        ),
        (
            "table 2 of paper 001, its unit not printed, and ours in us",
            ["", "mean", "greatest", "least", "variance"],
            second,
        ),
    ]


def plot(result: dict[str, Any], path: Path) -> None:
    """Figures 1 to 3 of the paper, of run 0: velocity errors of both filters and what they state;
    below them position error over time by filter, one panel a case, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(9.0, 12.0), layout="constrained")
    panels = figure.subplots(5)
    _velocities(panels[:3], result["series"])
    cases = (("matched", result), ("bias", result["variants"]["bias"]))
    for axes, (case, found) in zip(panels[3:], cases, strict=True):
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
    save_figure(figure, path)


def _velocities(panels: Any, series: dict[str, Any]) -> None:
    t_s, names = series["t_s"], ("multiscale", "federated")
    for number, name in enumerate(names):
        for axis, values in zip(
            ("north", "east"), series["velocity"][name]["error_m_s"], strict=True
        ):
            panels[number].plot(t_s, values, linewidth=0.9, label=axis)
        panels[number].set_ylim(-0.6, 0.6)  # the paper's greatest
        panels[number].set_title(f"figure {number + 1}: velocity error, {name}", loc="left")
        panels[number].set_ylabel("velocity error, m/s")
    for number, name in enumerate(names):
        for line, axis, values in zip(
            ("-", "--"), ("north", "east"), series["velocity"][name]["sigma_m_s"], strict=True
        ):
            panels[2].plot(t_s, values, line, color=f"C{number}", label=f"{name}, {axis}")
    panels[2].set_yscale("log")
    panels[2].set_title("figure 3: sigma of the velocity that each states", loc="left")
    panels[2].set_ylabel("sigma, m/s")
    for panel in panels:
        panel.set_xlabel("s")
        panel.legend(fontsize="small", ncols=2)
        panel.grid(alpha=0.3)
