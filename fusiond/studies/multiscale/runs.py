r"""Runs of the study `multiscale`: paper 001's system, every filter on the same errors.

Paper 001 prints: start at heading 90 deg, level, 118 E 29 N 50 m; gyro drift 0.1 deg/s,
accelerometer 1e-3 g, IMU every 20 ms; GPS 8 m and 0.5 m/s, star tracker 200 arc seconds, both 1 Hz;
10 states. It prints no correlation time, no white noise, no trajectory. Taken here: the drift is
the steady sigma of the Markov states, 3600 s (paper 000's); 1e-3 g is white from sample to sample,
which is all that a model without accelerometer states can hold; angle random walk 0.3 deg/sqrt(h),
a MEMS gyro's; a micro air vehicle at 8 to 16 m/s that flies level in circuits of coordinated turns.

`federated` has one local filter for GPS and one for the star tracker and no reset: nothing comes
from one into the other. `federated_fusion_reset` begins anew from the master after every fusion.

In the case `bias` the accelerometer has a constant 1e-3 g (one sigma) beside, of which the model
knows nothing.

    NEES = x^T P^-1 x,   x computed minus true (10,): attitude, velocity and position north and
    east, gyro drift x y z
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, repeat

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.attitude import AttitudeMeasurement
from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.federated.no_reset import NoResetFilter
from fusiond.estimators.federated.options import FederatedOptions
from fusiond.estimators.federated.reset import ResetFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multiscale.filter import MultiscaleEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import Leg, follow
from fusiond.studies.monte_carlo import map_runs
from fusiond.studies.navigation_error import metres_per_unit, nav_error, true_nav, with_error

Array = NDArray[np.float64]

ORIGIN_DEG_M = (29.0, 118.0, 50.0)
RATE_HZ, PERIOD_S = 50.0, 1.0
DURATION_S, COUNTED_FROM_S = 400.0, 60.0
"""Duration and counted part; errors of the start decrease in the first minute."""
GPS_M, GPS_M_S, TRACKER_RAD = 8.0, 0.5, 200.0 / 3600.0 * DEG
BIAS_MG = 1.0
GATE = 1.0 - 1e-12
"""Gate so wide that no filter hides its errors by rejecting measurements."""
TIMED_S, TIMED_REPEATS = 60, 5
NONE = 1e-9
IMU = Imu(
    rate_hz=RATE_HZ,
    gyro_noise_deg_sqrt_h=0.3,
    accel_noise_m_s_sqrt_h=1e-3 * STANDARD_GRAVITY_M_S2 * math.sqrt(1.0 / RATE_HZ) * 60.0,
    gyro_bias_initial_deg_h=NONE,
    gyro_bias_instability_deg_h=360.0,
    accel_bias_initial_mg=NONE,
    accel_bias_instability_mg=NONE,
    bias_correlation_s=3600.0,
    gyro_scale_ppm=NONE,
    accel_scale_ppm=NONE,
)
CIRCUIT = (
    Leg(10),
    Leg(8, turn_deg=90.0),
    Leg(6, speed_m_s=16.0),
    Leg(14),
    Leg(5, turn_deg=-60.0),
    Leg(6, speed_m_s=8.0),
    Leg(18, turn_deg=330.0),
    Leg(6, speed_m_s=12.0),
)
"""Legs of the circuit, from 12 m/s, in order. Turns are coordinated."""

LOCAL_FILTERS = ("gps", "star_tracker")
NO_RESET = FederatedOptions("no_reset", fault_detection=False)
FUSION_RESET = FederatedOptions("fusion_reset", fault_detection=False)

ALL = slice(0, 7)
GROUPS = {"attitude": slice(0, 3), "velocity": slice(3, 5), "position": slice(5, 7)}


@dataclass(frozen=True, slots=True)
class Case:
    """Case of the simulation: `accel_bias_mg` is one sigma of a constant that the model lacks."""

    name: str
    accel_bias_mg: float = NONE


@dataclass(slots=True)
class Trace:
    """Trace of one filter in one run, just after each second's measurements (k): errors (k, 7) phi
    n e d, dv n e, dr n e, the filter's sigma of each (k, 7), NEES (k,)."""

    error: Array
    sigma: Array
    nees: Array


