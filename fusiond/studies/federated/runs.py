r"""Monte Carlo runs of the `federated` study: a drive with several position sources.

Every filter of a run gets the same samples and fixes through the daemon's own timeline; sensor
errors are drawn from the model that the filters assume, the start from their own P(0). The live
solution is compared once a second.

    NEES = x^T P^-1 x,   x computed minus true: attitude, velocity, position, gyro and accelerometer
    bias (15,)

A fault acts on the first source: `step` moves its fixes by 50 m, `drift` by 0.5 m/s times the time
since its start (both to the north), `frozen` repeats the fix that it begins with.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.assembly import federated
from fusiond.navigator.timeline import Timeline
from fusiond.simulation.imu_truth import Truth, metres_to_geodetic
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import drive
from fusiond.studies.daemon_fed_filter import CHECKPOINT_S, HISTORY_S
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import nav_error, true_nav, with_error
from fusiond.studies.timeline_without_diagnosis import WithoutDiagnosis

Array = NDArray[np.float64]
FaultKind = Literal["", "step", "drift", "frozen"]

ORIGIN_DEG_M = (30.5276, 114.3556, 38.0)
SOURCES = ("first", "second", "third")
EQUAL_M = (3.0, 3.0, 3.0)
"""One sigma of each source, north and east: single-frequency receivers under open sky."""
UNEQUAL_M = (2.0, 6.0, 20.0)
"""One sigma of a receiver with corrections, one without, and an RDSS terminal."""
VERTICAL = 5.0 / 3.0
"""Ratio of sigma down to sigma north."""
GATE = 0.9999
"""The daemon's default."""
DURATION_S, FAULT_START_S, FAULT_END_S = 240.0, 70.0, 170.0
"""Times of the drive: the car starts at 20 m/s and stands from 100 to 125 s."""
STEP_M, DRIFT_M_S = 50.0, 0.5
NEES_EVERY_S, NEES_DOF = 20, 15
SD_ATTITUDE_DEG, SD_VELOCITY_M_S, SD_POSITION_M = (0.3, 0.3, 2.0), 0.2, 5.0

REST_S = 10.0
STUDY_IMU = Imu(
    rate_hz=50.0, gyro_bias_initial_deg_h=36.0, gyro_scale_ppm=1e-6, accel_scale_ppm=1e-6
)
"""Default IMU without scale factor errors, for which `ins15` has no states, and with a tenth of the
gyros' turn-on bias: the full bias turns the heading by degrees before the car drives off, and the
linearisation, not the filter, would then determine the NEES."""


@dataclass(frozen=True, slots=True)
class Filter:
    """Filter of a line of the result; without options the centralised one. `isolates`: sources are
    judged by the daemon's diagnosis too (`fusiond.integrity.diagnosis`)."""

    name: str
    options: FederatedOptions | None = None
    isolates: bool = False


@dataclass(slots=True)
class Trace:
    """Trace of one filter in one run: error (m, 9) once a second, NEES, the isolation of the faulty
    source (s, NaN: never), and the number of false isolations."""

    error: Array
    nees: list[float] = field(default_factory=list)
    isolated_s: float = math.nan
    false_alarms: int = 0


@lru_cache(maxsize=1)
def truth() -> Truth:
    """First minutes of the drive of `fusiond simulate`."""
    lat, lon, height = ORIGIN_DEG_M
    position = (lat * DEG, lon * DEG, height)
    return Truth(drive(DURATION_S, REST_S), position, STUDY_IMU.rate_hz, DURATION_S)


@lru_cache(maxsize=1)
def grid() -> tuple[Array, Array]:
    """Instants (m,) and true navigation states (m, 10)."""
    t_s: Array = np.arange(1.0, DURATION_S, 1.0)
    return t_s, true_nav(truth(), t_s)


def fixes(
    rng: np.random.Generator, fault: FaultKind, sd_m: tuple[float, ...] = EQUAL_M
) -> list[PositionMeasurement]:
    """Fixes of all sources in order of validity: each once a second, staggered."""
    count = len(SOURCES)
    t_s = np.arange(1.0, DURATION_S, 1.0 / count)
    at = truth().at(t_s).position
    sd = np.outer(np.resize(sd_m, len(t_s)), [1.0, 1.0, VERTICAL])
    error = rng.standard_normal((len(t_s), 3)) * sd
    first = np.arange(len(t_s)) % count == 0
    faulty = first & (t_s >= FAULT_START_S) & (t_s < FAULT_END_S)
    if fault == "step":
        error[faulty, 0] += STEP_M
    elif fault == "drift":
        error[faulty, 0] += DRIFT_M_S * (t_s[faulty] - FAULT_START_S)
    positions = at + metres_to_geodetic(at[:, 0], at[:, 2], error)
    if fault == "frozen":
        positions[faulty] = positions[np.flatnonzero(faulty)[0]]
    return [
        PositionMeasurement(
            SOURCES[k % count],
            round(t * 1e9),
            GATE,
            float(p[0]),
            float(p[1]),
            float(p[2]),
            (sd_m[k % count], sd_m[k % count], sd_m[k % count] * VERTICAL),
            (0.0, 0.0, 0.0),
        )
        for k, (t, p) in enumerate(zip(t_s, positions, strict=True))
    ]


