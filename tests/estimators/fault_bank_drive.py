"""Fault bank on a drive: the town with fixes, with and without a fault."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.fault_bank import (
    LEVEL_OF,
)
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import kinds_of, table_of
from fusiond.models.catalogue import make_model
from fusiond.navigation.imu_buffer import ImuBuffer
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
MODEL = make_model("ins15", imu_noise(IMU))
KINDS = kinds_of(MODEL, {"gnss": "gnss"}, slips=False)
FIRST_NS, LAST_NS = 16 * runs.SECOND, 19 * runs.SECOND
"""An onset at which the second level begins anew, and an instant before it does again."""
RESTART = LEVEL_OF.index(1)
SD_M, SD_M_S = 1.5, 0.1
INITIAL = runs.initial_sd(MODEL, np.radians([0.5, 0.5, 2.0]), 0.3, 2.0)


def row_of(name: str) -> int:
    return next(row for row, kind in enumerate(KINDS) if kind.name == name)


@lru_cache(maxsize=1)
def drive() -> tuple[Array, Array, Array]:
    """Instants, samples without errors of the unit, and the true start."""
    truth = runs.town_truth(30.0, IMU.rate_hz)
    samples = np.hstack([truth.gyro, truth.accel])
    return runs.sample_times(truth), samples, runs.true_nav(truth, np.zeros(1))[0]


def buffer_of(samples: Array) -> ImuBuffer:
    return runs.filled_buffer(IMU, drive()[0], samples)


def measurements(
    t_ns: int, rng: np.random.Generator, fault: str, b: Array
) -> list[PositionMeasurement | VelocityMeasurement]:
    """A fix and its velocity, with a fault of that size from `FIRST_NS` on."""
    truth = runs.town_truth(30.0, IMU.rate_hz)
    states = truth.at(np.array([t_ns * 1e-9]))
    since_s = (t_ns - FIRST_NS) * 1e-9 if t_ns >= FIRST_NS else -1.0
    place, speed = rng.standard_normal(3) * SD_M, rng.standard_normal(3) * SD_M_S
    if since_s >= 0.0:
        place += b * {"position": 1.0, "position_drift": since_s}.get(fault, 0.0)
        speed += b * {"velocity": 1.0, "velocity_drift": since_s}.get(fault, 0.0)
        if fault == "both":  # the first of b is the position's, the second the velocity's
            place[0], speed[1] = place[0] + b[0], speed[1] + b[1]
    lat, lon, up = states.position[0] + np.array([1.0, 1.0, -1.0]) * place * np.abs(
        1.0 / runs.metres_per_unit(states.position[0, 0], states.position[0, 2])
    )
    v = tuple((states.v_ned[0] + speed).tolist())
    lever, gate = (0.0, 0.0, 0.0), 1.0 - 1e-12
    return [
        PositionMeasurement("gnss", t_ns, gate, lat, lon, up, (SD_M,) * 3, lever),
        VelocityMeasurement("gnss_velocity", t_ns, gate, v, (SD_M_S,) * 3, lever),
    ]


def run(
    fault: str = "", b: Array | None = None, seed: int = 1, until_ns: int = LAST_NS
) -> KalmanEstimator:
    """The filter, with its bank, after that."""
    times, samples, start = drive()
    size = np.zeros(3) if b is None else b
    samples = samples.copy()
    columns = {"gyro": slice(0, 3), "accelerometer": slice(3, 6)}.get(fault)
    if columns is not None:
        samples[times > FIRST_NS, columns] += size
    rng = np.random.default_rng(seed)
    noise = imu_noise(IMU)
    densities = (noise.rate_noise, noise.force_noise)
    for half, density in enumerate(densities):
        spread = density * math.sqrt(IMU.rate_hz)
        samples[:, 3 * half : 3 * half + 3] += spread * rng.standard_normal((len(samples), 3))
    buffer = buffer_of(samples)
    made = KalmanEstimator(MODEL, IMU.gap_s, faults=table_of(KINDS))
    draw = INITIAL[:9] * rng.standard_normal(9)
    p = np.diag(INITIAL**2)
    p[9:, 9:] = 1e-16 * np.eye(MODEL.size - 9)  # biases are known
    made.initialise(0, 0, runs.with_error(start, draw), np.zeros(MODEL.size), p)
    for second in range(1, until_ns // runs.SECOND + 1):
        t_ns = second * runs.SECOND
        made.propagate(buffer, t_ns)
        for measurement in measurements(t_ns, rng, fault, size):
            assert made.update(measurement).name in ("fused", "gated")
    return made


def error_of(one: KalmanEstimator, other: KalmanEstimator) -> Array:
    """Of the first against the second, in the error state's navigation slots."""
    return runs.nav_error(one.nav, other.nav)