def filters() -> dict[str, Callable[[Model], Estimator]]:
    """Filters of the study by name in the result."""
    return {
        "multiscale": lambda m: MultiscaleEstimator(m, IMU.gap_s, 2),
        "federated": lambda m: NoResetFilter(m, IMU.gap_s, LOCAL_FILTERS, NO_RESET),
        "federated_fusion_reset": lambda m: ResetFilter(m, IMU.gap_s, LOCAL_FILTERS, FUSION_RESET),
        "centralised": lambda m: KalmanEstimator(m, IMU.gap_s),
        "multiscale_n1": lambda m: MultiscaleEstimator(m, IMU.gap_s, 1),
        "multiscale_n3": lambda m: MultiscaleEstimator(m, IMU.gap_s, 3),
        "multiscale_n4": lambda m: MultiscaleEstimator(m, IMU.gap_s, 4),
    }


@lru_cache(maxsize=1)
def truth() -> Truth:
    """True flight; the aircraft is at speed after its first three seconds."""
    lat, lon, height = ORIGIN_DEG_M
    legs = chain([Leg(3, speed_m_s=12.0)], chain.from_iterable(repeat(CIRCUIT)))
    path = follow(legs, DURATION_S, course_deg=90.0, bank_ratio=1.0)
    return Truth(path, (lat * DEG, lon * DEG, height), RATE_HZ, DURATION_S)


@lru_cache(maxsize=1)
def epochs() -> tuple[Array, Array, Array]:
    """Instants (k,) of the measurements, true navigation states (k, 10) and roll, pitch, yaw (k,
    3)."""
    t_s: Array = np.arange(PERIOD_S, DURATION_S + 1e-9, PERIOD_S)
    return t_s, true_nav(truth(), t_s), truth().at(t_s).rpy


@dataclass(frozen=True, slots=True)
class RunErrors:
    """Errors of one run: IMU buffer, gyro drift (k, 3) at the epochs, measurements by epoch,
    start."""

    buffer: ImuBuffer
    drift: Array
    measurements: list[list[Linearised]]
    model: Model
    start: Array
    sd: Array


def draw(case: Case, seed: int, number: int) -> RunErrors:
    """Draw run `number`."""
    rng = np.random.default_rng([seed, number])
    imu = flown_imu(case)
    flown = truth()
    out = imu_output(imu, flown.gyro, flown.accel, rng)
    t_s, true, rpy = epochs()
    to_metres = metres_per_unit(ORIGIN_DEG_M[0] * DEG, ORIGIN_DEG_M[2])
    times = np.rint(flown.t_s[1:] * 1e9).astype(np.int64)
    buffer = ImuBuffer(RATE_HZ, DURATION_S + 10.0, np.eye(3), 0.0, IMU.gap_s)
    buffer.append(times, np.hstack([out.gyro, out.accel]))
    fixes = true[:, :2] + GPS_M * rng.standard_normal((len(t_s), 2)) / to_metres[:2]
    speeds = true[:, 3:5] + GPS_M_S * rng.standard_normal((len(t_s), 2))
    angles = rpy + TRACKER_RAD * rng.standard_normal(rpy.shape)
    measurements: list[list[Linearised]] = []
    arm = (0.0, 0.0, 0.0)
    for t, (lat, lon), (n, e), (roll, pitch, yaw) in zip(
        np.rint(t_s * 1e9).astype(int).tolist(),
        fixes.tolist(),
        speeds.tolist(),
        angles.tolist(),
        strict=True,
    ):
        sd, sd_v, sd_a = (GPS_M,) * 3, (GPS_M_S,) * 2, (TRACKER_RAD,) * 3
        measurements.append(
            [
                PositionMeasurement("gps", t, GATE, lat, lon, None, sd, arm),
                VelocityMeasurement("gps_velocity", t, GATE, (n, e), sd_v, arm),
                AttitudeMeasurement("star_tracker", t, GATE, (roll, pitch, yaw), sd_a),
            ]
        )
    model = make_model("planar10", imu_noise(IMU))
    sigma = model.initial.copy()
    sigma[0:3], sigma[3:6], sigma[6:9] = TRACKER_RAD, GPS_M_S, GPS_M
    sigma[~model.active] = 0.0
    first = true_nav(flown, np.zeros(1))[0]
    start = with_error(first, rng.standard_normal(9) * sigma[:9])
    drift = out.gyro_bias[np.rint(t_s * RATE_HZ).astype(int) - 1]
    return RunErrors(buffer, drift, measurements, model, start, sigma)


