r"""Monte Carlo runs of the `rdss-*` studies: strategies for the delay of RDSS fixes.

A run draws IMU samples and fixes. Every filter of the study receives them in order of arrival,
through the daemon's own intake, timeline and estimator. The *live* solution is compared: the state
at an instant by the data that had arrived, never smoothed.

The filters start from the truth plus an error drawn from their own P0; sensor and fix errors are
drawn from the very models that they assume unless the case says otherwise, so that the filter that
treats the delay rightly is matched and its NEES is chi-square.

    NEES = x^T P^-1 x,   x computed minus true (12,): attitude, velocity and position north and
    east, gyro drift (constant + Markov part) x y z, accelerometer error x y
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, MonotonicStamp
from fusiond.aiding.base import NotApplicable
from fusiond.aiding.rdss_fix_covariance import RdssGeometry, with_floor
from fusiond.configuration.aiding import RdssAiding
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.intake import Intake
from fusiond.navigator.timeline import Entry, Timeline
from fusiond.simulation.imu_truth import Truth, metres_to_geodetic
from fusiond.simulation.markov import gauss_markov
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Path as Trajectory
from fusiond.studies.daemon_fed_filter import CHECKPOINT_S, HISTORY_S
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error

Array = NDArray[np.float64]

YANTAI_DEG_M = (37.5, 121.4, 40.0)
"""Position of the experiments of paper 000. There eq. 4 with their 8, 13 and 10 m gives 22 m north
and 19 m east: 29 m in all, their "30 m"."""
CLASS_M = 20
GRID_S = 1.5
"""Interval of comparison of the live solution: the paper's step."""
NEES_EVERY = 8
"""Grid points from one NEES to the next."""
GATE = 1.0 - 1e-12
"""Gate so wide that no strategy hides its errors by rejecting fixes."""

PAPER_IMU = Imu(
    rate_hz=20.0,
    gyro_noise_deg_sqrt_h=0.05,
    accel_noise_m_s_sqrt_h=0.02,
    gyro_bias_initial_deg_h=1.0,
    gyro_bias_instability_deg_h=1.0,
    accel_bias_initial_mg=1e-9,
    accel_bias_instability_mg=0.1,
    bias_correlation_s=3600.0,
    gyro_scale_ppm=1e-6,
    accel_scale_ppm=1e-6,
)
"""IMU with the paper's constant and Markov drift of 1 deg/h and 3600 s, and an accelerometer
without a constant part. The paper prints no accelerometer figure and no white noise: 100 ug, and
those of `config/tactical.toml`."""

Strategy = Literal["rewind", "optimal_prediction", "position_compensation", "none"]


@dataclass(frozen=True, slots=True)
class Filter:
    """Filter of a line of the result, with its strategy for the delay; without one the INS
    alone."""

    name: str
    strategy: Strategy | None
    bias_sd_m: float = 0.0
    bias_correlation_s: float = 600.0


STRATEGIES: tuple[Filter, ...] = (
    Filter("rewind", "rewind"),
    Filter("optimal_prediction", "optimal_prediction"),
    Filter("position_compensation", "position_compensation"),
    Filter("none", "none"),
    Filter("ins_alone", None),
)
RDSS_ALONE = "rdss_alone"


@dataclass(frozen=True, slots=True)
class Case:
    """Case of the simulation. Fixes are asked for at `first_s` + k `spacing_s` and arrive `delay_s`
    later; none inside `away_s` (start, end). Errors count inside `counted_s` (start, end)."""

    name: str
    path: Callable[[float], Trajectory]
    duration_s: float
    spacing_s: float = 1.5
    delay_s: float = 1.5
    first_s: float = 1.5
    away_s: tuple[tuple[float, float], ...] = ()
    counted_s: tuple[tuple[float, float], ...] = ((0.0, math.inf),)
    imu: Imu = PAPER_IMU
    window: int = 50
    """K of a window of the consistency tests, as the paper's."""
    shared_sd_m: float = 0.0
    """Gauss-Markov error that successive fixes share, an axis, beside the white one."""
    shared_correlation_s: float = 600.0
    filters: tuple[Filter, ...] = STRATEGIES
    sd_attitude_deg: float = 30.0 / 3600.0
    sd_velocity_m_s: float = 0.1
    sd_position_m: float = 100.0
    """Initial errors: the paper's figures, taken as one sigma an axis."""


@dataclass(slots=True)
class Fixes:
    """Instants of validity and arrival (n,), s; latitude and longitude (n, 2), rad."""

    t_s: Array
    arrival_s: Array
    position: Array


@dataclass(slots=True)
class Trace:
    """Trace of one filter in one run: north and east error of position and velocity (m, 2) on the
    grid, NEES at every `NEES_EVERY`-th point, whitened innovations (n, 2) in order of validity."""

    error: Array
    velocity: Array
    nees: Array = field(default_factory=lambda: np.zeros(0))
    position_nees: Array = field(default_factory=lambda: np.zeros(0))
    innovations: Array = field(default_factory=lambda: np.zeros((0, 2)))
    gated: int = 0


