r"""Study `papers`: every shipped model live, its NEES by position, velocity and attitude.

Each paper's vehicle (`fusiond.simulation.papers`) is simulated to files and goes through the
daemon's navigator (`fusiond.offline.process`) with the paper's model, and with the others that fit
it; then one car with an inertial unit of class `mems` by each model. Once a second from `SETTLED_S`
after the start on, and for each group g of the navigation errors

    nees_g = x_g^T P_gg^-1 x_g / dim(x_g)

x the error, P the serving filter's covariance, and what axes out of square turn the attitude by. 1
is honest, and `HONEST` what is asked of the mean over runs. An attitude in error stays so for a
run, which then counts as one draw: `nees_error` is one sigma of the mean by the scatter of the
runs. Beside it the root mean squares of the errors and of the published sigmas, which have what
faults may have left as well.

A model of a paper that has no states for scale factors flies a unit without them, as the paper's;
the car's unit has all that its class has.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fusiond.configuration.schema import Config
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.papers import NO_SCALES, PAPERS, WHITE, configured, level_town, town
from fusiond.simulation.scenarios import Scenario
from fusiond.studies.federated import without_imu
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, map_runs, run_generator, step_counter
from fusiond.studies.navigation_error import nav_error, true_nav

DEFAULT_RUNS = 12
SETTLED_S, EVERY_S = 30.0, 1.0
HONEST = (0.7, 1.4)
GROUPS = {"position": slice(6, 9), "velocity": slice(3, 6), "attitude": slice(0, 3)}
IN_DEGREES = {"attitude": math.degrees(1.0)}
KIND_OF = {"gnss": "gnss", "star_tracker": "attitude", "sar": "bearing", "rdss": "rdss"}
"""Kind of measurement by a device's file."""
MEMS = {"axes": ("+x", "-y", "-z"), "rate_hz": 100.0, "sensor_class": "mems"}


@dataclass(frozen=True)
class Case:
    """Case of a model on a paper's vehicle: changes of its configuration, and duration."""

    paper: str
    label: str
    more: dict[str, Any] = field(default_factory=dict)
    seconds: float = 150.0
    raw: bool = False
    mems: bool = False

    def made(self) -> tuple[Config, Scenario]:
        """Configuration and vehicle of the case."""
        if not self.mems:
            return configured(self.paper, self.more)
        config, scenario = configured("004", self.more)
        as_class = config.model_dump(exclude_unset=True) | {"imu": MEMS}
        config = Config.model_validate(as_class)
        path = level_town if config.estimator.model.startswith("planar") else town
        return config, replace(scenario, path=path).fitted(config)


def _filter(model: str, name: str = "kalman") -> dict[str, Any]:
    return {"estimator": {"model": model, "filter": name}}


def _fixes(model: str) -> dict[str, Any]:
    """Vehicle of a paper whose receiver gives fixes instead of ranges."""
    return {**_filter(model), "aiding": {"gnss": {"kind": "gnss", **WHITE}}}


UNCORRELATED = {
    "estimator": {
        "model": "ins21",
        "filter": "federated",
        "federated": {"fusion": "uncorrelated"},
    }
}
CASES: dict[str, Case] = {
    "000 planar15": Case("000", "RDSS, optimal prediction", seconds=200.0),
    "001 planar10": Case("001", "fixes, star tracker, kalman", _filter("planar10"), 200.0),
    "001 planar10 multiscale": Case("001", "the same, multiscale", seconds=200.0),
    "001 planar10 federated": Case(
        "001", "the same, federated", _filter("planar10", "federated"), 200.0
    ),
    "002 ins23": Case("002", "ranges, star tracker, SAR", raw=True),
    "002 ins17": Case("002", "the same", _filter("ins17"), raw=True),
    "002 ins23 fixes": Case("002", "fixes, star tracker, SAR", _fixes("ins23")),
    "002 ins17 fixes": Case("002", "the same", _fixes("ins17")),
    "003 ins20": Case("003", "BeiDou ranges", raw=True),
    "003 ins20 fixes": Case("003", "fixes", _fixes("ins20")),
    "004 ins21 correlated": Case("004", "fixes and RDSS, federated, correlated"),
    "004 ins21 uncorrelated": Case("004", "the same, uncorrelated", UNCORRELATED),
    "004 ins21": Case("004", "the same, kalman", _filter("ins21")),
    "004 ins15": Case("004", "the same, kalman", {**_filter("ins15"), "imu": NO_SCALES}),
    **{
        f"mems {model}": Case("004", "fixes and RDSS, kalman", _filter(model), mems=True)
        for model in ("ins15", "ins17", "ins20", "ins21", "ins23", "planar10", "planar15")
    },
    **{
        f"mems {model} federated": Case(
            "004", "the same, federated", _filter(model, "federated"), mems=True
        )
        for model in ("ins17", "planar10")
    },
}
WITHOUT_IMU = "004 constant velocity"


