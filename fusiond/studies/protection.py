r"""Study `protection`: rate of errors beyond the protection levels, and cost of the levels.

A car drives through a town with two GNSS receivers, the second one poorer, and RDSS. One receiver
or none is at fault for a minute: a step, a ramp, or a swing that its gate lets pass. The navigator
is the daemon's, with alert limits set, so that its subsets are kept. Levels are taken each second
from `SETTLED_S` on, twice: at the configured risk, by which `available` is the share of seconds
with both levels inside the limits; and at a risk so coarse that misses can be counted,
`SAMPLE_RISK`, by which `beyond` is the share of seconds with an error beyond its level, horizontal
or vertical.

`allowed` is what `beyond` may be: the risk of a sample without a fault, and that risk over the
prior with one, as drives with a fault are drawn for certain and not with their prior. `interval` is
exact at 99 % (Clopper-Pearson) for independent seconds; errors last for some, so it is too narrow.

`correlation_s` is the integrated autocorrelation time of the horizontal error over its sigma
without a fault, which `INDEPENDENT_PER_HOUR` stands on. `cost_ratio` is the processor time of the
same drives without subsets and levels that those with them take.

Source: fusiond.integrity.protection.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from drivers.measurements import PositionFix
from fusiond.configuration.schema import Config
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.integrity.protection import INDEPENDENT_PER_HOUR, IntegrityRisk, filter_protection
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.gnss.receiver import GnssReceiver
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.scenarios import SCENARIOS
from fusiond.studies.faults.runs import VEHICLE
from fusiond.studies.faults.sensor_data import DURATION_S, Drive, Recording, gnss_fixes
from fusiond.studies.figure_file import save_figure
from fusiond.studies.monte_carlo import Progress, map_runs, step_counter
from fusiond.studies.navigation_error import nav_error, true_nav

Array = NDArray[np.float64]

DEFAULT_RUNS = 20
LIMITS_M = (40.0, 40.0)
"""Horizontal and vertical alert limit: the vertical one of LPV approaches is 50 m (ICAO annex 10),
and a car asks for no less than an aircraft."""
SAMPLE_RISK, PRIOR = 1e-2, 0.1
"""Coarse probabilities: risk of a second without a fault, and of a fault."""
BEGIN_S, END_S = 80.0, 140.0
POOR = 2.0
"""Sigma of the second receiver over that of the first."""
SETTLED_S = 40.0
CONFIDENCE = 0.99
TICKS_PER_S = 10
MOST_DRIVES = 1_000_000
EARTH_M = 6_378_137.0
"""Metres north of a radian; a fault of 100 m need not be exact to a metre."""


@dataclass(frozen=True, slots=True)
class Case:
    """Fault: a device, and its position's offset to the north."""

    name: str
    source: str = ""
    size_m: float = 0.0
    shape: str = "none"

    def error_m(self, since_s: float) -> float:
        """Offset (m) at a time (s) after the fault began."""
        if self.shape == "step":
            return self.size_m
        if self.shape == "ramp":
            return self.size_m * since_s / (END_S - BEGIN_S)
        return self.size_m * math.sin(2.0 * math.pi * since_s / 20.0)


NO_FAULT = Case("none")
CASES = (
    NO_FAULT,
    Case("gnss step 8 m", "gnss", 8.0, "step"),
    Case("gnss step 100 m", "gnss", 100.0, "step"),
    Case("gnss ramp to 60 m", "gnss", 60.0, "ramp"),
    Case("gnss swing of 6 m", "gnss", 6.0, "swing"),
    Case("second ramp to 60 m", "second", 60.0, "ramp"),
    Case("second step 500 m", "second", 500.0, "step"),
)


def vehicle(watched: bool) -> Config:
    """Vehicle with its two receivers, with or without alert limits."""
    settings = VEHICLE.model_dump(exclude_unset=True)
    settings["aiding"]["second"] = {**settings["aiding"]["gnss"], "kind": "gnss"}
    if watched:
        settings["integrity"] = {
            "horizontal_alert_limit_m": LIMITS_M[0],
            "vertical_alert_limit_m": LIMITS_M[1],
        }
    return Config.model_validate(settings)