# --------------------------------------------------------------------------- what is simulated


@lru_cache(maxsize=4)
def _truth(case: Case) -> Truth:
    lat, lon, height = YANTAI_DEG_M
    path = case.path(case.duration_s)
    return Truth(path, (lat * DEG, lon * DEG, height), case.imu.rate_hz, case.duration_s)


@lru_cache(maxsize=4)
def grid(case: Case) -> tuple[Array, Array]:
    """Instants (m,) and the true navigation states (m, 10) at them."""
    t_s: Array = np.arange(round(case.duration_s / GRID_S) + 1, dtype=np.float64) * GRID_S
    return t_s, true_nav(_truth(case), t_s)


def fix_covariance() -> Array:
    """Covariance (2, 2) that the intake gives a fix here: geometry, the class as its floor."""
    o = RdssAiding()
    lat, lon, height = YANTAI_DEG_M
    found = RdssGeometry(o.satellites_deg).covariance(
        lat * DEG, lon * DEG, height, o.range_sd_m, o.height_sd_m
    )
    assert not isinstance(found, NotApplicable)
    return with_floor(found.total, CLASS_M)


def imu_samples(case: Case, rng: np.random.Generator) -> tuple[Array, Array]:
    """IMU samples (n, 6) and their biases (n, 6): rate x y z, force x y z."""
    truth = _truth(case)
    imu = imu_output(case.imu, truth.gyro, truth.accel, rng)
    return np.hstack([imu.gyro, imu.accel]), np.hstack([imu.gyro_bias, imu.accel_bias])


def draw_fixes(case: Case, rng: np.random.Generator) -> Fixes:
    t_s = np.arange(case.first_s, case.duration_s - case.delay_s + 1e-9, case.spacing_s)
    for start, end in case.away_s:
        t_s = t_s[(t_s < start) | (t_s >= end)]
    error = rng.standard_normal((len(t_s), 2)) @ np.linalg.cholesky(fix_covariance()).T
    if case.shared_sd_m > 0.0:
        steps = round(case.duration_s) + 1
        shared = gauss_markov(
            rng,
            (steps, 2),
            step_s=1.0,
            correlation_s=case.shared_correlation_s,
            sigma=case.shared_sd_m,
        )
        error += shared[np.rint(t_s).astype(int)]
    at = _truth(case).at(t_s).position
    moved = metres_to_geodetic(at[:, 0], at[:, 2], np.column_stack([error, np.zeros(len(t_s))]))
    return Fixes(t_s, t_s + case.delay_s, (at + moved)[:, :2])


# --------------------------------------------------------------------------- one filter


@lru_cache(maxsize=16)
def _aiding(filter_: Filter) -> RdssAiding:
    return RdssAiding(
        strategy=filter_.strategy or "rewind",
        gate_probability=GATE,
        fix_height_sd_m=None,
        bias_sd_m=filter_.bias_sd_m,
        bias_correlation_s=filter_.bias_correlation_s,
    )