class _Watch:
    """Errors of the active filter over its covariance, once a second."""

    def __init__(self, scenario: Scenario, seconds: float) -> None:
        self._truth = scenario.truth(seconds)
        self._last_s = -math.inf
        self.nees: dict[str, list[float]] = {name: [] for name in GROUPS}
        self.squares: dict[str, list[tuple[float, float]]] = {name: [] for name in GROUPS}

    def __call__(self, navigator: Navigator) -> None:
        e, start = navigator.active_filter, navigator.started
        t_s = e.t_ns * 1e-9
        if start is None or t_s < max(start.t_ns * 1e-9 + SETTLED_S, self._last_s + EVERY_S):
            return
        self._last_s = t_s
        x = nav_error(e.nav, true_nav(self._truth, np.array([t_s]))[0])
        sigmas = e.sigmas()  # position, velocity, then roll, pitch, yaw
        for (name, columns), first in zip(GROUPS.items(), (0, 3, 6), strict=True):
            slots = np.flatnonzero(navigator.model.active[columns]) + columns.start
            own = x[slots]
            stated = sigmas[first + slots - columns.start]
            p = e.covariance[np.ix_(slots, slots)].copy()
            if name == "attitude":
                p += np.eye(len(slots)) * e.published.axes_sd_rad**2
            self.nees[name].append(float(own @ np.linalg.solve(p, own)) / len(slots))
            self.squares[name].append((float(own @ own), float(stated @ stated)))


def run_case(case: str, seed: int, number: int) -> dict[str, float]:
    """Run `number` of a case of `CASES`: by group mean NEES a degree, RMS error and RMS sigma."""
    of = CASES[case]
    config, scenario = of.made()
    draws = int(run_generator(seed, number).generate_state(1)[0])
    watch = _Watch(scenario, of.seconds)
    with TemporaryDirectory(prefix="fusiond-study-") as folder:
        devices = PAPERS[of.paper].devices
        raw = PAPERS[of.paper].raw if of.raw else None
        made = simulate(scenario, Path(folder), draws, of.seconds, gnss_raw=raw)
        files = [
            ("raw", made.files["raw"]) if of.raw and source == "gnss" else (kind, made.files[kind])
            for source, kind in KIND_OF.items()
            if source in devices and kind in made.files
        ]
        process(config, made.files["imu"], files, watch=watch)
    return _row(watch.nees, watch.squares)


def without_imu_run(seed: int, number: int) -> dict[str, float]:
    """Run `number` of paper 004's two receivers without an inertial unit."""
    rng = np.random.default_rng([seed, 41, number])
    fixes, _ = without_imu.arrivals("4_active_and_passive", rng)
    config = without_imu.config_of(
        "4_active_and_passive", without_imu.FILTERS["federated, correlated"]
    )
    course = without_imu.fly(config, fixes)
    nees: dict[str, list[float]] = {}
    squares: dict[str, list[tuple[float, float]]] = {}
    for name, part in (("velocity", [0, 1]), ("position", [2, 3])):
        x, p = course.x[:, part], course.p[:, part][:, :, part]
        nees[name] = (
            np.einsum("ki,ki->k", x, np.linalg.solve(p, x[..., None])[..., 0]) / 2.0
        ).tolist()
        squares[name] = list(
            zip((x * x).sum(axis=1).tolist(), np.trace(p, axis1=1, axis2=2).tolist(), strict=True)
        )
    return _row(nees, squares)


