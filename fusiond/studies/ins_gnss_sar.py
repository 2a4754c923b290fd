r"""Study `ins-gnss-sar`: live flight of paper 002, with 23 or 17 states and four or all satellites.

The paper computes covariances; here the daemon's filter flies on its timeline through drawn errors
of IMU, clock, radar and start (`fusiond.studies.reduced_order.runs`), with the best four BeiDou
satellites by GDOP or with all in view (`fusiond.studies.reduced_order.flight`), both on the same
draws. A radar sees a point for a while only: points lie every 45 km, 30 km to both sides in turn,
and the one that is abeam next or was last is measured, each for 150 s.

`*_std_*`: root mean square of the error, which has no mean but the one drawn, over all runs and the
last quarter of the flight; axes east, north, up. `believed_*`: sigma of the filter's mean
covariance for the same. NEES is that of attitude, velocity and position (9); `nees_interval` holds
for the average over the runs at one instant.

`integration`: a flight without any error at the study's IMU rate and at a finer one.
`error_to_sigma` is what the integration errs by at the end at the study's rate, the greatest of the
nine over sigma, `sigma_change` the greatest change of a sigma to that at the finer rate.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import State
from fusiond.models.model import Model
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter
from fusiond.studies.navigation_error import nav_error
from fusiond.studies.reduced_order import flight
from fusiond.studies.reduced_order.cost import IMU_RATE_HZ, Cost, costs
from fusiond.studies.reduced_order.report import (
    BELIEVED,
    HEADER,
    PAPER,
    curves,
    list_of,
    paper_rows,
    picture,
    sigma_cells,
    sigmas,
)
from fusiond.studies.reduced_order.runs import (
    FilterRun,
    fly_on_timeline,
    monte_carlo,
    nees,
    started_filter,
)

Array = NDArray[np.float64]

DEFAULT_RUNS = 50
CHECKED_S = 50
"""Errors are taken at every 50th second: three instants for each radar point."""
COUNTED_FROM = 0.75
"""Share of the flight after which errors count."""
STATES = ("23", "17")
SKIES = {"four": False, "all": True}
STD = ("attitude_std_arcsec", "velocity_std_m_s")
FINE_RATE_HZ = 100.0


def run_study(
    runs: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    seconds: float = flight.DURATION_S,
) -> dict[str, Any]:
    """Run the study with `runs` flights (default 50) of each sky. All but times repeat exactly."""
    count = DEFAULT_RUNS if runs is None else runs
    if count < 2:
        raise ValueError("runs must be at least 2")
    advance = step_counter(progress, 2 * count + 1)
    models = {name: of for name, of in flight.filters().items() if name in STATES}
    instants = np.arange(CHECKED_S, round(seconds) + 1, CHECKED_S)
    counted = instants >= COUNTED_FROM * seconds
    cases: dict[str, Any] = {}
    series: dict[str, Any] = {"t_s": instants.tolist(), "models": {}}
    for sky, all_in_view in SKIES.items():
        flown = monte_carlo(models, seconds, CHECKED_S, count, seed, advance, all_in_view)
        spent = costs(models, all_in_view=all_in_view)
        cases[sky] = {name: _figures(flown[name], counted, spent[name]) for name in models}
        for name, of in flown.items():
            series["models"][f"{sky} {name}"] = {
                "true": curves(_second_moment(of.error)),
                "believed": curves(of.believed.mean(axis=0)),
            }
    integration = _integration(models["23"], seconds)
    advance()
    result: dict[str, Any] = {
        "study": "ins-gnss-sar",
        "runs": count,
        "seed": seed,
        "duration_s": seconds,
        "counted_from_s": float(instants[counted][0]),
        "imu_rate_hz": flight.IMU.rate_hz,
        "live_imu_rate_hz": IMU_RATE_HZ,
        "satellites": {sky: _satellites(seconds, SKIES[sky]) for sky in SKIES},
        "nees_dof": CORE_SIZE,
        "nees_expected": float(CORE_SIZE),
        "nees_interval": nees_interval(count, CORE_SIZE),
        "cases": cases,
        "integration": integration,
        "series": series,
        "paper": PAPER,
    }
    result["finding"] = _finding(result)
    return result


def _figures(of: FilterRun, counted: NDArray[np.bool_], spent: Cost) -> dict[str, Any]:
    error, believed = of.error[:, counted, :CORE_SIZE], of.believed[:, counted]
    believed = believed[..., :CORE_SIZE, :CORE_SIZE]
    true = _second_moment(error).mean(axis=0)
    stated = believed.mean(axis=(0, 1))
    mean = float(nees(error, believed).mean())
    return {
        **sigmas(true, STD),
        **sigmas(stated, BELIEVED),
        "horizontal_rms_m": _horizontal(true),
        "believed_horizontal_m": _horizontal(stated),
        "nees_mean": mean,
        "nees_to_expected": mean / CORE_SIZE,
        "time_per_step_us": spent.step_s * 1e6,
        "live_second_us": spent.live_second_s * 1e6,
    }


def _second_moment(error: Array) -> Array:
    """Average over the runs of e e^T (k, m, m), for errors (runs, k, m)."""
    return np.asarray(np.einsum("rki,rkj->kij", error, error) / len(error))


def _horizontal(p: Array) -> float:
    return math.sqrt(p[6, 6] + p[7, 7])


def _satellites(seconds: float, all_in_view: bool) -> dict[str, float]:
    used = [len(scene.names) for scene in flight.scenes(seconds, all_in_view)]
    return {"least": min(used), "mean": float(np.mean(used)), "most": max(used)}


def _integration(of: Model, seconds: float) -> dict[str, float]:
    """Error by the IMU's rate in a flight without sensor errors."""
    nav = flight.true_nav(flight.truth(seconds))
    true = State(nav[0], np.zeros(of.size), np.zeros(STEP_SIZE), of)
    errors, sd = [], []
    for rate in (flight.IMU.rate_hz, FINE_RATE_HZ):
        path = flight.truth(seconds, rate)
        estimator = started_filter(of, nav[0])
        given = (
            flight.measured(scene, true._replace(nav=nav[k + 1]), np.zeros(scene.rows))
            for k, scene in enumerate(flight.scenes(seconds))
        )
        for _ in fly_on_timeline([estimator], np.hstack([path.gyro, path.accel]), given, rate):
            pass
        errors.append(nav_error(estimator.nav, nav[-1]))
        sd.append(np.sqrt(np.diag(estimator.covariance)[:CORE_SIZE]))
    return {
        "rate_hz": flight.IMU.rate_hz,
        "fine_rate_hz": FINE_RATE_HZ,
        "error_to_sigma": float(np.abs(errors[0] / sd[0]).max()),
        "sigma_change": float(np.abs(sd[0] / sd[1] - 1.0).max()),
    }


