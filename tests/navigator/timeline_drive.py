"""A drive for the timeline, and the reference that its measurements give in order of validity."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.rdss_position import HeldFeedback, RdssPositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Outcome
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.integrity.catalogue import Kind, kinds_of, table_of
from fusiond.integrity.diagnosis import Diagnosis
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.rotation import dcm_from_quaternion, rpy_from_dcm
from fusiond.navigator.timeline import JUDGED, Timeline
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
SECONDS = 30.0
START_NS = 5 * runs.SECOND
KEEP_S = 10.0
GATE = 0.9999


def kinds(model: Model) -> list[Kind]:
    """What may be wrong of all that the drive has."""
    return kinds_of(model, {"gnss": "gnss", "compass": "compass", "rdss": "rdss"}, slips=False)


class Drive:
    """Half a minute of driving: samples, start and measurements in order of validity."""

    def __init__(self) -> None:
        truth = runs.town_truth(SECONDS, IMU.rate_hz)
        self.times = runs.sample_times(truth, START_NS)
        self.samples = runs.imu_run(IMU, truth, 7).samples
        self.nav = runs.true_nav(truth, np.zeros(1))[0]
        self.sd = np.radians([0.3, 0.3, 2.0])
        rng = np.random.default_rng(8)
        self.measurements: list[AidingMeasurement] = []
        for t in np.arange(0.507, SECONDS - 1.0, 0.9):
            nav = runs.true_nav(truth, np.array([t]))[0]
            nav = runs.with_error(
                nav, rng.standard_normal(9) * ([0.01] * 3 + [0.1] * 3 + [1.5] * 3)
            )
            lat, lon, height, n, e, d = (float(x) for x in nav[:6])
            if 11.0 < t < 13.0:
                lat += 1e-4  # an outlier of 640 m
            t_ns = START_NS + round(t * 1e9)
            lever_v = (0.0, 0.0, 0.0)
            yaw = rpy_from_dcm(dcm_from_quaternion(nav[6:]))[2]
            sd = (1.5, 1.5, 1.5)
            lever = (0.4, -0.3, -1.2)
            if round(t) % 4 == 0:  # carried without feedback for 1.3 s, across other measurements
                late = t_ns + 1_300_000_000
                held = RdssPositionMeasurement(
                    "rdss", t_ns + 3, GATE, lat, lon, (400.0, 50.0, 300.0), lever_v, holds=True
                )
                self.measurements += [held, HeldFeedback("rdss_feedback", late, GATE)]
            self.measurements += [
                HeadingMeasurement("compass", t_ns, GATE, yaw, 0.01),
                PositionMeasurement("gnss", t_ns, GATE, lat, lon, height, sd, lever),
                VelocityMeasurement(
                    "gnss_velocity", t_ns - 100_000_000, GATE, (n, e, d), sd, lever_v
                ),
            ]
        self.measurements.sort(key=lambda a: (a.t_ns, a.source))

    def estimator(self) -> KalmanEstimator:
        """At the start, before the first sample."""
        model = make_model("ins21", imu_noise(IMU))
        estimator = KalmanEstimator(model, IMU.gap_s, faults=table_of(kinds(model)))
        p = np.diag(runs.initial_sd(model, self.sd, 0.2, 3.0) ** 2)
        estimator.initialise(START_NS, 0, self.nav, np.zeros(model.size), p)
        return estimator

    def timeline(self, keep_s: float = KEEP_S, checkpoint_s: float = 0.5) -> Timeline:
        """Started, with no sample and no measurement yet; its buffer is moved every 20 s or so."""
        buffer = ImuBuffer(1.0, keep_s, np.eye(3), 0.0, IMU.gap_s)
        estimator = self.estimator()
        given = keep_s, checkpoint_s, None, kinds(estimator.model)
        timeline = Timeline(estimator, buffer, *given)
        timeline.start()
        return timeline


@lru_cache(maxsize=1)
def drive() -> Drive:
    return Drive()


@lru_cache(maxsize=1)
def in_order() -> tuple[KalmanEstimator, list[Outcome]]:
    """The reference, of which there is one."""
    return applied_in_order()


def applied_in_order() -> tuple[KalmanEstimator, list[Outcome]]:
    """The reference knows no timeline: propagate to each measurement in turn, apply and judge it,
    go on."""
    d = drive()
    estimator = d.estimator()
    diagnosis = Diagnosis(kinds(estimator.model))
    buffer = runs.filled_buffer(IMU, d.times, d.samples)
    outcomes = []
    for measurement in d.measurements:
        estimator.propagate(buffer, measurement.t_ns)
        if isinstance(measurement, HeldFeedback):
            estimator.release()
        elif isinstance(measurement, RdssPositionMeasurement):
            estimator.hold()
        one = diagnosis.comes(measurement, estimator)
        outcome = (
            estimator.look(measurement) if one.out else estimator.update(measurement, one.noise)
        )
        outcomes.append(outcome)
        if outcome.name in JUDGED:
            correction = diagnosis.judge(measurement, one, outcome, estimator)
            if correction is not None:
                estimator.adopt(correction.mean, correction.spread)
    estimator.propagate(buffer, buffer.latest_ns)
    return estimator, outcomes
