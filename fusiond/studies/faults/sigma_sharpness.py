r"""Sharpness of sigma in fault-free runs, cell by cell.

    NEES a degree = mean of (e / sigma)^2 over instants, axes and drives        1 where it is right
    sigma over RMS = sqrt(mean sigma^2 / mean e^2)                              the same

of each quantity, each axis by its own sigma, so that the mean of the first is one however the axes
are correlated; from what is published at 10 Hz in any mode. A cell is a class of IMU, a receiver
and its rate, whether the lever arm is given, and what else is told (`scenes`). Drive k of cell c is
drive 100 c + k of its share, `DURATION_S` long, with outages (`OUTAGES_S`) in it:

first minute   from the first solution on
outage         from the first fix that is missing until one comes
after          30 s from there on
steady         all else

Errors last: a yaw's for minutes. NEES of a cell has the interval (Student's t, `CONFIDENCE`) of its
drives' means.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import t

from fusiond.configuration.sensor_class import CLASSES
from fusiond.studies.faults.matched_noise_drives import (
    CODE,
    RTK,
    SHARING,
    SHARING_RTK,
    Share,
    Vehicle,
    scene,
)
from fusiond.studies.faults.sensor_data import Recording
from fusiond.studies.faults.solution_errors import (
    AXES,
    STEP_S,
    Bools,
    Published,
    longest_s,
    published_errors,
)

DURATION_S = 420.0
OUTAGES_S = {150.0: 10.0, 240.0: 30.0, 340.0: 20.0}
"""Length of an outage by its start."""
FIRST_S, AFTER_S = 60.0, 30.0
PHASES = ("steady", "first minute", "outage", "after")
RIGHT = (0.7, 1.4)
"""Range of the NEES a degree that is called right; sigma over RMS then lies between its roots."""
RECEIVERS = (CODE, SHARING, RTK, SHARING_RTK)
RATES_HZ = (1.0, 10.0)
MOST_DRIVES = 100
CONFIDENCE = 0.95


def _cells() -> tuple[Vehicle, ...]:
    """Vehicles of the study.

    Noise is configured in full, or by sensor class alone, or by the data sheet of a unit without
    misalignment."""
    told = [
        Vehicle(sensor, replace(receiver, rate_hz=rate), given)
        for sensor, receiver, rate, given in product(CLASSES, RECEIVERS, RATES_HZ, (True, False))
    ]
    by_class = [
        Vehicle(sensor, replace(receiver, rate_hz=rate), told="class")
        for sensor, receiver, rate in product(CLASSES, (CODE, RTK), RATES_HZ)
    ]
    square = [
        Vehicle("data sheet", replace(receiver, rate_hz=rate))
        for receiver, rate in product(RECEIVERS, RATES_HZ)
    ]
    return (*told, *by_class, *square)


CELLS = _cells()


def jobs(drives: int) -> list[tuple[int, int]]:
    """Cell and drive of each run; ValueError where drives of two cells were the same."""
    if drives > MOST_DRIVES:
        raise ValueError(f"{MOST_DRIVES} drives a cell at most")
    return [(cell, drive) for drive in range(drives) for cell in range(len(CELLS))]


def sharpness_run(job: tuple[int, int], share: Share) -> dict[str, Any]:
    """Mean squares of error over sigma, error and sigma by phase and quantity, and the time."""
    cell, drive = job
    vehicle = CELLS[cell]
    on = scene(vehicle, share, MOST_DRIVES * cell + drive, DURATION_S)
    recording = on.recording
    for begin_s, length_s in OUTAGES_S.items():
        recording = recording.withheld(begin_s, begin_s + length_s)
    run = published_errors(on.config, recording, on.truth)
    return {
        "cell": cell,
        **cell_name(vehicle),
        "drive": drive,
        "phases": {name: moments(run, where) for name, where in phases_of(run, recording).items()},
        "not_navigating_s": {
            name: round(float((where & ~run.navigating).sum()) * STEP_S, 1)
            for name, where in phases_of(run, recording).items()
        },
        "longest_lie_s": longest_s(run.beyond),
        "crash": run.crash,
    }


def cell_name(vehicle: Vehicle) -> dict[str, Any]:
    """A cell by name."""
    return {
        "imu": vehicle.sensor,
        "receiver": vehicle.receiver.name,
        "rate_hz": vehicle.receiver.rate_hz,
        "lever_given": vehicle.lever_given,
        "told": vehicle.told,
    }


def phases_of(run: Published, recording: Recording) -> dict[str, Bools]:
    """Mask of instants by phase; phases do not overlap."""
    t_s, left = run.t_s, run.there.copy()
    found: dict[str, Bools] = {}

    def take(name: str, where: Bools) -> None:
        found[name] = found.get(name, np.zeros_like(left)) | (where & left)
        left[where] = False

    for begin_s, length_s in OUTAGES_S.items():
        end_s = begin_s + length_s
        back_s = min(i.seen_ns for i in recording.received if i.t_ns >= end_s * 1e9) * 1e-9
        take("outage", (t_s >= begin_s) & (t_s < back_s))
        take("after", (t_s >= back_s) & (t_s < back_s + AFTER_S))
    if left.any():
        take("first minute", t_s < t_s[int(np.argmax(left))] + FIRST_S)
    take("steady", np.ones_like(left))
    none = np.zeros_like(left)
    return {name: found.get(name, none) for name in PHASES}


def moments(run: Published, where: Bools) -> dict[str, dict[str, float | None]]:
    """Moments of each quantity in a phase: `nees`, `error2` and `sigma2`, means over instants and
    compared axes; None without any or with NaN."""
    found = {}
    for name, axes in AXES.items():
        there = [axis for axis in axes if not np.isnan(run.errors[where, axis]).all()]
        e2 = run.errors[where][:, there] ** 2
        s2 = run.sigmas[where][:, there] ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            parts = {"nees": e2 / s2, "error2": e2, "sigma2": s2}
        means = {key: float(part.mean()) if part.size else math.nan for key, part in parts.items()}
        found[name] = {k: v if math.isfinite(v) else None for k, v in means.items()}
    return found


def figures(rows: Iterable[Mapping[str, Any]], phase: str, name: str) -> tuple[float, float, float]:
    """NEES a degree, half its interval, and sigma over RMS of a quantity in a phase, with equal
    weights of runs; NaN without data."""
    those = [row["phases"][phase][name] for row in rows]
    if not those or any(part is None for each in those for part in each.values()):
        return math.nan, math.nan, math.nan
    nees = [each["nees"] for each in those]
    error2, sigma2 = (sum(each[key] for each in those) for key in ("error2", "sigma2"))
    half, n = math.inf, len(nees)
    if n > 1:
        times = float(t.ppf(0.5 + 0.5 * CONFIDENCE, n - 1))
        half = times * float(np.std(nees, ddof=1)) / math.sqrt(n)
    return float(np.mean(nees)), half, math.sqrt(sigma2 / error2)


def nees_class(nees: float, half: float) -> str:
    """Class of a NEES: `right`; `nees_class` of `RIGHT` with its whole interval; or `perhaps`."""
    low, high = RIGHT
    if low <= nees <= high:
        return "right"
    by = low - nees if nees < low else nees - high
    return "perhaps" if by <= half else "outside"
