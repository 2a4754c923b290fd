r"""Study `federated`: the four experiments of paper 004, and faults in one of three local filters.

Experiments: `fusiond.studies.federated.linear_experiments` (1 to 3),
`fusiond.studies.federated.experiment_4` (4, with an inertial unit),
`fusiond.studies.federated.without_imu` (3 and 4 live, as the paper has them). Faults and honesty:
`fusiond.studies.federated.runs`. A fault lasts 100 s; errors count from its start to the end of the
run, 70 s after its end, so that the recovery counts too. `detected_after_s` is the median over the
runs; a run without detection counts as later than any other.

`centralised` is the daemon's default: one filter, and sources judged by their innovations over time
(`fusiond.integrity.diagnosis`). `rms_centralised_gate_only_m` has the gate alone.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.federated.options import FederatedOptions
from fusiond.studies.federated import experiment_4, linear_experiments, without_imu
from fusiond.studies.federated.runs import (
    DRIFT_M_S,
    DURATION_S,
    EQUAL_M,
    FAULT_END_S,
    FAULT_START_S,
    NEES_DOF,
    STEP_M,
    UNEQUAL_M,
    FaultKind,
    Filter,
    Trace,
    grid,
    monte_carlo,
)
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, map_runs, nees_interval, step_counter

Array = NDArray[np.float64]

DEFAULT_RUNS = 50
PAPER = {
    "source": "paper 004: experiments 1 to 4, shown as pictures without figures",
    "experiments": ["random truth", "constant truth", "two sensors", "active and passive"],
}
FAULTS: tuple[FaultKind, ...] = ("step", "drift", "frozen")
MODES = ("no_reset", "fusion_reset", "zero_reset", "rescale")
HONEST_FROM_S = 20.0
_CENTRALISED, _UNISOLATED, _GATE_ONLY = "centralised", "unisolated", "centralised_gate_only"
FILTERS = (
    *(Filter(mode, FederatedOptions(mode=mode)) for mode in MODES),  # type: ignore[arg-type]
    Filter("adaptive", FederatedOptions(adaptive=True)),
    Filter(_CENTRALISED, isolates=True),
)
FAULT_FILTERS = (
    *FILTERS,
    Filter(_UNISOLATED, FederatedOptions(fault_detection=False)),
    Filter(_GATE_ONLY),
)


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` Monte Carlo runs (default 50) of each part. It repeats exactly."""
    count = runs or DEFAULT_RUNS
    if count < 2:
        raise ValueError("runs must be at least 2")
    step = step_counter(progress, count * (len(FAULTS) + 5))
    honest = {
        name: _honesty(monte_carlo((*FILTERS, Filter(_GATE_ONLY)), "", sd_m, count, seed, step))
        for name, sd_m in (("equal", EQUAL_M), ("unequal", UNEQUAL_M))
    }
    faults, series = {}, {}
    for fault in FAULTS:
        found = monte_carlo(FAULT_FILTERS, fault, EQUAL_M, count, seed, step)
        faults[fault], series[fault] = _fault(found), _course(found)
    result = {
        "study": "federated",
        "runs": count,
        "seed": seed,
        "paper": PAPER,
        "experiments": {
            "1_random_truth": linear_experiments.random_truth(count, seed),
            "2_constant_truth": linear_experiments.constant_truth(count, seed),
            "3_two_sensors": linear_experiments.two_sensors(count, seed),
            "4_active_and_passive": experiment_4.experiment_4(
                map_runs(partial(experiment_4.simulate, seed), count, step)
            ),
        },
        "without_imu": {
            name: without_imu.result(
                map_runs(partial(without_imu.simulate, name, seed), count, step)
            )
            for name in without_imu.EXPERIMENTS
        },
        "sources_sd_m": {"equal": list(EQUAL_M), "unequal": list(UNEQUAL_M)},
        "fault": {
            "start_s": FAULT_START_S,
            "end_s": FAULT_END_S,
            "run_s": DURATION_S,
            "step_m": STEP_M,
            "drift_m_s": DRIFT_M_S,
        },
        "honesty": honest,
        "faults": faults,
        "series": {"t_s": grid()[0].tolist(), "horizontal_rms_m": series},
    }
    return {**result, "finding": _finding(result)}


def _horizontal(found: list[dict[str, Trace]], name: str) -> Array:
    """Horizontal errors (runs, m) in metres."""
    return np.array([np.hypot(*traces[name].error[:, 6:8].T) for traces in found])


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _honesty(found: list[dict[str, Trace]]) -> dict[str, Any]:
    counted = grid()[0] >= HONEST_FROM_S
    return {
        "nees_dof": NEES_DOF,
        "nees_interval": nees_interval(len(found), NEES_DOF),
        "filters": {
            name: {
                "nees_mean": float(np.mean([traces[name].nees for traces in found])),
                "horizontal_rms_m": _rms(_horizontal(found, name)[:, counted]),
                "false_alarms": sum(traces[name].false_alarms for traces in found),
            }
            for name in found[0]
        },
    }


