r"""Live runs of study `reduced-order`: errors of the running filters.

A run draws IMU errors, clock, misalignment and noise as the 23 states describe them and lets the
daemon's filter (`fusiond.estimators.kalman`) fly with it. Its error is taken in the combinations
that truth and every filter have: navigation errors, gyro drift (constant and Markov together),
accelerometer bias, clock, misalignment. A state that the filter lacks counts with all of itself.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from os import cpu_count

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import State
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.model import (
    CLOCK_DRIFT,
    CLOCK_OFFSET,
    SAR_MISALIGNMENT,
    ClockNoise,
    Model,
)
from fusiond.navigation.error_model import CORE_SIZE, FORCE_ERROR, RATE_ERROR
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.simulation.sensor_errors import imu_output
from fusiond.studies import reduced_flight as flight
from fusiond.studies.rdss_runs import nav_error, with_error

Array = NDArray[np.float64]

VALIDATION_S = 600.0
CHECKED_S = 100
"""Errors are taken at every 100th second."""
WORKERS = 2


def combinations(of: Model) -> Array:
    """Matrix (20, n): from a model's states to the combinations of the module's text."""
    pick = np.eye(of.size)
    found = [pick[:CORE_SIZE]]
    for first in (RATE_ERROR, FORCE_ERROR):
        for axis in range(3):
            found.append(pick[of.parameters(first + axis)].sum(axis=0, keepdims=True))
    for block in (CLOCK_OFFSET, CLOCK_DRIFT, SAR_MISALIGNMENT):
        found.append(pick[of.slots_of(block)])
    return np.vstack(found)


@dataclass(slots=True)
class Flown:
    """One filter in one run: error (k, 20) and what it believes of it (k, 20, 20)."""

    error: Array
    believed: Array


def fly(models: dict[str, Model], seconds: float, seed: int, number: int) -> dict[str, Flown]:
    """Run `number`: every filter on the same errors. The first of `models` describes the truth."""
    rng = np.random.default_rng([seed, number])
    true_model = next(iter(models.values()))
    path = flight.truth(seconds)
    nav = flight.true_nav(path)
    scenes = flight.scenes(seconds)
    imu = imu_output(flight.IMU, path.gyro, path.accel, rng)
    samples = np.hstack([imu.gyro, imu.accel])
    sd = flight.initial_sd(true_model)
    start = rng.standard_normal(CORE_SIZE) * sd[:CORE_SIZE]
    xi = sd * rng.standard_normal(len(sd))  # of it the clock and the misalignment are used
    clock = _clock(rng, xi[_clock_slots(true_model)], len(scenes))
    noise = rng.standard_normal((len(scenes), flight.ROWS))
    step = np.zeros(STEP_SIZE)
    filters = {name: started(of, with_error(nav[0], start)) for name, of in models.items()}
    buffer = flight.imu_buffer(samples)
    true = np.zeros(len(combinations(true_model)))
    errors: dict[str, list[Array]] = {name: [] for name in models}
    beliefs: dict[str, list[Array]] = {name: [] for name in models}
    project = {name: combinations(of) for name, of in models.items()}
    for k, scene in enumerate(scenes):
        xi[_clock_slots(true_model)] = clock[k]
        aids = flight.measured(scene, State(nav[k + 1], xi, step, true_model), noise[k])
        for estimator in filters.values():
            estimator.propagate(buffer, scene.t_ns)
            for aid in aids:
                if (outcome := estimator.update(aid)).name != "fused":
                    raise ValueError(f"run {number}, {aid.source} at {k + 1} s: {outcome.name}")
        if (k + 1) % CHECKED_S == 0:
            sample = round((k + 1) * flight.IMU.rate_hz) - 1
            true[9:12], true[12:15] = imu.gyro_bias[sample], imu.accel_bias[sample]
            true[15:17] = clock[k]
            true[17:20] = xi[true_model.slots_of(SAR_MISALIGNMENT)]
            for name, e in filters.items():
                m = project[name]
                error = true - m @ e.xi
                error[:CORE_SIZE] = nav_error(e.nav, nav[k + 1])
                errors[name].append(error)
                beliefs[name].append(m @ e.covariance @ m.T)
    return {name: Flown(np.array(errors[name]), np.array(beliefs[name])) for name in models}


def _clock_slots(of: Model) -> list[int]:
    return of.slots_of(CLOCK_OFFSET) + of.slots_of(CLOCK_DRIFT)


def _clock(rng: np.random.Generator, start: Array, steps: int) -> Array:
    """Offset (m) and drift (m/s) (steps, 2) after 1, 2, ... s, as ClockNoise describes them."""
    n = ClockNoise()
    s, w = n.offset_white, n.drift_white
    root = np.linalg.cholesky(np.array([[s + w / 3.0, w / 2.0], [w / 2.0, w]]))
    out = np.empty((steps, 2))
    offset, drift = start
    for k, (a, b) in enumerate(rng.standard_normal((steps, 2)) @ root.T):
        offset, drift = offset + drift + a, drift + b
        out[k] = offset, drift
    return out


def started(of: Model, nav: Array) -> KalmanEstimator:
    """A filter at the start of the flight with navigation state (10,)."""
    estimator = KalmanEstimator(of, flight.IMU.gap_s)
    estimator.initialise(0, 0, nav, np.zeros(of.size), np.diag(flight.initial_sd(of) ** 2))
    return estimator


def monte_carlo(
    models: dict[str, Model], runs: int, seed: int, progress: Callable[[], None]
) -> dict[str, Flown]:
    """All runs, stacked: error (runs, k, 20) and belief (runs, k, 20, 20) of each filter."""
    found = []
    with ProcessPoolExecutor(min(WORKERS, cpu_count() or 1, runs)) as pool:
        for one in pool.map(partial(fly, models, VALIDATION_S, seed), range(runs)):
            found.append(one)
            progress()
    return {
        name: Flown(
            np.array([one[name].error for one in found]),
            np.array([one[name].believed for one in found]),
        )
        for name in models
    }
