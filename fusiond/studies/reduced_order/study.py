r"""Study `reduced-order`: paper 002, 23 states of INS/GNSS/SAR against 17.

The flight is linearised second by second (`fusiond.studies.reduced_order.flight`); the covariance
analysis (`fusiond.studies.covariance_analysis`) runs each filter's gain in the 23 states that
describe the truth. Live filters on drawn errors (`fusiond.studies.reduced_order.runs`) hold it to
the real thing. Sigmas are those of the *true* error at the end of the flight, east, north, up.
`expected_nees_per_dof` is what the analysis expects of the filter's own NEES of attitude, velocity
and position, tr(P_believed^-1 P_true) / 9, mean over the last half.

`variants`: another radar. 33 arc seconds of misalignment is what table 2 of the paper has in each
axis of the attitude; 0.1 deg is the models' default; `driven` is a misalignment that wanders, as
the 14 noises of the paper's W imply (3 of gyro noise, 3 of gyro Markov drift, 3 of the
accelerometers, 2 of the clock leave 3), with the only correlation time of the set-up.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.si_units import DEG
from fusiond.models.model import Model
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.studies.covariance_analysis import Result, System, analyse
from fusiond.studies.monte_carlo import Progress, nees_interval, step_counter
from fusiond.studies.observability import Epoch, Observability, observability
from fusiond.studies.reduced_order import flight, implied, observability_at_rest
from fusiond.studies.reduced_order.cost import IMU_RATE_HZ, costs
from fusiond.studies.reduced_order.report import (
    BELIEVED,
    EAST_NORTH_UP,
    HEADER,
    PAPER,
    curves,
    list_of,
    paper_rows,
    picture,
    sigma_cells,
    sigmas,
)
from fusiond.studies.reduced_order.runs import FilterRun, combinations, monte_carlo, nees

DEFAULT_RUNS = 40
CONFIDENCE = 0.99
SERIES_EVERY_S = 20
WEAKEST = 6
VARIANTS: dict[str, tuple[float, float]] = {
    "sar_33_arcsec": (33.0 * flight.ARC_SECOND, math.inf),
    "sar_0.1_deg": (0.1 * DEG, math.inf),
    "sar_driven": (flight.SAR_SD_RAD, flight.IMU.bias_correlation_s),
}
"""One sigma (rad) and correlation time (s) of the radar's misalignment."""
VALIDATION_S = 600.0
CHECKED_S = 100
"""Errors of the live filters are taken at every 100th second."""