# --------------------------------------------------------------------------- for people


def _finding(result: dict[str, Any]) -> str:
    four, every = result["cases"]["four"], result["cases"]["all"]

    def pair(of: dict[str, Any], key: str, digits: int) -> str:
        return f"{list_of(of['17'][key], digits)} against {list_of(of['23'][key], digits)}"

    def over(std: str, believed: str) -> str:
        small = four["17"]
        ratios = [e / s for e, s in zip(small[std], small[believed], strict=True)]
        return list_of(ratios, 1)

    horizontal = four["17"]["horizontal_rms_m"] / four["17"]["believed_horizontal_m"]
    return (
        f"With four satellites 17 states err by {pair(four, STD[0], 1)} arc seconds and "
        f"{pair(four, STD[1], 4)} m/s with 23 (east/north/up), with all in view by "
        f"{pair(every, STD[0], 1)} and {pair(every, STD[1], 4)}, and horizontally all in view "
        f"bring 23 states from {four['23']['horizontal_rms_m']:.2f} to "
        f"{every['23']['horizontal_rms_m']:.2f} m, 17 from {four['17']['horizontal_rms_m']:.2f} to "
        f"{every['17']['horizontal_rms_m']:.2f}; with the accelerometer biases as noise the error "
        f"of 17 states is, with four, {over(STD[0], BELIEVED[0])} times what they state in "
        f"attitude, {over(STD[1], BELIEVED[1])} times in velocity and {horizontal:.1f} times "
        f"horizontally, and their NEES {four['17']['nees_mean']:.2f} (all in view: "
        f"{every['17']['nees_mean']:.2f}) where {result['nees_dof']} are expected and 23 states "
        f"have {four['23']['nees_mean']:.2f} ({every['23']['nees_mean']:.2f}); what they save is "
        f"{four['23']['time_per_step_us'] - four['17']['time_per_step_us']:.1f} us of "
        f"{four['23']['time_per_step_us']:.1f} us a step."
    )


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Tables of errors beside the filters' sigmas and the paper's; position, NEES and times."""
    errors: list[list[str]] = []
    others: list[list[str]] = []
    for sky, of in result["cases"].items():
        for name, f in of.items():
            spent = f"{f['time_per_step_us']:.1f}"
            errors.append([f"{sky}, {name}", *sigma_cells(f, STD), spent])
            errors.append([f"{sky}, {name} states", *sigma_cells(f, BELIEVED), ""])
            others.append(
                [
                    f"{sky}, {name}",
                    f"{f['horizontal_rms_m']:.2f}",
                    f"{f['believed_horizontal_m']:.2f}",
                    f"{f['nees_mean']:.2f}",
                    f"{f['live_second_us']:.0f}",
                ]
            )
    low, high = result["nees_interval"]
    title = (
        f"{result['runs']} flights of {result['duration_s']:.0f} s, from "
        f"{result['counted_from_s']:.0f} s on: root mean square error, and sigma that the filter "
        "states"
    )
    second = (
        f"horizontal position, NEES of {result['nees_dof']} (mean of one instant in "
        f"[{low:.2f}, {high:.2f}]), and a live second at {result['live_imu_rate_hz']:.0f} Hz"
    )
    header = ["", "horizontal m", "states m", "NEES", "live us"]
    return [(title, HEADER, [*errors, *paper_rows()]), (second, header, others)]


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot RMS errors over time and the filters' sigmas, beside the paper's."""
    picture(result["series"], path)
