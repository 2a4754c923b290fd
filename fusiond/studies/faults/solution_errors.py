"""Published solution of a run against the truth at 10 Hz: errors and stated sigmas.

Only published solutions are read, not the navigator's state. Every mode with a solution counts,
`coasting` and `invalid` included.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import States, Truth, metres_to_geodetic
from fusiond.studies.faults.error_sigma_score import MOST_SIGMA, NAVIGATING, Event, Sample
from fusiond.studies.faults.runs import TICKS_PER_S, run_navigator
from fusiond.studies.faults.sensor_data import Recording

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

STEP_S = 1.0 / TICKS_PER_S
SILENT = (Mode.WAITING, Mode.ALIGNING)
AXES: dict[str, tuple[int, ...]] = {
    "position": (0, 1),
    "height": (2,),
    "velocity": (3, 4, 5),
    "tilt": (6, 7),
    "yaw": (8,),
}
"""Columns of errors and sigmas of each quantity; its degrees of freedom are their number."""
JUDGED = (0, 1, 2, 3, 4, 6, 7, 8)
"""Columns whose excess is a lie: all but the velocity down."""
_FIGURES = 18
_TURNS = slice(6, 9)


@dataclass(frozen=True, slots=True)
class Published:
    """A run at `t_s` (n,): `errors` and `sigmas` (n, 9) of position (m, NED), velocity (m/s, NED),
    roll, pitch, yaw (rad), NaN where nothing is published, and `modes` (n,).

    Sigmas of errors hold the truth's own."""

    t_s: Array
    errors: Array
    sigmas: Array
    modes: NDArray[np.str_]
    events: tuple[Event, ...]
    crash: str | None

    @property
    def there(self) -> Bools:
        """Mask of epochs with a solution."""
        nothing = (self.modes == str(Mode.INVALID)) & np.isnan(self.errors).all(axis=1)
        found: Bools = (self.modes != "") & ~np.isin(self.modes, SILENT) & ~nothing
        return found

    @property
    def navigating(self) -> Bools:
        """Mask of epochs in mode `navigating`."""
        found: Bools = self.modes == NAVIGATING
        return found

    @property
    def ratios(self) -> Array:
        """Ratios |error| / sigma (n, 9) as in the judge: infinite without a valid comparison, zero
        where nothing is published."""
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.abs(self.errors) / self.sigmas
        known = np.isfinite(self.errors) & np.isfinite(self.sigmas) & (self.sigmas > 0.0)
        found[~known] = math.inf
        found[~self.there] = 0.0
        return found

    @property
    def beyond(self) -> Bools:
        """Mask of errors beyond five sigma, whatever the mode."""
        return self.beyond_in(JUDGED)

    def beyond_in(self, axes: tuple[int, ...]) -> Bools:
        """Ratios beyond the bound in some columns."""
        found: Bools = np.any(self.ratios[:, axes] > MOST_SIGMA, axis=1)
        return found

    @property
    def horizontal_m(self) -> Array:
        """Horizontal error (n,)."""
        return np.hypot(self.errors[:, 0], self.errors[:, 1])

    def sigma(self, quantity: str) -> Array:
        """Stated sigma (n,) of a quantity over all its axes."""
        found: Array = np.sqrt((self.sigmas[:, AXES[quantity]] ** 2).sum(axis=1))
        return found


def published_errors(config: Config, recording: Recording, truth: Truth) -> Published:
    """Published solution of a recording, against the truth."""
    ticks = np.arange(1.0, math.floor(truth.duration_s * TICKS_PER_S + 1e-6) + 0.5)
    return errors_against(config, recording, truth.at(ticks * STEP_S))


def errors_against(
    config: Config,
    recording: Recording,
    true: States,
    true_sd: Array | None = None,
    watch: Callable[[Navigator], None] | None = None,
) -> Published:
    """Compare with states at 10 Hz from 0.1 s on, known to `true_sd` (n, 9); `watch` receives the
    navigator."""
    n = len(true.t_s)
    rows, modes = np.full((n, _FIGURES), math.nan), np.full(n, "", dtype="<U12")

    def look(solution: Solution, row: int) -> Sample:
        modes[row] = solution.mode
        rows[row] = (
            *(solution.lat_rad, solution.lon_rad, solution.height_m),
            *(*solution.v_ned_m_s, *solution.rpy_rad),
            *(*solution.sd_ned_m, *solution.sd_v_ned_m_s, *solution.sd_rpy_rad),
        )
        return Sample(solution.t_ns * 1e-9, str(solution.mode))

    course = run_navigator(config, recording, n * STEP_S, look, watch, every_ticks=1)
    unit = metres_to_geodetic(true.position[:, 0], true.position[:, 2], np.ones((n, 3)))
    difference = rows[:, :3] - true.position
    difference[:, 1] = _wrapped(difference[:, 1])
    turned = _wrapped(rows[:, _TURNS] - true.rpy)
    errors = np.hstack((difference / unit, rows[:, 3:6] - true.v_ned, turned))
    sigmas = rows[:, 9:] if true_sd is None else np.hypot(rows[:, 9:], true_sd)
    return Published(true.t_s, errors, sigmas, modes, tuple(course.events), course.crash)


def _wrapped(angles_rad: Array) -> Array:
    """Wrap an angle to [-pi, pi]."""
    found: Array = (angles_rad + math.pi) % (2.0 * math.pi) - math.pi
    return found


def longest_s(where: Bools) -> float:
    """Longest unbroken time in which a condition holds."""
    edges = np.diff(np.concatenate(([0], where.astype(np.int8), [0])))
    lengths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    return float(lengths.max(initial=0)) * STEP_S


def lasting_from(where: Bools, samples: int) -> int | None:
    """First row from which a condition holds for so many; None if never."""
    kept = 0
    for row, holds in enumerate(where.tolist()):
        kept = kept + 1 if holds else 0
        if kept == samples:
            return row - samples + 1
    return None
