r"""Monte Carlo runs of the study `ukf`: problems for unscented and extended filters.

`double_star`   slant ranges of a terminal to two geostationary satellites every 1.5 s, from the two
                path lengths that the centre measures (fusiond.aiding.rdss_fix_covariance), and a
                height
`pseudorange`   pseudoranges and rates of 4 to 10 BeiDou satellites every second, with the states of
                a receiver clock whose drift is a first-order Markov process (paper 003)

each from a fair start and, as `*_poor`, from one that is off by 10 km and 5 deg, one sigma an axis;
pseudoranges also, as `*_heading`, from a fair start but for its heading, of 90 deg, one sigma.
Estimator, timeline, gates and screening are the daemon's. The vehicle is the drive of `fusiond
simulate`, 500 s as in paper 003. A run draws IMU, clock, noise, satellites and start, every filter
gets the same; errors are drawn from the very models that the filters assume, so NEES of the
navigation errors (9,) is chi-square for a filter that handles what is not linear.

    NEES = x^T P^-1 x,   x computed minus true: attitude, velocity, position
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from fusiond.aiding.base import AidingMeasurement, NotApplicable
from fusiond.aiding.height import HeightMeasurement
from fusiond.aiding.pseudorange import NO_CLOCK, PseudorangeMeasurement, epoch_values
from fusiond.aiding.rdss_fix_covariance import GEOSTATIONARY_RADIUS_M, LONGITUDES_DEG, RdssGeometry
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.estimators.update_with_exclusion import KEPT
from fusiond.gnss.ecef import ned_axes, to_ecef
from fusiond.gnss.nominal_constellation import Constellation, constellation
from fusiond.models.blocks import ClockNoise, clock_blocks
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigator.timeline import Entry
from fusiond.studies.daemon_fed_filter import (
    DURATION_S,
    ORIGIN_DEG_M,
    RATE_HZ,
    DaemonFedFilter,
    drive_samples,
    drive_truth,
)
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

IMU = Imu(
    rate_hz=RATE_HZ,
    gyro_noise_deg_sqrt_h=0.05,
    accel_noise_m_s_sqrt_h=0.02,
    gyro_bias_initial_deg_h=10.0,
    gyro_bias_instability_deg_h=1.0,
    accel_bias_initial_mg=1.0,
    accel_bias_instability_mg=0.1,
    gyro_scale_ppm=1e-6,
    accel_scale_ppm=1e-6,
)
"""White noise as `config/tactical.toml`; the model is `ins15`, which has no scale factors."""
CLOCK = ClockNoise(drift_initial=30.0, drift_white=0.0, drift_tau_s=1000.0, drift_steady=30.0)
"""Paper 003's first-order Markov drift, of 0.1 ppm."""
LEVER = (0.4, -0.3, -1.2)
SLANT_SD_M, HEIGHT_SD_M = 15.3, 10.0
"""A slant range after differential correction, and a height: see docs/rdss-accuracy.md."""
RANGE_SD_M, RATE_SD_M_S = 3.0, 0.1
SATELLITES = (4, 10)
MASK_RAD, MOST_PDOP = 10.0 * DEG, 6.0
"""Mask and PDOP: satellites of a run are above the mask and within the customary PDOP."""
START = (2300, 345_600.0)
"""Start as GPS week and second."""
GATE = 1.0 - 1e-9
"""Gate so wide that a matched filter rejects nothing; a rejection shows a bad prediction."""
COUNTED_S = 30.0
"""Time from which errors count: after the first corrections of a poor start."""
NEES_EVERY_S = 15.0
"""Interval of NEES: a whole number of epochs of either problem."""
LAST_S = 100.0

FILTERS: dict[str, Callable[[Model], KalmanEstimator]] = {
    "ukf": lambda model: UnscentedEstimator(model, IMU.gap_s, propagation=True),
    "ukf_measurements": lambda model: UnscentedEstimator(model, IMU.gap_s),
    "ekf": lambda model: KalmanEstimator(model, IMU.gap_s),
    "invariant": lambda model: InvariantFilter(model, IMU.gap_s),
}
"""Filters with sigma points for all, for the measurements alone (the daemon's default), and
without: in plain errors, and with errors that turn with the heading, as in the start of the
daemon's `kalman`."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Measurements of a case, their rate, and one sigma of the start: horizontal position and
    height (m), velocity (m/s), tilt and heading (deg)."""

    name: str
    clock: bool
    every_s: float
    start: tuple[float, float, float, float, float]


_FAIR, _POOR = (100.0, 30.0, 0.5, 0.2, 2.0), (10_000.0, 100.0, 1.0, 5.0, 5.0)
PROBLEMS = (
    Problem("double_star", False, 1.5, _FAIR),
    Problem("double_star_poor", False, 1.5, _POOR),
    Problem("pseudorange", True, 1.0, _FAIR),
    Problem("pseudorange_poor", True, 1.0, _POOR),
    Problem("pseudorange_heading", True, 1.0, (*_FAIR[:4], 90.0)),
)