def _fault(found: list[dict[str, Trace]]) -> dict[str, Any]:
    counted = grid()[0] >= FAULT_START_S
    rms = {name: _rms(_horizontal(found, name)[:, counted]) for name in found[0]}
    modes = {
        name: {
            **_detected(found, name),
            "rms_m": rms[name],
            "false_alarms": sum(traces[name].false_alarms for traces in found),
        }
        for name in (*MODES, "adaptive")
    }
    return {
        "detected_after_s": modes["no_reset"]["detected_after_s"],
        "detected_rate": modes["no_reset"]["detected_rate"],
        "rms_isolated_m": rms["no_reset"],
        "rms_unisolated_m": rms[_UNISOLATED],
        "rms_centralised_m": rms[_CENTRALISED],
        "rms_centralised_gate_only_m": rms[_GATE_ONLY],
        "modes": modes,
    }


def _detected(found: list[dict[str, Trace]], name: str) -> dict[str, Any]:
    after = np.array([traces[name].isolated_s - FAULT_START_S for traces in found])
    median = float(np.median(np.where(np.isnan(after), np.inf, after)))
    return {
        "detected_after_s": median if math.isfinite(median) else None,
        "detected_rate": float(np.mean(~np.isnan(after))),
    }


def _course(found: list[dict[str, Trace]]) -> dict[str, list[float]]:
    names = ("no_reset", "fusion_reset", _UNISOLATED, _CENTRALISED, _GATE_ONLY)
    return {n: np.sqrt(np.mean(_horizontal(found, n) ** 2, axis=0)).tolist() for n in names}


def _finding(result: dict[str, Any]) -> str:
    parts = []
    for name, f in result["faults"].items():
        after = "never" if f["detected_after_s"] is None else f"after {f['detected_after_s']:g} s"
        parts.append(
            f"{name} {after}, {f['rms_isolated_m']:.2f} m with isolation, "
            f"{f['rms_unisolated_m']:.1f} m without, {f['rms_centralised_m']:.1f} m centralised "
            f"({f['rms_centralised_gate_only_m']:.2f} m with its gate alone)"
        )
    unequal = result["honesty"]["unequal"]
    drift = result["faults"]["drift"]["modes"]["fusion_reset"]
    low, high = unequal["nees_interval"]
    delay_s = drift["detected_after_s"]
    sees = "never" if delay_s is None else f"after {delay_s:g} s"
    return (
        f"Three local filters, one faulty: {'; '.join(parts)}; without reset the NEES with unequal "
        f"sources is {unequal['filters']['no_reset']['nees_mean']:.1f} (centralised and fusion "
        f"reset {unequal['filters']['fusion_reset']['nees_mean']:.1f}, {low:.1f} to {high:.1f} "
        f"expected); fusion reset sees the drift {sees} and has {drift['rms_m']:.2f} m."
    )


# --------------------------------------------------------------------------- for people


Table = tuple[str, list[str], list[list[str]]]


def tables(result: dict[str, Any]) -> list[Table]:
    """Title, header and rows of each part, for `fusiond study`."""
    return [
        *_experiment_tables(result["experiments"]),
        *(_live_table(name, live) for name, live in result["without_imu"].items()),
        *(_honesty_table(name, honest) for name, honest in result["honesty"].items()),
        *(_fault_table(name, fault) for name, fault in result["faults"].items()),
    ]


def _experiment_tables(e: dict[str, Any]) -> list[Table]:
    one, two = e["1_random_truth"], e["2_constant_truth"]
    return [
        (
            "1 random truth, 2 constant truth",
            ["", "m"],
            [
                ["1: measured, RMS", f"{one['measured_rms_m']:.2f}"],
                ["1: filtered, RMS", f"{one['filtered_rms_m']:.2f}"],
                ["1: sigma stated", f"{one['filter_sigma_m']:.2f}"],
                *(
                    [f"2: RMS after {k} (theory {theory:.2f})", f"{rms:.2f}"]
                    for k, rms, theory in zip(
                        two["after_steps"], two["rms_m"], two["theory_m"], strict=True
                    )
                ),
            ],
        ),
        (
            "3 two sensors and their fusion",
            ["", "RMS m", "sigma m", "NEES (2)"],
            [
                [name, *(f"{f[key]:.2f}" for key in ("rms_m", "sigma_m", "nees_mean"))]
                for name, f in e["3_two_sensors"]["estimates"].items()
            ],
        ),
        (
            "4 active and passive receiver on one platform",
            ["", "horizontal RMS m"],
            [
                [name.removesuffix("_rms_m"), f"{value:.2f}"]
                for name, value in e["4_active_and_passive"].items()
            ],
        ),
    ]


