r"""Experiments 3 and 4 of paper 004: two receivers, no inertial unit, live.

The daemon's navigator receives the fixes in order of arrival and navigates by a constant velocity
(`fusiond.navigator.without_imu`), once with each filter of `FILTERS`.

3  two active terminals, a fix each in 1.5 s. Their fixes share an error, that of one centre's
   height model and of the same two satellites: 10 m that last for 100 s. They are correlated.
4  an active terminal and a passive receiver (10 m, once a second). What their estimates share is
   the vehicle's motion.

The active fixes' own errors are those of the positioning geometry. Horizontal errors count once a
second from `COUNTED_FROM_S` on; NEES of position and velocity, horizontally, 4 degrees of freedom.
The paper prints pictures without figures: all numbers are ours.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, Measurement, MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.estimators.federated.fusion import fuse_uncorrelated
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import metres_to_geodetic
from fusiond.studies.federated.experiment_4 import (
    ACTIVE_DELAY_S,
    ACTIVE_EVERY_S,
    CLASS_M,
    HEIGHT_SD_M,
    PASSIVE_DELAY_S,
    PASSIVE_SD_M,
    active_root,
)
from fusiond.studies.federated.runs import DURATION_S, truth
from fusiond.studies.monte_carlo import nees_interval
from fusiond.studies.navigation_error import nav_error, true_nav

Array = NDArray[np.float64]

SHARED_SD_M, SHARED_TAU_S = 10.0, 100.0
COUNTED_FROM_S, TICK_S = 30.0, 0.1
NEES_DOF = 4
EXPERIMENTS: dict[str, tuple[str, str]] = {
    "3_two_active": ("rdss", "rdss_2"),
    "4_active_and_passive": ("rdss", "gnss"),
}
FILTERS: dict[str, dict[str, Any]] = {
    "federated": {"filter": "federated"},
    "federated, correlated": {"filter": "federated", "federated": {"fusion": "correlated"}},
    "one filter": {"filter": "kalman"},
}
UNCORRELATED = "as if uncorrelated"
COUNTED = [3, 4, 6, 7]
"""Counted navigation errors: velocity and position, north and east."""


class Course(NamedTuple):
    """Course of one filter in one run, once a second: velocity and position errors and their
    covariance, horizontal (m, 4) and (m, 4, 4), and the position north and east of the start (m,
    2)."""

    x: Array
    p: Array
    way: Array

    @property
    def error(self) -> Array:
        """Horizontal (m,)."""
        return np.hypot(self.x[:, 2], self.x[:, 3])

    @property
    def sigma(self) -> Array:
        """Horizontal (m,)."""
        found: Array = np.sqrt(self.p[:, 2, 2] + self.p[:, 3, 3])
        return found

    @property
    def nees(self) -> Array:
        """NEES (m,) with 4 degrees of freedom."""
        found: Array = np.einsum(
            "ki,ki->k", self.x, np.linalg.solve(self.p, self.x[..., None])[..., 0]
        )
        return found


class Run(NamedTuple):
    """Run of all filters, with each receiver's fixes: instants and position (m, 3), horizontal
    errors."""

    courses: dict[str, Course]
    fixes: dict[str, Array]
    errors: dict[str, Array]


def config_of(name: str, estimator: dict[str, Any], only: tuple[str, ...] = ()) -> Config:
    """Daemon's configuration for an experiment, with all its receivers or some."""
    shared = {"bias_sd_m": SHARED_SD_M, "bias_correlation_s": SHARED_TAU_S}
    active = {"kind": "rdss", "fix_height_sd_m": HEIGHT_SD_M}
    active |= shared if name.startswith("3") else {"bias_sd_m": 0.0}
    white = {"bias_sd_m": 0.0, "time_offset_sd_s": 0.0, "lever_arm_sd_m": 0.0}
    kinds = {"rdss": active, "rdss_2": active, "gnss": {"kind": "gnss", **white}}
    used = only or EXPERIMENTS[name]
    return Config.model_validate(
        {"estimator": estimator, "aiding": {source: kinds[source] for source in used}}
    )


def arrivals(name: str, rng: np.random.Generator) -> tuple[list[Measurement], dict[str, Array]]:
    """Fixes in order of arrival, and for each receiver (n, 5): t (s), north, east of the start (m),
    and the horizontal errors (m)."""
    found: list[Measurement] = []
    rows: dict[str, Array] = {}
    seconds = np.arange(0.0, DURATION_S, 0.5)
    keeps = np.exp(-0.5 / SHARED_TAU_S)
    drift = np.empty((len(seconds), 2))
    value = rng.standard_normal(2) * SHARED_SD_M
    for k in range(len(seconds)):
        drift[k] = value
        value = keeps * value + rng.standard_normal(2) * SHARED_SD_M * np.sqrt(1.0 - keeps**2)
    for number, source in enumerate(EXPERIMENTS[name]):
        active = source != "gnss"
        every_s = ACTIVE_EVERY_S if active else 1.0
        t_s = np.arange(every_s + 0.7 * number, DURATION_S - 2.0, every_s)
        error = rng.standard_normal((len(t_s), 3))
        if active:
            error[:, :2] = error[:, :2] @ active_root().T
            error[:, 2] *= HEIGHT_SD_M
            if name.startswith("3"):
                error[:, 0] += np.interp(t_s, seconds, drift[:, 0])
                error[:, 1] += np.interp(t_s, seconds, drift[:, 1])
        else:
            error *= PASSIVE_SD_M
        true = truth().at(t_s).position
        at = true + metres_to_geodetic(true[:, 0], true[:, 2], error)
        rows[source] = np.column_stack([t_s, true_path(at), error[:, :2]])
        for t, p in zip(t_s, at, strict=True):
            found.append(_fix(source, active, round(t * 1e9), p))
    return sorted(found, key=lambda m: m.t_seen_ns), rows


