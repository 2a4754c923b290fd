r"""Live runs of studies `reduced-order` and `ins-gnss-sar`: errors of the running filters.

A run draws IMU errors, clock, misalignment and noise as the 23 states describe them and lets the
daemon's filter (`fusiond.estimators.kalman`) fly with it on the daemon's timeline. Its error is
taken in the combinations that truth and every filter have: navigation errors, gyro drift (constant
and Markov together), accelerometer bias, clock, misalignment. A state that the filter lacks counts
with all of itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import State
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.blocks import CLOCK_DRIFT, CLOCK_OFFSET, SAR_MISALIGNMENT, ClockNoise
from fusiond.models.model import Model
from fusiond.navigation.error_model import CORE_SIZE, FORCE_ERROR, RATE_ERROR
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.navigator.timeline import Timeline
from fusiond.simulation.sensor_errors import imu_output
from fusiond.studies.daemon_fed_filter import CHECKPOINT_S, HISTORY_S
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import nav_error, with_error
from fusiond.studies.reduced_order import flight
from fusiond.studies.timeline_without_diagnosis import WithoutDiagnosis

Array = NDArray[np.float64]


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
class FilterRun:
    """Result of one filter in one run: error (k, 20) and its covariance in the filter (k, 20,
    20)."""

    error: Array
    believed: Array


def fly(
    models: dict[str, Model],
    seconds: float,
    every_s: int,
    all_in_view: bool,
    seed: int,
    number: int,
) -> dict[str, FilterRun]:
    """Run `number`: every filter on the same errors, taken every `every_s` seconds.

    The first of `models` describes the truth. With `all_in_view` a run has the same IMU, clock,
    start and noise of each satellite as without.
    """
    rng = np.random.default_rng([seed, number])
    true_model = next(iter(models.values()))
    path = flight.truth(seconds)
    nav = flight.true_nav(path)
    scenes = flight.scenes(seconds, all_in_view)
    imu = imu_output(flight.IMU, path.gyro, path.accel, rng)
    sd = flight.initial_sd(true_model)
    start = rng.standard_normal(CORE_SIZE) * sd[:CORE_SIZE]
    xi = sd * rng.standard_normal(len(sd))  # of it the clock and the misalignment are used
    clock = _clock(rng, xi[_clock_slots(true_model)], len(scenes))
    noise = rng.standard_normal((len(scenes), flight.DRAWN, 2))

    def given() -> Iterator[flight.Measurements]:
        for k, scene in enumerate(scenes):
            xi[_clock_slots(true_model)] = clock[k]
            true = State(nav[k + 1], xi, np.zeros(STEP_SIZE), true_model)
            yield flight.measured(scene, true, scene.noise(noise[k]))

    filters = {name: started_filter(of, with_error(nav[0], start)) for name, of in models.items()}
    true = np.zeros(len(combinations(true_model)))
    errors: dict[str, list[Array]] = {name: [] for name in models}
    beliefs: dict[str, list[Array]] = {name: [] for name in models}
    project = {name: combinations(of) for name, of in models.items()}
    for second in fly_on_timeline(filters.values(), np.hstack([imu.gyro, imu.accel]), given()):
        if second % every_s:
            continue
        sample = round(second * flight.IMU.rate_hz) - 1
        true[9:12], true[12:15] = imu.gyro_bias[sample], imu.accel_bias[sample]
        true[15:17] = clock[second - 1]
        true[17:20] = xi[true_model.slots_of(SAR_MISALIGNMENT)]
        for name, e in filters.items():
            m = project[name]
            error = true - m @ e.xi
            error[:CORE_SIZE] = nav_error(e.nav, nav[second])
            errors[name].append(error)
            beliefs[name].append(m @ e.covariance @ m.T)
    return {name: FilterRun(np.array(errors[name]), np.array(beliefs[name])) for name in models}


def fly_on_timeline(
    filters: Iterable[KalmanEstimator],
    samples: Array,
    given: Iterable[flight.Measurements],
    rate_hz: float = flight.IMU.rate_hz,
) -> Iterator[int]:
    """Fly started filters on the daemon's timeline; yields the seconds flown, after each.

    `samples` (n, 6) at `rate_hz`; `given` are the measurements of each second. ValueError for a
    measurement that is not fused.
    """
    count = round(rate_hz)
    times = np.arange(1, len(samples) + 1, dtype=np.int64) * round(1e9 / rate_hz)
    timelines = []
    for estimator in filters:
        buffer = ImuBuffer(rate_hz, HISTORY_S, np.eye(3), 0.0, flight.IMU.gap_s)
        timelines.append(Timeline(estimator, buffer, HISTORY_S, CHECKPOINT_S))
        timelines[-1].diagnosis = WithoutDiagnosis()
        timelines[-1].start()
    for k, measurements in enumerate(given):
        second = slice(k * count, (k + 1) * count)
        for timeline in timelines:
            timeline.imu.append(times[second], samples[second])
            entries = [timeline.insert(measurement) for measurement in measurements]
            timeline.advance()
            for entry in entries:
                if entry.outcome is None or entry.outcome.name != "fused":
                    raise ValueError(f"{entry.measurement.source} at {k + 1} s: {entry.outcome}")
        yield k + 1


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


def started_filter(of: Model, nav: Array) -> KalmanEstimator:
    """Start a filter at the begin of the flight with navigation state (10,)."""
    estimator = KalmanEstimator(of, flight.IMU.gap_s)
    estimator.initialise(0, 0, nav, np.zeros(of.size), np.diag(flight.initial_sd(of) ** 2))
    return estimator


def monte_carlo(
    models: dict[str, Model],
    seconds: float,
    every_s: int,
    runs: int,
    seed: int,
    progress: Callable[[], None],
    all_in_view: bool = False,
) -> dict[str, FilterRun]:
    """Runs of `fly`, stacked: error (runs, k, 20) and covariance (runs, k, 20, 20) by filter."""
    one_run = partial(fly, models, seconds, every_s, all_in_view, seed)
    found = map_runs(one_run, runs, progress)
    return {
        name: FilterRun(
            np.array([one[name].error for one in found]),
            np.array([one[name].believed for one in found]),
        )
        for name in models
    }


def nees(error: Array, p: Array) -> Array:
    """NEES e^T P^-1 e (runs, k) for errors (runs, k, m) and covariances (1 or runs, k, m, m).

    States differ by ten orders of magnitude: scaled to unit variance first.
    """
    sd = np.sqrt(np.diagonal(p, axis1=-2, axis2=-1))
    unit = p / (sd[..., :, None] * sd[..., None, :])
    scaled = error / sd
    solved = np.linalg.solve(
        np.broadcast_to(unit, (*error.shape, error.shape[-1])), scaled[..., None]
    )
    return np.asarray((scaled * solved[..., 0]).sum(axis=-1))