def estimator_of(filter_: Filter, model: Model) -> Estimator:
    """Make a filter of the study."""
    if filter_.options is None:
        return KalmanEstimator(model, STUDY_IMU.gap_s)
    return federated(model, STUDY_IMU.gap_s, SOURCES, filter_.options)


def initial_sd(model: Model) -> Array:
    """One sigma (n,) of the errors at the start."""
    sd = model.initial.copy()
    sd[0:3] = np.array(SD_ATTITUDE_DEG) * DEG
    sd[3:6], sd[6:9] = SD_VELOCITY_M_S, SD_POSITION_M
    return sd


def simulate(
    filters: tuple[Filter, ...],
    fault: FaultKind,
    sd_m: tuple[float, ...],
    seed: int,
    number: int,
) -> dict[str, Trace]:
    """Run `number`: every filter on the same errors."""
    rng = np.random.default_rng([seed, number])
    out = imu_output(STUDY_IMU, truth().gyro, truth().accel, rng)
    samples = np.hstack([out.gyro, out.accel])
    biases = np.hstack([out.gyro_bias, out.accel_bias])
    measurements = fixes(rng, fault, sd_m)
    model = make_model("ins15", imu_noise(STUDY_IMU))
    sd = initial_sd(model)
    start = with_error(true_nav(truth(), np.zeros(1))[0], rng.standard_normal(9) * sd[:9])
    return {f.name: _run(f, model, samples, biases, measurements, start, fault) for f in filters}


def _run(
    filter_: Filter,
    model: Model,
    samples: Array,
    biases: Array,
    measurements: list[PositionMeasurement],
    start: Array,
    fault: FaultKind,
) -> Trace:
    estimator = estimator_of(filter_, model)
    rate = STUDY_IMU.rate_hz
    imu = ImuBuffer(rate, HISTORY_S, np.eye(3), 0.0, STUDY_IMU.gap_s)
    timeline = Timeline(estimator, imu, HISTORY_S, CHECKPOINT_S)
    if not filter_.isolates:
        timeline.diagnosis = WithoutDiagnosis()
    p = np.diag(initial_sd(model) ** 2)
    estimator.initialise(0, 0, start, np.zeros(model.size), p)
    timeline.start()
    t_s, true = grid()
    trace = Trace(np.empty((len(t_s), 9)))
    given = next_measurement = 0
    known: set[str] = set()
    for i, t in enumerate(t_s):
        end = round(t * rate)
        times = np.arange(given + 1, end + 1, dtype=np.int64) * round(1e9 / rate)
        imu.append(times, samples[given:end])
        given = end
        while next_measurement < len(measurements) and measurements[next_measurement].t_ns <= round(
            t * 1e9
        ):
            timeline.insert(measurements[next_measurement])
            next_measurement += 1
        timeline.advance()
        new = set(estimator.isolated) - known
        known = set(estimator.isolated)
        if new:
            right = bool(fault) and t >= FAULT_START_S and SOURCES[0] in new
            if right and math.isnan(trace.isolated_s):
                trace.isolated_s = float(t)
            trace.false_alarms += len(new - ({SOURCES[0]} if right else set()))
        trace.error[i] = nav_error(estimator.nav, true[i])
        if not fault and round(t) % NEES_EVERY_S == 0:
            x = np.concatenate([trace.error[i], biases[end - 1] - estimator.xi[9:15]])
            trace.nees.append(float(x @ np.linalg.solve(estimator.covariance[:15, :15], x)))
    return trace


def monte_carlo(
    filters: tuple[Filter, ...],
    fault: FaultKind,
    sd_m: tuple[float, ...],
    runs: int,
    seed: int,
    progress: Callable[[], None] | None = None,
) -> list[dict[str, Trace]]:
    """Runs in order; on two processes when there are enough of them."""
    return map_runs(partial(simulate, filters, fault, sd_m, seed), runs, progress)