def coarse(devices: int) -> IntegrityRisk:
    """Coarse risk by which misses are counted."""
    hour = SAMPLE_RISK * INDEPENDENT_PER_HOUR
    return IntegrityRisk(hour, hour, (PRIOR,) * devices)


def recorded(case: Case, seed: int) -> tuple[Truth, Recording]:
    """Drive with a second receiver, and the case's fault."""
    truth, recording = Drive(gnss_rate_hz=1.0).recorded(VEHICLE, seed)
    first = SCENARIOS["drive"].gnss
    horizontal, vertical = first.white_sd_m
    poorer = replace(first, rate_hz=1.0, white_sd_m=(POOR * horizontal, POOR * vertical))
    receiver = GnssReceiver(truth, poorer, np.random.default_rng([seed, 1]))
    received = [*recording.received]
    for r in gnss_fixes(receiver):
        received.append(replace(r, measurement=replace(r.measurement, source="second")))
    for k, r in enumerate(received):
        m, t_s = r.measurement, r.t_ns * 1e-9
        if m.source == case.source and BEGIN_S <= t_s < END_S and isinstance(m, PositionFix):
            lat = m.lat_rad + case.error_m(t_s - BEGIN_S) / EARTH_M
            received[k] = replace(r, measurement=replace(m, lat_rad=lat))
    return truth, recording.with_received(received)