def _row(
    nees: dict[str, list[float]], squares: dict[str, list[tuple[float, float]]]
) -> dict[str, float]:
    row: dict[str, float] = {}
    for name, values in nees.items():
        if not values:
            raise RuntimeError("nothing was navigated")
        error, stated = np.sqrt(np.mean(squares[name], axis=0)) * IN_DEGREES.get(name, 1.0)
        row |= {
            f"{name}_nees": float(np.mean(values)),
            f"{name}_rms": float(error),
            f"{name}_sigma": float(stated),
        }
    return row


def run_study(
    runs: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    cases: tuple[str, ...] = (*CASES, WITHOUT_IMU),
) -> dict[str, Any]:
    """Run the study with `runs` of each case. Equal arguments give equal results."""
    count = DEFAULT_RUNS if runs is None else runs
    advance = step_counter(progress, len(cases) * count)
    found: dict[str, Any] = {}
    for name in cases:
        work: Callable[[int], dict[str, float]] = (
            partial(without_imu_run, seed) if name == WITHOUT_IMU else partial(run_case, name, seed)
        )
        rows = map_runs(work, count, advance)
        of = CASES.get(name)
        found[name] = {
            "with": "fixes and RDSS, federated, correlated" if of is None else of.label,
            "groups": {group: _mean(rows, group) for group in GROUPS if f"{group}_nees" in rows[0]},
        }
    result: dict[str, Any] = {
        "study": "papers",
        "runs": count,
        "seed": seed,
        "settled_s": SETTLED_S,
        "honest": list(HONEST),
        "cases": found,
    }
    result["finding"] = _finding(result)
    return result


def _mean(rows: list[dict[str, float]], group: str) -> dict[str, Any]:
    nees = np.array([row[f"{group}_nees"] for row in rows])
    return {
        "nees": float(nees.mean()),
        "nees_error": float(nees.std(ddof=1) / math.sqrt(len(nees))),
        "nees_of_runs": nees.tolist(),
        **{
            key: float(np.sqrt(np.mean([row[f"{group}_{key}"] ** 2 for row in rows])))
            for key in ("rms", "sigma")
        },
    }


# --------------------------------------------------------------------------- for people


def _finding(result: dict[str, Any]) -> str:
    low, high = HONEST
    outside = [
        f"{name} {group} {of['nees']:.2f}"
        for name, case in result["cases"].items()
        for group, of in case["groups"].items()
        if not low <= of["nees"] <= high
    ]
    groups = sum(len(case["groups"]) for case in result["cases"].values())
    said = f"NEES a degree of {groups - len(outside)} of {groups} lies in [{low:g}, {high:g}]"
    return f"{said}; outside: {', '.join(outside)}" if outside else said


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """NEES a degree, and error beside sigma, of each case."""
    header = ["model", "with", *(f"{group} NEES" for group in GROUPS), *_units()]
    rows = []
    for name, case in result["cases"].items():
        of = case["groups"]
        rows.append(
            [
                name,
                case["with"],
                *(
                    f"{of[g]['nees']:.2f} +- {of[g]['nees_error']:.2f}" if g in of else ""
                    for g in GROUPS
                ),
                *(f"{of[g]['rms']:.3g}/{of[g]['sigma']:.3g}" if g in of else "" for g in GROUPS),
            ]
        )
    title = (
        f"{result['runs']} runs of each, from {result['settled_s']:g} s after the start on: NEES a "
        "degree and one sigma of that mean, RMS error / RMS sigma"
    )
    return [(title, header, rows)]


def _units() -> list[str]:
    return ["m", "m/s", "deg"]


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot NEES a degree of each run, by case and group, to `path`."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (extra `[studies]`)

    figure = Figure(figsize=(9.0, 1.0 + 0.35 * len(result["cases"])), layout="constrained")
    axes = figure.add_subplot()
    names = list(result["cases"])
    for number, group in enumerate(GROUPS):
        for row, name in enumerate(names):
            of = result["cases"][name]["groups"].get(group)
            if of is not None:
                at = [row + 0.25 * (number - 1)] * len(of["nees_of_runs"])
                label = group if row == 0 else None
                axes.plot(of["nees_of_runs"], at, ".", color=f"C{number}", label=label)
                axes.plot([of["nees"]], at[:1], "|", color=f"C{number}", markersize=12)
    axes.axvspan(*result["honest"], color="0.9")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("NEES a degree: runs and their mean; shaded what is asked")
    axes.legend()
    save_figure(figure, path)