def _fix(source: str, active: bool, t_ns: int, position: Array) -> Measurement:
    lat, lon, height = (float(x) for x in position)
    stamp = MonotonicStamp(t_ns)
    if active:
        seen = t_ns + round(ACTIVE_DELAY_S * 1e9)
        return DelayedFix(source, seen, stamp, lat, lon, height, CLASS_M)
    seen = t_ns + round(PASSIVE_DELAY_S * 1e9)
    return PositionFix(source, seen, stamp, lat, lon, height, sd_ned_m=PASSIVE_SD_M)


def true_path(positions: Array) -> Array:
    """True path in metres north and east (n, 2) of the start."""
    lat, lon, height = truth().at(np.zeros(1)).position[0]
    unit = metres_to_geodetic(np.array([lat]), np.array([height]), np.ones((1, 3)))[0]
    found: Array = (positions[:, :2] - [lat, lon]) / unit[:2]
    return found


def fly(config: Config, fixes: list[Measurement]) -> Course:
    """Run the daemon's navigator on the fixes, with a tick each 0.1 s."""
    navigator = Navigator(config)
    following = 0
    errors: list[Array] = []
    covariances: list[Array] = []
    places: list[Array] = []
    count = round(DURATION_S / TICK_S)
    instants: Array = np.arange(count, dtype=np.float64) * TICK_S
    true = true_nav(truth(), instants)
    for k in range(1, count):
        now_ns = round(k * TICK_S * 1e9)
        while following < len(fixes) and fixes[following].t_seen_ns <= now_ns:
            m = fixes[following]
            assert isinstance(m, PositionFix | DelayedFix)
            assert isinstance(m.stamp, MonotonicStamp)
            navigator.add(m, m.stamp.t_ns, 0.0, m.t_seen_ns)
            following += 1
        navigator.tick(now_ns)
        if k % 10 or k * TICK_S < COUNTED_FROM_S:
            continue
        e = navigator.active_filter
        errors.append(nav_error(e.nav, true[k])[COUNTED])
        covariances.append(e.covariance[np.ix_(COUNTED, COUNTED)])
        places.append(true_path(e.nav[None, :3])[0])
    return Course(np.array(errors), np.array(covariances), np.array(places))


def as_if_uncorrelated(one: Course, other: Course) -> Course:
    """Fusion by the formula for uncorrelated estimates of two filters with common vehicle motion,
    without information sharing."""
    pairs = [
        fuse_uncorrelated(np.array(x), np.array(p))
        for x, p in zip(
            zip(one.x, other.x, strict=True), zip(one.p, other.p, strict=True), strict=True
        )
    ]
    x = np.array([each[0] for each in pairs])
    # Its way is that of its error from what is true of the first.
    return Course(x, np.array([each[1] for each in pairs]), one.way + (x - one.x)[:, 2:])


def simulate(name: str, seed: int, number: int) -> Run:
    """Run `number` of an experiment: every filter, and each receiver alone, on the same fixes."""
    rng = np.random.default_rng([seed, int(name[0]), 41, number])
    fixes, rows = arrivals(name, rng)
    courses = {
        label: fly(config_of(name, estimator), fixes) for label, estimator in FILTERS.items()
    }
    for source in EXPERIMENTS[name]:
        own = [m for m in fixes if m.source == source]
        courses[f"{source} alone"] = fly(config_of(name, FILTERS["one filter"], (source,)), own)
    courses[UNCORRELATED] = as_if_uncorrelated(
        *(courses[f"{source} alone"] for source in EXPERIMENTS[name])
    )
    return Run(
        courses,
        {source: each[:, :3] for source, each in rows.items()},
        {source: each[:, 3:] for source, each in rows.items()},
    )


def result(found: list[Run]) -> dict[str, Any]:
    """Horizontal RMS (m), stated sigma and mean NEES over all runs, and the fixes' own RMS."""
    runs = len(found)
    estimates = {
        label: {
            "rms_m": _rms([run.courses[label].error for run in found]),
            "sigma_m": _rms([run.courses[label].sigma for run in found]),
            "nees_mean": float(np.mean([run.courses[label].nees for run in found])),
        }
        for label in found[0].courses
    }
    fixes = {
        source: _rms([np.hypot(*run.errors[source].T) for run in found])
        for source in found[0].errors
    }
    return {
        "fixes_rms_m": fixes,
        "estimates": estimates,
        "nees_dof": NEES_DOF,
        "nees_interval": nees_interval(runs, NEES_DOF),
        "series": _series(found[0]),
    }


def _rms(values: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


@lru_cache(maxsize=1)
def _true_way() -> Array:
    t_s = np.arange(COUNTED_FROM_S, DURATION_S, 1.0)
    return true_path(truth().at(t_s).position)


def _series(run: Run) -> dict[str, Any]:
    """Paths of one run, north and east (m), for the paper's figures 3 and 4."""
    shown = {label: course.way.tolist() for label, course in run.courses.items()}
    kept = {s: each[each[:, 0] >= COUNTED_FROM_S, 1:].tolist() for s, each in run.fixes.items()}
    return {"truth": _true_way().tolist(), "fixes": kept, "ways": shown}