@dataclass(slots=True)
class Trace:
    """Trace of one filter in one run: horizontal error (m) at each epoch, NEES after the first
    epoch and every `NEES_EVERY_S` seconds, convergence, and refused rows or measurements.

    Converged: over the last `LAST_S` the horizontal RMS is at most one sigma of what a single
    epoch's measurements give without an INS."""

    horizontal: Array
    nees_first: float
    nees: Array
    converged: bool
    refused: int


# --------------------------------------------------------------------------- what is simulated


def epochs(problem: Problem) -> Array:
    """Instants (n,), s."""
    return np.arange(1, int(DURATION_S / problem.every_s) + 1, dtype=np.float64) * problem.every_s


@lru_cache(maxsize=2)
def _true_states(every_s: float) -> tuple[Array, Array, Array]:
    """Navigation states (n + 1, 10) at 0 and each epoch, the antenna's ECEF position and velocity
    (n + 1, 3)."""
    t_s: Array = np.arange(int(DURATION_S / every_s) + 1, dtype=np.float64) * every_s
    antenna = drive_truth().at(t_s, LEVER)
    place = np.array([to_ecef(*map(float, p)) for p in antenna.position])
    turned = [
        ned_axes(float(p[0]), float(p[1])) @ v
        for p, v in zip(antenna.position, antenna.v_ned, strict=True)
    ]
    return true_nav(drive_truth(), t_s), place, np.array(turned)


@lru_cache(maxsize=1)
def _satellites() -> tuple[tuple[str, ...], Array, Array]:
    """Names, positions and velocities (epochs, n, 3) of the BeiDou satellites above the mask
    throughout."""
    week, tow_s = START
    sky = Constellation(constellation(week, tow_s, ("C",)))
    lat, lon, height = ORIGIN_DEG_M
    start_s = week * 604_800.0 + tow_s
    views = [
        sky.line_of_sight(lat * DEG, lon * DEG, height, start_s + t).elevation
        for t in (0.0, DURATION_S)
    ]
    up = np.min(views, axis=0) > MASK_RAD
    states = [sky.positions(start_s + t) for t in epochs(PROBLEMS[2])]
    names = tuple(s for s, k in zip(sky.satellites, up, strict=True) if k)
    return names, np.array([p[up] for p, _ in states]), np.array([v[up] for _, v in states])


def _geostationary() -> Array:
    a = np.radians(LONGITUDES_DEG)
    return GEOSTATIONARY_RADIUS_M * np.column_stack([np.cos(a), np.sin(a), np.zeros(2)])


def _dop(position: Array) -> tuple[float, float]:
    """PDOP and HDOP of satellites (n, 3) with one clock, at the origin."""
    lat, lon, height = ORIGIN_DEG_M
    range_m = position - np.array(to_ecef(lat * DEG, lon * DEG, height))
    unit = range_m / np.linalg.norm(range_m, axis=1)[:, None] @ ned_axes(lat * DEG, lon * DEG)
    g = np.column_stack([unit, np.ones(len(unit))])
    if np.linalg.cond(g) > 1e6:
        return math.inf, math.inf
    q = np.diag(np.linalg.inv(g.T @ g))
    return math.sqrt(q[:3].sum()), math.sqrt(q[:2].sum())


def draw_satellites(rng: np.random.Generator, number: int) -> tuple[Indices, float]:
    """Indices of the satellites of a run, 4 to 10 in turn, and their HDOP."""
    names, position, _ = _satellites()
    least, most = SATELLITES
    count = min(least + number % (most - least + 1), len(names))
    while True:
        chosen = np.sort(rng.choice(len(names), count, replace=False))
        pdop, hdop = _dop(position[0, chosen])
        if pdop < MOST_PDOP:
            return chosen, hdop


def draw_clock(rng: np.random.Generator) -> tuple[Array, Array]:
    """Offset (m) and drift (m/s) at each IMU sample, from the filter's model."""
    n, h = round(DURATION_S * IMU.rate_hz), 1.0 / IMU.rate_hz
    decay = math.exp(-h / CLOCK.drift_tau_s)
    noise = rng.standard_normal(n) * CLOCK.drift_steady * math.sqrt(1.0 - decay * decay)
    start = rng.standard_normal() * CLOCK.drift_initial
    drift, _ = lfilter([1.0], [1.0, -decay], noise, zi=[decay * start])
    before = np.r_[start, drift[:-1]]
    white = rng.standard_normal(n) * math.sqrt(CLOCK.offset_white * h)
    offset = rng.standard_normal() * CLOCK.offset_initial + np.cumsum(h * before + white)
    return offset, drift