def run_study(
    runs: int | None = None, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study; `runs` (default 40) live flights of 600 s check the covariance analysis.

    All but times repeat exactly.
    """
    count = DEFAULT_RUNS if runs is None else runs
    if count < 2:
        raise ValueError("runs must be at least 2")
    advance = step_counter(progress, 4 + len(VARIANTS) + count)
    models = flight.filters()
    systems = _systems(models)
    fine = _analysis(models, systems)
    advance()
    variants = {}
    for variant, (sd, tau_s) in VARIANTS.items():
        variants[variant] = _variant(systems, sd, tau_s)
        advance()
    at_rest = observability_at_rest.rest_observability()
    advance()
    as_printed = implied.implied_sigmas(models, systems, fine["17"].kept)
    advance()
    flown = monte_carlo(models, VALIDATION_S, CHECKED_S, count, seed, advance)
    validation = _validation(models, fine, flown)
    times = costs(models)
    advance()
    result: dict[str, Any] = {
        "study": "reduced-order",
        "runs": count,
        "seed": seed,
        "duration_s": flight.DURATION_S,
        "sar_misalignment_sd_arcsec": flight.SAR_SD_RAD / flight.ARC_SECOND,
        "models": {
            name: {
                **_sigmas(fine[name]),
                "time_per_step_us": times[name].step_s * 1e6,
                "live_second_us": times[name].live_second_s * 1e6,
            }
            for name in models
        },
        "time_ratio": times["17"].step_s / times["23"].step_s,
        "live_second_ratio": times["17"].live_second_s / times["23"].live_second_s,
        "live_imu_rate_hz": IMU_RATE_HZ,
        "observability": _observability(fine["23"]),
        "variants": variants,
        "at_rest": at_rest,
        "implied": as_printed,
        "validation": validation,
        "series": _series(fine),
        "paper": PAPER,
    }
    result["finding"] = _finding(result)
    return result


# --------------------------------------------------------------------------- analysis


class Analysed:
    """Filter over the flight: results of the analysis at each second, and its linear model."""

    def __init__(self, of: Model, kept: NDArray[np.int64], systems: list[System]) -> None:
        self.model, self.kept, self.systems = of, kept, systems
        self.results: list[Result] = []


def _variant(known: dict[str, list[System]], sd: float, tau_s: float) -> dict[str, Any]:
    """Results with a SAR misalignment of `sd` (rad) that changes with `tau_s`; `known` are the
    systems of a constant one."""
    of = flight.filters(sd, tau_s)
    # How well a constant is known changes the start alone.
    found = _analysis(of, known if math.isinf(tau_s) else _systems(of))
    return {
        "sar_misalignment_sd_arcsec": sd / flight.ARC_SECOND,
        "models": {name: _sigmas(found[name]) for name in of},
        "observability": _observability(found["23"]),
    }


def _systems(models: dict[str, Model]) -> dict[str, list[System]]:
    return {name: list(flight.systems(of, flight.DURATION_S)) for name, of in models.items()}


def _analysis(models: dict[str, Model], systems: dict[str, list[System]]) -> dict[str, Analysed]:
    names = list(models)
    full = models[names[0]]
    initial = np.diag(flight.initial_sd(full) ** 2)
    found = {}
    for name, of in models.items():
        # The same blocks of the full model, in the filter's order.
        kept = np.array([slot for block in of.blocks for slot in full.slots_of(block.name)])
        analysed = Analysed(of, kept, systems[name])
        believed = np.diag(flight.initial_sd(of) ** 2)
        steps = zip(systems[names[0]], systems[name], strict=True)
        # The filter feeds back all that is a navigation error (its slots 0 to 8).
        analysed.results = list(analyse(steps, kept, initial, believed, np.arange(9)))
        found[name] = analysed
    return found


def _sigmas(of: Analysed) -> dict[str, Any]:
    """True error and the filter's sigma at the end, and the expected NEES."""
    last = of.results[-1]
    later = of.results[len(of.results) // 2 :: SERIES_EVERY_S]
    expected = [_expected_nees(r) for r in later]
    return {
        **sigmas(last.true),
        **sigmas(last.believed, BELIEVED),
        "expected_nees_per_dof": float(np.mean(expected)),
        "horizontal_sigma_m": float(np.sqrt(last.true[6, 6] + last.true[7, 7])),
    }


def _expected_nees(of: Result) -> float:
    core = slice(0, CORE_SIZE)
    return (
        float(np.trace(np.linalg.solve(of.believed[core, core], of.true[core, core]))) / CORE_SIZE
    )


def _series(found: dict[str, Analysed]) -> dict[str, Any]:
    """Sigmas over time: true and believed, for the picture."""
    every = slice(SERIES_EVERY_S - 1, None, SERIES_EVERY_S)
    seconds = np.arange(1, len(found["23"].results) + 1)[every]
    out: dict[str, Any] = {"t_s": seconds.tolist(), "models": {}}
    for name, of in found.items():
        chosen = of.results[every]
        out["models"][name] = {
            "true": curves([r.true for r in chosen]),
            "believed": curves([r.believed for r in chosen]),
        }
    return out


def _observability(of: Analysed) -> dict[str, Any]:
    """Rank, weakest directions, and each state: share of its sigma that is left."""
    names, sd = observability_at_rest.state_names(of.model), flight.initial_sd(of.model)
    found: Observability = observability((Epoch(s.phi, s.h, s.r) for s in of.systems), sd)
    filtered = np.sqrt(np.diag(of.results[-1].true)) / sd
    return {
        "states": len(names),
        "rank": found.rank,
        "informative": found.informative,
        "weakest": [
            {
                "singular_value": d.singular,
                "sigma_left": d.sigma_left,
                "states": d.states(names),
            }
            for d in found.directions[-WEAKEST:]
        ],
        "sigma_left": {
            name: {"without_process_noise": float(a), "filter_at_end": float(b)}
            for name, a, b in zip(names, found.sigma_left, filtered, strict=True)
        },
        "not_estimated": found.not_estimated(names),
    }


# --------------------------------------------------------------------------- validation


def _validation(
    models: dict[str, Model], analysed: dict[str, Analysed], flown: dict[str, FilterRun]
) -> dict[str, Any]:
    """NEES of live filters by the analysis's covariance and by their own.

    Averages over the runs at the last instant; instants of one run are not independent.
    `rms_to_sigma`: east, north, up, RMS of the live errors over the analysis's sigma.
    """
    project = combinations(next(iter(models.values())))
    runs = len(next(iter(flown.values())).error)
    tail = 0.5 * (1.0 - CONFIDENCE)

    found: dict[str, Any] = {
        "seconds": VALIDATION_S,
        "nees_dof": len(project),
        "nees_interval": nees_interval(runs, len(project), tail),
        "rms_to_sigma_interval": [math.sqrt(x) for x in nees_interval(runs, 1, tail)],
        "models": {},
    }
    for name, of in models.items():
        at = [analysed[name].results[second - 1] for second in _checked()]
        error = flown[name].error
        true = np.array([project @ r.true @ project.T for r in at])
        by_analysis = nees(error, true[None])
        estimated = combinations(of).any(axis=1)
        own = flown[name].believed[:, :, estimated][:, :, :, estimated]
        believed = nees(error[:, :, estimated], own)
        sd = np.sqrt(np.array([np.diag(p) for p in true]))
        ratio = np.sqrt(np.mean(np.square(error / sd), axis=0))[-1]
        found["models"][name] = {
            "nees_mean": float(by_analysis[:, -1].mean()),
            "nees_all_instants": float(by_analysis.mean()),
            "believed_nees_per_dof": float(believed[:, -1].mean() / estimated.sum()),
            "attitude_rms_to_sigma": ratio[:3][EAST_NORTH_UP].tolist(),
            "velocity_rms_to_sigma": ratio[3:6][EAST_NORTH_UP].tolist(),
        }
    return found


def _checked() -> range:
    return range(CHECKED_S, round(VALIDATION_S) + 1, CHECKED_S)


# --------------------------------------------------------------------------- for people


def _finding(result: dict[str, Any]) -> str:
    full, small, bare = (result["models"][k] for k in ("23", "17", "17_bare"))
    seen = result["observability"]

    still = result["at_rest"]
    return (
        f"A step of the filter takes 17 states {result['time_ratio']:.2f} of the time of 23 (the "
        f"paper: 0.45; a live second with INS and satellite geometry "
        f"{result['live_second_ratio']:.2f}), and they err by "
        f"{list_of(small['attitude_sigma_arcsec'], 1)} instead of "
        f"{list_of(full['attitude_sigma_arcsec'], 1)} arc seconds and "
        f"{list_of(small['velocity_sigma_m_s'], 3)} instead of "
        f"{list_of(full['velocity_sigma_m_s'], 3)} m/s (east/north/up), the accelerometer biases "
        f"being white noise to them, and state it: NEES {small['expected_nees_per_dof']:.2f} a "
        f"degree; where nothing stands for the biases the vertical velocity "
        f"errs by {bare['velocity_sigma_m_s'][2]:.2f} m/s while the filter believes "
        f"{bare['believed_velocity_sigma_m_s'][2]:.3f}; of the 23 states GNSS shows "
        f"{still['gnss']['rank']} directions of a vehicle at rest, with the radar "
        f"{still['gnss_sar']['rank']}, the straight flight "
        f"{seen['rank']}, and each that it hides joins attitude, misalignment of "
        f"the radar and a level accelerometer bias, but it shows the gyro constants and the "
        f"vertical accelerometer bias, which the paper drops too."
    )


def tables(result: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Sigmas beside the paper's, observability, validation."""
    found = []
    for name_of, case in {"": result, **result["variants"]}.items():
        rows = []
        for name, figures in case["models"].items():
            spent = f"{figures['time_per_step_us']:.1f}" if "time_per_step_us" in figures else ""
            nees = f"{figures['expected_nees_per_dof']:.2f}"
            rows.append([f"{name} true error, NEES {nees}", *sigma_cells(figures), spent])
            rows.append([f"{name} believes", *sigma_cells(figures, BELIEVED), ""])
        rows.extend(paper_rows())
        title = (
            f"{name_of or 'as analysed'}, radar misalignment "
            f"{case['sar_misalignment_sd_arcsec']:.0f} arc seconds: "
            f"one sigma after {result['duration_s']:.0f} s"
        )
        found.append((title, HEADER, rows))
        seen = case["observability"]
        title = (
            f"observability: rank {seen['rank']} of {seen['states']}, {seen['informative']} "
            "directions better known than before; share of the initial sigma that is left"
        )
        states = [
            [name, f"{left['without_process_noise']:.4f}", f"{left['filter_at_end']:.4f}"]
            for name, left in seen["sigma_left"].items()
        ]
        found.append((title, ["state", "Gramian", "filter"], states))
    rows = [
        [name, f"{of['rank']} of {of['states']}", "; ".join(", ".join(d) for d in of["hidden"])]
        for name, of in result["at_rest"].items()
    ]
    found.append(("at rest, by", ["", "rank", "each direction hidden joins"], rows))
    found += _implied_tables(result["implied"])
    checked = result["validation"]
    low, high = checked["nees_interval"]
    title = (
        f"analysis against {result['runs']} live flights of {checked['seconds']:.0f} s: NEES of "
        f"{checked['nees_dof']}, 99 % interval [{low:.2f}, {high:.2f}]"
    )
    rows = [
        [name, f"{v['nees_mean']:.2f}", f"{v['believed_nees_per_dof']:.2f}"]
        for name, v in checked["models"].items()
    ]
    found.append((title, ["", "NEES by the analysis", "NEES per state by its own P"], rows))
    return found


def _implied_tables(of: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Tables of the noises that table 2 implies: by the flight, and by hand."""
    sensors, other = of["sensors"], of["other_sensors"]
    title = (
        f"with noises that table 2 implies: gyro {of['gyro_noise_deg_sqrt_h']} deg/sqrt(h), radar "
        f"{sensors['bearing_sd_arcsec']:.0f} and misaligned by "
        f"{sensors['misalignment_sd_arcsec']:.0f} arc seconds, ranges {sensors['range_sd_m']} m; "
        f"to 17 states gyro {of['gyro_noise_of_17_deg_sqrt_h']} deg/sqrt(h), biases "
        f"{of['accelerometer_noise_of_17_m_s_sqrt_h']} m/s/sqrt(h); other: gyro "
        f"{of['other_gyro_noise_deg_sqrt_h']} deg/sqrt(h), radar "
        f"{other['bearing_sd_arcsec']:.0f} and {other['misalignment_sd_arcsec']:.0f}, ranges "
        f"{other['range_sd_m']} m, rates {other['rate_sd_m_s']} m/s"
    )
    rows = [
        [f"{name.replace('_', ', ')} true error", *sigma_cells(s), ""]
        for name, s in of["models"].items()
    ]
    printed = title, HEADER, [*rows, *paper_rows()]
    axes = [
        [axis, f"{v['gyro_deg_sqrt_h']:.3f}", f"{v['velocity_m_s_sqrt_hz']:.3f}"]
        for axis, v in of["by_hand"].items()
        if axis != "azimuth_ratio"
    ]
    title = "what a printed level axis of 23 states implies by hand"
    return [printed, (title, ["", "gyro deg/sqrt(h)", "velocity m/s/sqrt(Hz)"], axes)]


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot sigmas over time, true and the filters' own, beside the paper's."""
    picture(result["series"], path)
