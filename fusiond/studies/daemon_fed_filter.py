"""Filter of a study, fed through the daemon's timeline, and a drive for it.

The vehicle is the drive of `fusiond simulate`, 500 s as in paper 003, on IMU samples at `RATE_HZ`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.base import AidingMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import DEG
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.timeline import Entry, Timeline
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.sensor_errors import imu_output
from fusiond.simulation.trajectories import drive

Array = NDArray[np.float64]

DURATION_S = 500.0
REST_S = 20.0
ORIGIN_DEG_M = (30.5, 114.3, 40.0)
RATE_HZ = 50.0
HISTORY_S, CHECKPOINT_S = 15.0, 0.5
"""History and checkpoint interval, as in the daemon."""


@lru_cache(maxsize=1)
def drive_truth() -> Truth:
    """The drive, sampled at `RATE_HZ`."""
    lat, lon, height = ORIGIN_DEG_M
    path = drive(DURATION_S, REST_S)
    return Truth(path, (lat * DEG, lon * DEG, height), RATE_HZ, DURATION_S)


def drive_samples(imu: Imu, rng: np.random.Generator) -> Array:
    """IMU samples at `RATE_HZ` on the drive (n, 6): rate (rad/s) and force (m/s^2)."""
    truth = drive_truth()
    output = imu_output(imu, truth.gyro, truth.accel, rng)
    return np.hstack([output.gyro, output.accel])


class DaemonFedFilter:
    """Estimator on the IMU samples (n, 6) of a run, through the daemon's timeline.

    `gap_s` is the longest interval of IMU samples that is no gap. The filter starts at 0 at the
    navigation state `nav` (10,) with one sigma `sd` (states,). `entries` are the measurements in
    the order in which they were applied, with their outcomes.
    """

    def __init__(
        self, estimator: KalmanEstimator, gap_s: float, samples: Array, nav: Array, sd: Array
    ) -> None:
        self.estimator = estimator
        self.entries: list[Entry] = []
        self._samples, self._given = samples, 0
        self._times = np.rint(np.arange(1, len(samples) + 1) * 1e9 / RATE_HZ).astype(np.int64)
        self._buffer = ImuBuffer(RATE_HZ, HISTORY_S, np.eye(3), 0.0, gap_s)
        self._timeline = Timeline(
            estimator, self._buffer, HISTORY_S, CHECKPOINT_S, self.entries.append
        )
        estimator.initialise(0, 0, nav.copy(), np.zeros(estimator.model.size), np.diag(sd**2))
        self._timeline.start()

    def advance(self, t_s: float, measurements: Iterable[AidingMeasurement] = ()) -> None:
        """Add the IMU samples up to `t_s`, then `measurements`."""
        end = round(t_s * RATE_HZ)
        if end > self._given:
            self._buffer.append(self._times[self._given : end], self._samples[self._given : end])
            self._given = end
        for measurement in measurements:
            self._timeline.insert(measurement)
        self._timeline.advance()