def _pseudoranges(
    rng: np.random.Generator, number: int
) -> tuple[list[list[AidingMeasurement]], float]:
    names, position, velocity = _satellites()
    chosen, hdop = draw_satellites(rng, number)
    offset, drift = draw_clock(rng)
    t_s = epochs(PROBLEMS[2])
    _, place, moving = _true_states(PROBLEMS[2].every_s)
    n = len(chosen)
    found: list[list[AidingMeasurement]] = []
    for k, t in enumerate(t_s):
        sample = round(t * IMU.rate_hz) - 1
        range_m = position[k, chosen] - place[k + 1]
        distance = np.linalg.norm(range_m, axis=1)
        along = (range_m / distance[:, None] * (velocity[k, chosen] - moving[k + 1])).sum(axis=1)
        found.append(
            [
                PseudorangeMeasurement(
                    "raw",
                    round(t * 1e9),
                    GATE,
                    tuple(names[i] for i in chosen),
                    epoch_values(
                        position[k, chosen],
                        velocity[k, chosen],
                        distance + offset[sample] + RANGE_SD_M * rng.standard_normal(n),
                        along + drift[sample] + RATE_SD_M_S * rng.standard_normal(n),
                        np.full(n, RANGE_SD_M**2),
                        np.full(n, RATE_SD_M_S**2),
                    ),
                    np.zeros(n, dtype=np.int64),
                    LEVER,
                )
            ]
        )
    return found, hdop * RANGE_SD_M


def _double_star(rng: np.random.Generator) -> tuple[list[list[AidingMeasurement]], float]:
    satellites, nothing = _geostationary(), np.full(2, np.nan)
    lat, lon, height = ORIGIN_DEG_M
    fix = RdssGeometry().covariance(lat * DEG, lon * DEG, height, SLANT_SD_M, HEIGHT_SD_M)
    assert not isinstance(fix, NotApplicable)
    nav, place, _ = _true_states(PROBLEMS[0].every_s)
    found: list[list[AidingMeasurement]] = []
    for k, t in enumerate(epochs(PROBLEMS[0])):
        t_ns = round(t * 1e9)
        slant = np.linalg.norm(satellites - place[k + 1], axis=1)
        slant += SLANT_SD_M * rng.standard_normal(2)
        paths = 2.0 * slant[0], slant[0] + slant[1]  # what the centre measures
        ranges = np.array([0.5 * paths[0], paths[1] - 0.5 * paths[0]])
        found.append(
            [
                PseudorangeMeasurement(
                    "rdss",
                    t_ns,
                    GATE,
                    ("east", "west"),
                    epoch_values(
                        satellites,
                        np.zeros((2, 3)),
                        ranges,
                        nothing,
                        np.full(2, SLANT_SD_M**2),
                        nothing,
                    ),
                    np.full(2, NO_CLOCK),
                    LEVER,
                ),
                HeightMeasurement(
                    "height",
                    t_ns,
                    GATE,
                    float(nav[k + 1, 2] + HEIGHT_SD_M * rng.standard_normal()),
                    HEIGHT_SD_M,
                ),
            ]
        )
    return found, math.sqrt(float(np.trace(fix.total)))


# --------------------------------------------------------------------------- one run


def _model(problem: Problem) -> Model:
    return make_model(
        "ins15", imu_noise(IMU), *(clock_blocks(noise=CLOCK) if problem.clock else ())
    )


def simulate(problem: Problem, seed: int, number: int) -> dict[str, Trace]:
    """Run `number` of a problem: every filter on the same errors."""
    rng = np.random.default_rng([seed, number])
    samples = drive_samples(IMU, rng)
    measurements, epoch_sd_m = _pseudoranges(rng, number) if problem.clock else _double_star(rng)
    model = _model(problem)
    sd = model.initial.copy()
    horizontal, height, velocity, tilt, heading = problem.start
    sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[horizontal] * 2, height]
    error = rng.standard_normal(9) * sd[:9]
    nav = _true_states(problem.every_s)[0]
    start = with_error(nav[0], error)
    traces = {}
    for name, make in FILTERS.items():
        live = DaemonFedFilter(make(model), IMU.gap_s, samples, start, sd)
        estimator = live.estimator
        if isinstance(estimator, InvariantFilter):
            estimator.turns = True
        off, nees, first = np.empty(len(measurements)), [], math.nan
        for k, epoch in enumerate(measurements):
            live.advance((k + 1) * problem.every_s, epoch)
            x = nav_error(estimator.nav, nav[k + 1])
            off[k] = math.hypot(x[6], x[7])
            if k == 0 or (k + 1) % round(NEES_EVERY_S / problem.every_s) == 0:
                value = float(x @ np.linalg.solve(estimator.covariance[:9, :9], x))
                if k == 0:
                    first = value
                else:
                    nees.append(value)
        last = off[-round(LAST_S / problem.every_s) :]
        refused = sum(_refused(entry) for entry in live.entries)
        converged = math.sqrt(float(np.mean(last**2))) <= epoch_sd_m
        traces[name] = Trace(off, first, np.array(nees), converged, refused)
    return traces


def _refused(entry: Entry) -> int:
    """Rows of an applied measurement that were refused; a whole measurement counts once."""
    outcome = entry.outcome
    if outcome is None or outcome.name != "fused":
        return 1
    return sum(code != KEPT for code in outcome.rows)


def monte_carlo(
    problem: Problem, runs: int, seed: int, progress: Callable[[], None] | None = None
) -> list[dict[str, Trace]]:
    """Runs of a problem in order, on two processes."""
    return map_runs(partial(simulate, problem, seed), runs, progress)