def flown_imu(case: Case) -> Imu:
    """IMU of the simulation: the filters' IMU with the accelerometer bias of the case."""
    return IMU.model_copy(update={"accel_bias_initial_mg": case.accel_bias_mg})


def begin(drawn: RunErrors, make: Callable[[Model], Estimator]) -> Estimator:
    """Start a filter at the begin of a run."""
    estimator = make(drawn.model)
    parameters = np.zeros(drawn.model.size)
    estimator.initialise(0, 0, drawn.start, parameters, np.diag(drawn.sd**2))
    return estimator


def fly(drawn: RunErrors, make: Callable[[Model], Estimator]) -> Trace:
    """Run one filter through one run's data."""
    estimator = begin(drawn, make)
    _, true, _ = epochs()
    count = len(true)
    trace = Trace(np.empty((count, 7)), np.empty((count, 7)), np.empty(count))
    slots = np.flatnonzero(drawn.model.active)
    for k, measurements in enumerate(drawn.measurements):
        estimator.propagate(drawn.buffer, measurements[0].t_ns)
        for measurement in measurements:
            outcome = estimator.update(measurement)
            if outcome.name != "fused":
                raise RuntimeError(f"{measurement.source} at {measurement.t_ns} ns: {outcome.name}")
        x = np.concatenate([nav_error(estimator.nav, true[k]), drawn.drift[k] - estimator.xi[9:]])
        x, p = x[slots], estimator.covariance[np.ix_(slots, slots)]
        trace.error[k], trace.sigma[k] = x[ALL], np.sqrt(np.diag(p))[ALL]
        trace.nees[k] = x @ np.linalg.solve(p, x)
    return trace


def simulate(case: Case, seed: int, number: int) -> dict[str, Trace]:
    """Run `number` of a case: every filter on the same errors."""
    drawn = draw(case, seed, number)
    return {name: fly(drawn, make) for name, make in filters().items()}


def monte_carlo(
    case: Case, runs: int, seed: int, progress: Callable[[], None] | None = None
) -> list[dict[str, Trace]]:
    """Runs of a case in order; on two processes when there are enough of them."""
    return map_runs(partial(simulate, case, seed), runs, progress)


@dataclass(frozen=True, slots=True)
class StepTimes:
    """Processor time of a second (us): the least median of some repeats, and mean, maximum, minimum
    and variance over the seconds of that repeat, as in table 2 of the paper."""

    median: float
    spread: dict[str, float]


def times_per_step_us(case: Case, seed: int) -> dict[str, StepTimes]:
    """Processor time of one second by filter: its IMU samples propagated, its measurements fused.
    The filters take turns, so that other load falls on all of them."""
    drawn = draw(case, seed, 0)
    best: dict[str, StepTimes] = {}
    for _ in range(TIMED_REPEATS):
        for name, make in filters().items():
            estimator, spent = begin(drawn, make), []
            for measurements in drawn.measurements[:TIMED_S]:
                start = time.process_time_ns()
                estimator.propagate(drawn.buffer, measurements[0].t_ns)
                for measurement in measurements:
                    estimator.update(measurement)
                spent.append((time.process_time_ns() - start) * 1e-3)
            counted = np.array(spent[20:])
            median = float(np.median(counted))
            if name not in best or median < best[name].median:
                spread = {
                    "mean": float(counted.mean()),
                    "max": float(counted.max()),
                    "min": float(counted.min()),
                    "variance": float(counted.var()),
                }
                best[name] = StepTimes(median, spread)
    return best