class Navigation:
    """Live filter of a study: `advance` it to an instant, then add the arrivals there."""

    def __init__(self, case: Case, filter_: Filter, samples: Array, error: Array) -> None:
        self._intake = Intake({"rdss": _aiding(filter_)})
        extra = self._intake.extra_blocks() if filter_.strategy else []
        self.model = make_model("planar15", imu_noise(case.imu), *extra)
        self.estimator = KalmanEstimator(self.model, case.imu.gap_s)
        self.innovations: dict[int, tuple[float, ...]] = {}
        self.imu = ImuBuffer(case.imu.rate_hz, HISTORY_S, np.eye(3), 0.0, case.imu.gap_s)
        self.timeline = Timeline(self.estimator, self.imu, HISTORY_S, CHECKPOINT_S, self._outcome)
        self._samples, self._given = samples, 0
        self._period_ns = round(1e9 / case.imu.rate_hz)
        sd = initial_sd(case, self.model)
        self.estimator.initialise(
            0, 0, with_error(grid(case)[1][0], error), np.zeros(self.model.size), np.diag(sd**2)
        )
        self.timeline.start()

    def _outcome(self, entry: Entry) -> None:
        """Store the whitened innovation of each fix; a repetition after a rewind replaces it."""
        if entry.outcome is not None and entry.outcome.whitened:
            self.innovations[entry.key[0]] = entry.outcome.whitened

    def advance(self, t_s: float) -> None:
        """Add the IMU samples up to `t_s` and run the filter."""
        end = min(round(t_s * 1e9) // self._period_ns, len(self._samples))
        if end > self._given:
            times = np.arange(self._given + 1, end + 1, dtype=np.int64) * self._period_ns
            self.imu.append(times, self._samples[self._given : end])
            self._given = end
        self.timeline.advance()

    def arrive(self, fixes: Fixes, k: int) -> None:
        """Add fix k at its arrival."""
        t_ns, seen_ns = (round(t[k] * 1e9) for t in (fixes.t_s, fixes.arrival_s))
        lat, lon = (float(x) for x in fixes.position[k])
        fix = DelayedFix("rdss", seen_ns, MonotonicStamp(t_ns), lat, lon, YANTAI_DEG_M[2], CLASS_M)
        found = self._intake.measurements_of(fix, t_ns, 0.0, seen_ns)
        if isinstance(found, str):
            raise ValueError(f"fix refused: {found}")
        for measurement in found:
            self.timeline.insert(measurement)
        self.timeline.advance()

    def nees(self, true: Array, biases: Array) -> tuple[float, float]:
        """NEES of all errors (12,) and of the position (2,); true state (10,), biases (6,)."""
        model, e = self.model, self.estimator
        rows = [np.eye(model.size)[i] for i in range(9) if model.active[i]]
        x = list(nav_error(e.nav, true)[model.active[:9]])
        for axis in range(6):
            slots = model.parameters(9 + axis)
            if slots:
                rows.append(np.eye(model.size)[slots].sum(axis=0))
                x.append(biases[axis] - e.xi[slots].sum())
        project = np.array(rows)
        p, error = project @ e.covariance @ project.T, np.array(x)
        r = slice(5, 7)
        return (
            float(error @ np.linalg.solve(p, error)),
            float(error[r] @ np.linalg.solve(p[r, r], error[r])),
        )


NEES_DOF = 12


def initial_sd(case: Case, model: Model) -> Array:
    """One sigma (n,) of the errors at the start."""
    sd = model.initial.copy()
    sd[0:3] = case.sd_attitude_deg * DEG
    sd[3:6], sd[6:9] = case.sd_velocity_m_s, case.sd_position_m
    sd[~model.active] = 0.0
    return sd


# --------------------------------------------------------------------------- one run


def simulate(case: Case, seed: int, number: int) -> dict[str, Trace]:
    """Run `number` of a case: every filter on the same errors."""
    rng = np.random.default_rng([seed, number])
    t_s, true = grid(case)
    samples, biases = imu_samples(case, rng)
    fixes = draw_fixes(case, rng)
    sd = initial_sd(case, make_model("planar15", imu_noise(case.imu)))
    error = rng.standard_normal(9) * sd[:9]
    to_metres = metres_per_unit(float(true[0, 0]), YANTAI_DEG_M[2])[:2]
    traces = {}
    for f in case.filters:
        run = Navigation(case, f, samples, error)
        trace = Trace(np.empty((len(t_s), 2)), np.empty((len(t_s), 2)))
        nees = []
        for i, k in _events(t_s, fixes.arrival_s):
            if i is None:
                run.advance(fixes.arrival_s[k])
                if f.strategy:
                    run.arrive(fixes, k)
                continue
            run.advance(t_s[i])
            trace.error[i] = (run.estimator.nav[:2] - true[i, :2]) * to_metres
            trace.velocity[i] = run.estimator.nav[3:5] - true[i, 3:5]
            if i % NEES_EVERY == 0 and i > 0 and t_s[i] >= case.counted_s[0][0]:
                sample = round(t_s[i] * case.imu.rate_hz) - 1
                nees.append(run.nees(true[i], biases[sample]))
        trace.nees, trace.position_nees = (np.array(x) for x in zip(*nees, strict=True))
        found = run.innovations
        trace.innovations = np.array([found[t] for t in sorted(found)]).reshape(-1, 2)
        trace.gated = run.timeline.counters.outcomes["rdss"]["gated"]
        traces[f.name] = trace
    last = np.searchsorted(fixes.arrival_s, t_s + 1e-9) - 1
    held = (fixes.position[np.maximum(last, 0)] - true[:, :2]) * to_metres
    held[last < 0] = np.nan
    traces[RDSS_ALONE] = Trace(held, np.full_like(held, np.nan))
    return traces


def _events(grid_s: Array, arrival_s: Array) -> Iterator[tuple[int | None, int]]:
    """Events in order of time: (None, k) fix k arrives, (i, 0) grid point i, which comes after
    it."""
    k = 0
    for i, t_s in enumerate(grid_s):
        while k < len(arrival_s) and arrival_s[k] <= t_s + 1e-9:
            yield None, k
            k += 1
        yield i, 0


def monte_carlo(
    case: Case, runs: int, seed: int, progress: Callable[[], None] | None = None
) -> list[dict[str, Trace]]:
    """Runs of a case in order; on two processes when there are enough of them."""
    return map_runs(partial(simulate, case, seed), runs, progress)
