r"""Study `bds-tight`: BeiDou pseudoranges and rates in the filter, against the receiver's fixes.

Set-up, rows and cases are those of `fusiond.studies.bds_tight.runs`. All figures are over all runs
and the epochs from `COUNTED_S` on, those under `stretch` over the epochs with few satellites:

`horizontal_rms_m`, `vertical_rms_m`   over the epochs that have a solution
`nees_mean`      of the position, 3 degrees of freedom, with the covariance that the row states;
                 `nav_nees_mean`, of filters: all nine navigation errors
`solution_rate`  share of the epochs that have a solution: a filter's are all
`availability`   share of the epochs with a solution whose stated 95 % horizontal error,
                 sqrt(-ln 0.05) sqrt(P_nn + P_ee) for a round error, is at most `LIMIT_M`
`growth_m`       RMS of what the horizontal error has changed by since the last epoch before the
                 stretch, so many seconds after that

`orbit_errors` repeats some rows with smaller orbit and clock errors: they make NEES.
`paper_case` is the paper's own set-up, state vector and all
(`fusiond.studies.bds_tight.paper_setup`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.studies.bds_tight import paper_setup
from fusiond.studies.bds_tight.runs import (
    CASES,
    COMPARED,
    COUNTED_S,
    MOST_PDOP,
    ORBIT_ERRORS_M,
    ROWS,
    STRETCH_S,
    CaseRun,
    Trace,
    epochs,
    in_stretch,
    monte_carlo,
)
from fusiond.studies.daemon_fed_filter import DURATION_S
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]

DEFAULT_RUNS = 50
DOF, NAV_DOF = 3, 9
LIMIT_M = 10.0
"""Horizontal accuracy, 95 %, that counts as available, chosen for this study: a solution that
claims less is of little use on a road."""
GROWTH_S = (30.0, 60.0, STRETCH_S[1] - STRETCH_S[0])
"""Times of growth; the claim on three satellites refers to the first."""
CLAIM = 1.0 / 3.0
"""Claim on three satellites for 30 s: the error is at most this share of coasting's."""
PAPER = {
    "source": "paper 003: BDS/INS tight coupling, UKF, 500 s",
    "duration_s": 500.0,
    "filter": "UKF",
    "clock": "drift first-order Markov; its figures are not printed. Here the same",
    "figures": None,
    "shows": "one figure of filtered errors without legible values, open sky, one run: errors of "
    "position and velocity are clearly smaller than before filtering. It has neither an extended "
    "filter nor loose coupling nor few satellites to compare with, and no sigma",
}


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 50) of each case. It repeats exactly."""
    count = runs or DEFAULT_RUNS
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, 2 * count)
    results = monte_carlo(count, seed, step)
    own = paper_setup.paper_figures(count, seed, step)
    cases = {case: _case(case, [r[0][case] for r in results]) for case in CASES}
    growth = {row: cases["canyon3"][row]["growth_m"] for row in ("tight_ekf", "coasting")}
    three = {
        "claim": CLAIM,
        "growth_m": growth,
        "ratio": {s: growth["tight_ekf"][s] / growth["coasting"][s] for s in growth["coasting"]},
    }
    orbits = [
        {
            "orbit_error_m": size,
            "cases": {case: _orbit_figures(case, [r[k][case] for r in results]) for case in CASES},
        }
        for k, size in enumerate(ORBIT_ERRORS_M)
    ]
    return {
        "study": "bds-tight",
        "runs": count,
        "seed": seed,
        "paper": PAPER,
        "duration_s": DURATION_S,
        "counted_from_s": COUNTED_S,
        "stretch_s": list(STRETCH_S),
        "most_pdop": MOST_PDOP,
        "availability_limit_m": LIMIT_M,
        "nees_dof": DOF,
        "nav_nees_dof": NAV_DOF,
        "nees_interval": nees_interval(count, DOF, 0.025),
        "nav_nees_interval": nees_interval(count, NAV_DOF, 0.025),
        "cases": cases,
        "sky": {case: _sky([r[0][case] for r in results]) for case in CASES},
        "three_satellites": three,
        "orbit_errors": orbits,
        "paper_case": own,
        "series": {case: _series([r[0][case] for r in results]) for case in CASES},
        "finding": _finding(cases, three, orbits, nees_interval(count, DOF, 0.025)[1])
        + _own_finding(own),
    }


# --------------------------------------------------------------------------- figures


def _case(case: str, runs: Sequence[CaseRun]) -> dict[str, Any]:
    t_s = epochs()
    counted, few = t_s >= COUNTED_S, in_stretch(t_s)
    found: dict[str, Any] = {}
    for row in ROWS:
        if row not in runs[0].traces:
            continue
        traces = [r.traces[row] for r in runs]
        found[row] = _figures(traces, counted) | {"stretch": _figures(traces, few)}
        if CASES[case] is not None and row != "receiver":
            found[row]["growth_m"] = _growth(traces, few)
    return found


def _sky(runs: Sequence[CaseRun]) -> dict[str, Any]:
    """Satellites and PDOP of the stretch; PDOP belongs to the least-squares solution."""
    few = in_stretch(epochs())
    pdop = np.concatenate([r.pdop[few] for r in runs])
    solved = pdop[np.isfinite(pdop)]
    return {
        "satellites_mean": float(np.mean([r.satellites[few].mean() for r in runs])),
        "pdop_median_of_solved": float(np.median(solved)) if solved.size else None,
        "pdop_within_limit": float(np.mean(pdop <= MOST_PDOP)),
    }


def _figures(traces: Sequence[Trace], which: Booleans) -> dict[str, Any]:
    error = np.concatenate([t.error[which] for t in traces])
    sigma = np.concatenate([t.sigma[which] for t in traces])
    nees = np.concatenate([t.nees[which] for t in traces])
    nav_nees = np.concatenate([t.nav_nees[which] for t in traces])
    with np.errstate(invalid="ignore"):
        good = sigma * math.sqrt(-math.log(0.05)) <= LIMIT_M
    return {
        "horizontal_rms_m": _or_none(np.hypot(error[:, 0], error[:, 1]), _rms),
        "vertical_rms_m": _or_none(error[:, 2], _rms),
        "nees_mean": _or_none(nees, np.mean),
        "nav_nees_mean": _or_none(nav_nees, np.mean),
        "solution_rate": float(np.isfinite(sigma).mean()),
        "availability": float(good.mean()),
    }


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _or_none(values: Array, figure: Callable[[Array], Any]) -> float | None:
    """Statistic of the values that exist, None without any."""
    there = values[np.isfinite(values)]
    return float(figure(there)) if there.size else None


def _growth(traces: Sequence[Trace], few: Booleans) -> dict[str, float]:
    last = int(np.flatnonzero(few)[0]) - 1
    per_s = 1.0 / float(np.diff(epochs()[:2])[0])
    horizontal = np.array([t.error[:, :2] - t.error[last, :2] for t in traces])
    return {
        f"{after:.0f}": _rms(np.linalg.norm(horizontal[:, last + round(after * per_s)], axis=1))
        for after in GROWTH_S
    }


def _orbit_figures(case: str, runs: Sequence[CaseRun]) -> dict[str, Any]:
    """Figures of the stretch, or of all counted epochs under the open sky."""
    t_s = epochs()
    which = t_s >= COUNTED_S if CASES[case] is None else in_stretch(t_s)
    found = {}
    for row in COMPARED:
        figures = _figures([r.traces[row] for r in runs], which)
        found[row] = {key: figures[key] for key in ("horizontal_rms_m", "nees_mean")}
    return found


def _series(runs: Sequence[CaseRun]) -> dict[str, Any]:
    """Horizontal RMS and mean NEES at each epoch; None where no run has a solution."""
    found: dict[str, Any] = {"t_s": epochs().tolist(), "horizontal_rms_m": {}, "nees_mean": {}}
    for row in ROWS:
        if row not in runs[0].traces:
            continue
        traces = [r.traces[row] for r in runs]
        off = np.array([np.hypot(t.error[:, 0], t.error[:, 1]) for t in traces])
        nees = np.array([t.nees for t in traces])
        found["horizontal_rms_m"][row] = [_or_none(column, _rms) for column in off.T]
        found["nees_mean"][row] = [_or_none(column, np.mean) for column in nees.T]
    return found


# --------------------------------------------------------------------------- for people


def _finding(
    cases: dict[str, Any], three: dict[str, Any], orbits: Sequence[dict[str, Any]], most: float
) -> str:
    """Finding as one sentence; `most` is the largest acceptable mean NEES."""

    def off(case: str, row: str, key: str = "horizontal_rms_m") -> str:
        return f"{cases[case][row]['stretch'][key]:.1f}"

    def nees(row: str, which: int = 0) -> str:
        found = orbits[which]["cases"]
        return ", ".join(f"{found[case][row]['nees_mean']:.1f}" for case in CASES)

    few = [case for case in CASES if case != "open"]
    tight, loose = (", ".join(off(case, row) for case in few) for row in ("tight_ekf", "loose"))
    first = f"{GROWTH_S[0]:.0f}"
    differ = max(
        abs(c["tight_ukf"]["horizontal_rms_m"] / c["tight_ekf"]["horizontal_rms_m"] - 1.0)
        for c in cases.values()
    )
    scaled = ", ".join(
        f"{(c if case == 'open' else c['stretch'])['nees_mean']:.1f}"
        for case, c in ((case, cases[case]["tight_scaled"]) for case in CASES)
    )

    def honest(row: str) -> str:
        found = orbits[0]["cases"]
        sure = [case for case in CASES if found[case][row]["nees_mean"] > most]
        return f"too small in {', '.join(sure)}" if sure else "nowhere too small"

    return (
        f"Under the open sky tight coupling gives {off('open', 'tight_ekf')} m, loose "
        f"{off('open', 'loose')} m, the receiver alone {off('open', 'receiver')} m; with 2, 3, 4 "
        f"street satellites tight gives {tight} m, loose {loose} m, coasting "
        f"{off('canyon3', 'coasting')} m; three satellites let the error grow in {first} s by "
        f"{three['ratio'][first]:.2f} of what coasting does; unscented and extended filter agree "
        f"to {100.0 * differ:.1f} %; tight's sigma is {honest('tight_ekf')} (NEES of {DOF} in "
        f"{', '.join(CASES)}: {nees('tight_ekf')}; with sigma_scale 2: {scaled}), loose's "
        f"{honest('loose')} ({nees('loose')}; without states for what fixes share "
        f"{nees('loose_white')}), for orbit errors last while rows are taken as white."
    )


def _own_finding(own: dict[str, Any]) -> str:
    g, ukf = own["gains"], own["rows"]["tight_ukf"]
    return (
        f" In the paper's own set-up ({own['model']}, Markov clock) the unscented filter has "
        f"{g['velocity']:.1f} times less velocity error than the receiver (climb "
        f"{g['climb']:.1f}), {g['position']:.2f} times less position error (height "
        f"{g['height']:.2f}), and {g['tilt']:.1f} and {g['heading']:.1f} times less error of tilt "
        f"and heading than the inertial unit alone, at a NEES of {ukf['nees_per_dof']:.2f} a "
        "degree."
    )


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Tables: all epochs; the stretch with its growth; the smaller orbit errors."""
    low, high = result["nees_interval"]
    first, last = result["stretch_s"]
    header = ["case", "row", "horizontal m", "vertical m", "NEES", "available", "solution"]
    every, few = _by_case(result["cases"])
    orbits = []
    for entry in result["orbit_errors"]:
        for case, found in entry["cases"].items():
            figures = [
                _text(found[row][key])
                for row in COMPARED
                for key in ("horizontal_rms_m", "nees_mean")
            ]
            orbits.append([f"{entry['orbit_error_m']:.1f}", case, *figures])
    own = result["paper_case"]
    mine = [
        [row.replace("_", " "), *(_text(figures[key]) for key in paper_setup.COLUMNS.values())]
        for row, figures in own["rows"].items()
    ]
    mine.append(["gain", *(_text(own["gains"].get(key)) for key in paper_setup.COLUMNS.values())])
    grown = [f"grown {s:.0f} s" for s in GROWTH_S]
    by_row = [f"{row.replace('_', ' ')} {what}" for row in COMPARED for what in ("m", "NEES")]
    return [
        (
            f"{result['runs']} runs of {result['duration_s']:.0f} s, from "
            f"{result['counted_from_s']:.0f} s on; NEES of {result['nees_dof']} degrees, mean of "
            f"one instant in [{low:.2f}, {high:.2f}]; available: 95 % within "
            f"{result['availability_limit_m']:.0f} m stated",
            header,
            every,
        ),
        (f"The same from {first:.0f} to {last:.0f} s", [*header, *grown], few),
        (
            "By the size of orbit and clock errors: stretch, or all that counts of open",
            ["orbits m", "case", *by_row],
            orbits,
        ),
        (
            f"The paper's set-up, {own['model']}, {own['west_m']:.0f} m west and "
            f"{own['up_m']:.0f} m up",
            ["", *paper_setup.COLUMNS],
            mine,
        ),
    ]