def drive(case: Case, watched: bool, seed: int) -> dict[str, Array]:
    """Columns by second: error over sigma north and east, whether an error was beyond its coarse
    level, whether the configured levels were inside the limits, the levels; and processor time."""
    truth, recording = recorded(case, seed)
    navigator = Navigator(vehicle(watched))
    estimator = navigator.estimator
    rows: list[tuple[float, ...]] = []
    received, given, taken = recording.received, 0, 0
    began = time.process_time()
    for tick in range(1, round(DURATION_S * TICKS_PER_S)):
        now_ns = tick * (1_000_000_000 // TICKS_PER_S)
        end = int(np.searchsorted(recording.imu_seen, now_ns, side="right"))
        navigator.add_imu(recording.stamps[given:end], recording.samples[given:end])
        given = end
        while taken < len(received) and received[taken].seen_ns <= now_ns:
            item = received[taken]
            taken += 1
            navigator.add(item.measurement, item.t_ns, 0.0, item.seen_ns)
        navigator.advance()
        bound = navigator.solution(now_ns).bound
        if tick % TICKS_PER_S or tick < SETTLED_S * TICKS_PER_S or navigator.started is None:
            continue
        if isinstance(estimator, SeparatedEstimator):
            at_s = np.array([estimator.t_ns * 1e-9])
            off = np.abs(nav_error(estimator.nav, true_nav(truth, at_s)[0])[6:9])
            covariances, devices = estimator.covariances(), len(estimator.devices)
            level = filter_protection(covariances, estimator.separations(), coarse(devices))
            assert level.vpl_m is not None
            sigma = np.sqrt(np.diag(covariances[0]))
            missed = math.hypot(off[0], off[1]) > level.hpl_m or off[2] > level.vpl_m
            inside = bound.hpl_m <= LIMITS_M[0] and bound.vpl_m <= LIMITS_M[1]
            signed = nav_error(estimator.nav, true_nav(truth, at_s)[0])[6:8] / sigma[:2]
            rows.append((*signed, missed, inside, bound.hpl_m, bound.vpl_m, math.hypot(*off[:2])))
    table = np.array(rows, dtype=float).reshape(-1, 7)
    return {
        "ratio": table[:, :2],
        "beyond": table[:, 2],
        "inside": table[:, 3],
        "hpl_m": table[:, 4],
        "vpl_m": table[:, 5],
        "error_m": table[:, 6],
        "cpu_s": np.array([time.process_time() - began]),
    }


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study with `runs` drives a case. All but `cost_ratio` repeats exactly.

    ValueError for fewer than 1 run."""
    count = DEFAULT_RUNS if runs is None else runs
    if count < 1:
        raise ValueError("runs must be at least 1")
    step = step_counter(progress, (len(CASES) + 1) * count)
    cases: dict[str, Any] = {}
    spent = 0.0
    correlation = []
    for case in CASES:
        drives = map_runs(partial(_of_seed, case, True, seed), count, step)
        cases[case.name] = _figures(case, drives)
        if case is NO_FAULT:
            spent = sum(float(d["cpu_s"][0]) for d in drives)
            correlation = [correlation_s(d["ratio"]) for d in drives]
    without = map_runs(partial(_of_seed, NO_FAULT, False, seed), count, step)
    return {
        "study": "protection",
        "runs": count,
        "seed": seed,
        "sample_risk": SAMPLE_RISK,
        "prior": PRIOR,
        "alert_limits_m": list(LIMITS_M),
        "cases": cases,
        "correlation_s": float(np.mean(correlation)),
        "cost_ratio": spent / sum(float(d["cpu_s"][0]) for d in without),
    }


def _of_seed(case: Case, watched: bool, seed: int, k: int) -> dict[str, Array]:
    """Drives of a seed; other seeds than 0 share no drive with it."""
    return drive(case, watched, k + MOST_DRIVES * seed)


def _figures(case: Case, drives: list[dict[str, Array]]) -> dict[str, Any]:
    together = {key: np.concatenate([d[key] for d in drives]) for key in drives[0]}
    beyond = together["beyond"]
    interval = binomtest(int(beyond.sum()), len(beyond)).proportion_ci(CONFIDENCE)
    finite = together["hpl_m"][np.isfinite(together["hpl_m"])]
    return {
        "seconds": len(beyond),
        "beyond": float(beyond.mean()),
        "interval": [float(interval.low), float(interval.high)],
        "allowed": SAMPLE_RISK if case is NO_FAULT else SAMPLE_RISK / PRIOR,
        "available": float(together["inside"].mean()),
        "beyond_configured": float((together["error_m"] > together["hpl_m"]).mean()),
        "hpl_median_m": float(np.median(finite)),
        "hpl_largest_m": float(finite.max()),
        "error_largest_m": float(together["error_m"].max()),
    }


def correlation_s(ratio: Array) -> float:
    """Integrated autocorrelation time 1 + 2 sum rho (s) of a series of seconds (k, m).

    The sum goes up to the first rho that is not positive (Geyer, Statistical Science 7 (1992),
    section 3.3)."""
    x = ratio - ratio.mean(axis=0)
    power = float((x * x).sum())
    total = 1.0
    for lag in range(1, len(x)):
        rho = float((x[lag:] * x[:-lag]).sum()) / power
        if rho <= 0.0:
            break
        total += 2.0 * rho
    return total


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Shares and levels by case."""
    header = ["fault", "beyond", "allowed", "available", "median HPL m", "largest error m"]
    rows = []
    for name, of in result["cases"].items():
        shares = [f"{of[key]:.4f}" for key in ("beyond", "allowed", "available")]
        rows.append([name, *shares, *(f"{of[k]:.1f}" for k in ("hpl_median_m", "error_largest_m"))])
    return [("Errors beyond the protection level", header, rows)]


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the shares beyond the coarse level against the allowed ones."""
    from matplotlib.figure import Figure  # noqa: PLC0415  # an extra

    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    names = list(result["cases"])
    cases = result["cases"].values()
    share = np.array([of["beyond"] for of in cases])
    interval = np.array([of["interval"] for of in cases]).T
    off = np.abs(interval - share)
    axes.errorbar(share, names, xerr=off, fmt="o", label="beyond the level, 99 %")
    axes.plot([of["allowed"] for of in cases], names, "|", markersize=18, label="allowed")
    axes.set_title("errors beyond the protection level")
    axes.set_xlabel("share of seconds")
    axes.invert_yaxis()
    axes.legend()
    save_figure(figure, path)