def _live_table(name: str, live: dict[str, Any]) -> Table:
    low, high = live["nees_interval"]
    rows = [[f"{s} fixes", f"{rms:.2f}", "", ""] for s, rms in live["fixes_rms_m"].items()]
    for label, f in live["estimates"].items():
        values = (f[key] for key in ("rms_m", "sigma_m", "nees_mean"))
        rows.append([label, *(f"{value:.2f}" for value in values)])
    title = f"{name.replace('_', ' ')}, live, without an inertial unit; NEES of 4 within"
    header = ["", "horizontal RMS m", "sigma m", "NEES (4)"]
    return f"{title} [{low:.2f}, {high:.2f}]", header, rows


def _honesty_table(name: str, honest: dict[str, Any]) -> Table:
    low, high = honest["nees_interval"]
    title = f"no fault, {name} sources; NEES of {honest['nees_dof']} within [{low:.2f}, {high:.2f}]"
    rows = [
        [n, f"{f['horizontal_rms_m']:.2f}", f"{f['nees_mean']:.2f}", str(f["false_alarms"])]
        for n, f in honest["filters"].items()
    ]
    return title, ["", "horizontal RMS m", "NEES", "false alarms"], rows


def _fault_table(name: str, fault: dict[str, Any]) -> Table:
    rows = [
        [
            mode,
            "" if f["detected_after_s"] is None else f"{f['detected_after_s']:g}",
            f"{f['rms_m']:.2f}",
        ]
        for mode, f in fault["modes"].items()
    ]
    rows.append(["no isolation", "", f"{fault['rms_unisolated_m']:.2f}"])
    rows.append(["centralised", "", f"{fault['rms_centralised_m']:.2f}"])
    rows.append(["centralised, gate alone", "", f"{fault['rms_centralised_gate_only_m']:.2f}"])
    return f"fault: {name}", ["", "isolated after s", "horizontal RMS m"], rows


def _experiment(key: str) -> str:
    number, _, words = key.partition("_")
    return f"experiment {number}: {words.replace('_', ' ')}"


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot experiments 1 to 4 as the paper's figures, and the courses of the faults, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(9.0, 19.0), layout="constrained")
    axes = figure.subplots(7, 1)
    for panel, (key, live) in zip(axes[5:], result["without_imu"].items(), strict=True):
        _ways(panel, live["series"])
        panel.set_title(f"{_experiment(key)}, no inertial unit", loc="left")
    for panel, key in zip(axes[:2], ("1_random_truth", "2_constant_truth"), strict=True):
        for name, values in result["experiments"][key]["series"].items():
            panel.plot(values, linewidth=0.6 if name == "measured" else 1.6, label=name)
        panel.set_title(_experiment(key), loc="left")
        panel.set_xlabel("step")
        panel.set_ylabel("state, m")
    for panel, fault in zip(axes[2:5], FAULTS, strict=True):
        for name, values in result["series"]["horizontal_rms_m"][fault].items():
            panel.plot(result["series"]["t_s"], values, label=name.replace("_", " "))
        panel.axvspan(result["fault"]["start_s"], result["fault"]["end_s"], alpha=0.1)
        panel.set_yscale("log")
        panel.set_ylim(top=10.0 * panel.get_ylim()[1])  # room for the legend
        panel.set_title(f"fault in one of three sources: {fault}", loc="left")
        panel.set_xlabel("s")
        panel.set_ylabel("horizontal RMS, m")
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small", ncols=5, loc="upper left")
    save_figure(figure, path)


def _ways(panel: Any, series: dict[str, Any]) -> None:
    """Plot figures 3 and 4: true path, fixes of each receiver, and fused paths."""
    for name, fixes in series["fixes"].items():
        north, east = zip(*fixes, strict=True)
        panel.plot(east, north, ".", markersize=2.5, label=f"{name} fixes")
    fused = "federated, correlated"
    north, east = zip(*series["ways"][fused], strict=True)
    panel.plot(east, north, linewidth=1.6, label=fused)
    north, east = zip(*series["truth"], strict=True)
    panel.plot(east, north, "k", linewidth=0.8, label="truth")
    panel.set_xlabel("east, m")
    panel.set_ylabel("north, m")
    panel.set_aspect("equal", adjustable="datalim")