def _by_case(cases: dict[str, Any]) -> tuple[list[list[str]], list[list[str]]]:
    """Rows of all epochs, and of the stretch with its growth."""
    keys = ("horizontal_rms_m", "vertical_rms_m", "nees_mean", "availability", "solution_rate")
    every, few = [], []
    for case, found in cases.items():
        for row in ROWS:
            if row not in found:
                continue
            name, figures = row.replace("_", " "), found[row]
            every.append([case, name, *(_text(figures[key]) for key in keys)])
            if case != "open":
                growth = figures.get("growth_m", {})
                stretch = (_text(figures["stretch"][key]) for key in keys)
                few.append(
                    [case, name, *stretch, *(_text(growth.get(f"{s:.0f}")) for s in GROWTH_S)]
                )
    return every, few


def _text(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if abs(value) >= 0.1 or value == 0.0 else f"{value:.2g}"


TITLES = {
    "open": "open sky",
    "canyon2": "street canyon, two satellites",
    "canyon3": "street canyon, three satellites",
    "canyon4": "street canyon, four satellites",
}


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the horizontal RMS and mean NEES over time, one row a case, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    series = result["series"]
    figure = Figure(figsize=(11.0, 2.8 * (len(series) + 3)), layout="constrained")
    low, high = result["nees_interval"]
    panels = figure.subplots(len(series) + 3, 2)
    paper_setup.draw(panels[len(series) :], result["paper_case"]["series"])
    for axes, (case, s) in zip(panels, series.items(), strict=False):
        for ax, key in zip(axes, ("horizontal_rms_m", "nees_mean"), strict=True):
            for row, values in s[key].items():
                wide = 4.0 if row == "tight_ekf" else 1.3  # the unscented filter lies on it
                ax.plot(
                    s["t_s"],
                    np.array(values, dtype=np.float64),
                    linewidth=wide,
                    alpha=0.4 if wide > 2.0 else 0.9,
                    label=row.replace("_", " "),
                )
            if case != "open":
                ax.axvspan(*result["stretch_s"], alpha=0.08, color="black")
            ax.set_yscale("log")
            ax.set_xlim(result["counted_from_s"], result["duration_s"])
            ax.set_xlabel("s")
            ax.grid(alpha=0.3)
        axes[0].set_title(TITLES[case], loc="left")
        axes[0].set_ylabel("horizontal RMS, m")
        axes[1].axhspan(low, high, alpha=0.15)
        axes[1].set_ylabel(f"mean NEES, {result['nees_dof']} degrees of freedom")
        axes[0].legend(fontsize="small")
    save_figure(figure, path)
