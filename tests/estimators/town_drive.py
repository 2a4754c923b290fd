"""A drive through the town with a fix a second, for filters to be compared on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multiscale.filter import MultiscaleEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0, gyro_scale_ppm=1e-6, accel_scale_ppm=1e-6)
SECONDS = 40.0
LEVER = (0.4, -0.3, -1.2)
SD, SD_V = (1.5, 1.5, 3.0), (0.05, 0.05, 0.1)


def drive(
    seed: int = 3, noise: float = 1.0
) -> tuple[Model, ImuBuffer, list[list[Linearised]], Array, Array]:
    """Model, IMU buffer, position and velocity of each second, first computed state, its sigma.

    `noise` scales every error."""
    truth = runs.town_truth(SECONDS, IMU.rate_hz)
    rng = np.random.default_rng(seed)
    run = runs.imu_run(IMU, truth, seed)
    true_samples = np.hstack([truth.gyro, truth.accel])
    samples = true_samples + noise * (run.samples - true_samples)
    buffer = runs.filled_buffer(IMU, runs.sample_times(truth), samples)
    model = make_model("ins15", imu_noise(IMU))
    t_s = np.arange(0.303, SECONDS, 1.0)
    states = truth.at(t_s, LEVER)
    measurements: list[list[Linearised]] = []
    for t, p, v in zip(t_s, states.position, states.v_ned, strict=True):
        off = noise * rng.standard_normal(3) * SD / runs.metres_per_unit(float(p[0]), float(p[2]))
        lat, lon, height = (float(x) for x in p + off)
        n, e, d = (float(x) for x in v + noise * rng.standard_normal(3) * SD_V)
        t_ns = round(t * 1e9)
        measurements.append(
            [
                PositionMeasurement("gnss", t_ns, 1 - 1e-9, lat, lon, height, SD, LEVER),
                VelocityMeasurement("gnss_velocity", t_ns, 1 - 1e-9, (n, e, d), SD_V, LEVER),
            ]
        )
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    start = runs.true_nav(truth, np.array([0.0]))[0]
    start = runs.with_error(start, noise * sd[:9] * rng.standard_normal(9))
    return model, buffer, measurements, start, sd


Either = KalmanEstimator | MultiscaleEstimator


def begun(estimator: Either, start: Array, sd: Array) -> None:
    estimator.initialise(0, 0, start, np.zeros(len(sd)), np.diag(sd**2))


def run(estimator: Either, buffer: ImuBuffer, measurements: Sequence[Sequence[Linearised]]) -> None:
    for epoch in measurements:
        estimator.propagate(buffer, epoch[0].t_ns)
        for measurement in epoch:
            assert estimator.update(measurement).name == "fused"
