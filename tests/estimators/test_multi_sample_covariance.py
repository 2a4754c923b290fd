"""A covariance over several samples at once: as of each one, whoever asks for it in between."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Estimator
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multi_sample_covariance import GRID_NS
from fusiond.estimators.published_state import Published
from fusiond.estimators.sigmas_between_covariance_steps import ROWS
from fusiond.estimators.unscented.filter import UnscentedEstimator
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=200.0, gyro_bias_initial_deg_h=100.0, accel_bias_initial_mg=10.0)
SECONDS = 40.0
LEVER, SD, SD_V = (0.4, -0.3, -1.2), (0.5, 0.5, 1.0), (0.05, 0.05, 0.1)
FILTERS = (KalmanEstimator, InvariantFilter, UnscentedEstimator)


def drive(shaken: bool = False) -> tuple[Model, ImuBuffer, list[Linearised], Array, Array]:
    """Model, samples, a position and a velocity each second, the first state and its sigma; with
    what an engine shakes into the samples where it is `shaken`."""
    truth = runs.town_truth(SECONDS, IMU.rate_hz)
    rng = np.random.default_rng(5)
    buffer = runs.filled_buffer(IMU, runs.sample_times(truth), np.hstack([truth.gyro, truth.accel]))
    if shaken:
        buffer.densities[:] = np.array([1e-8] * 3 + [1e-5] * 3)
    model = make_model("ins21", imu_noise(IMU))
    t_s = np.arange(0.303, SECONDS, 1.0)
    at = truth.at(t_s, LEVER)
    measurements: list[Linearised] = []
    for t, p, v in zip(t_s, at.position, at.v_ned, strict=True):
        lat, lon, height = (float(x) for x in p)
        n, e, d = (float(x) for x in v + rng.standard_normal(3) * SD_V)
        t_ns = round(t * 1e9)
        measurements.append(
            PositionMeasurement("gnss", t_ns, 1 - 1e-9, lat, lon, height, SD, LEVER)
        )
        measurements.append(
            VelocityMeasurement("gnss_velocity", t_ns, 1 - 1e-9, (n, e, d), SD_V, LEVER)
        )
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    start = runs.with_error(runs.true_nav(truth, np.array([0.0]))[0], 0.5 * sd[:9])
    return model, buffer, measurements, start, sd


def begun(
    kind: Callable[[Model, float], Estimator], shaken: bool = False
) -> tuple[Estimator, ImuBuffer, list[Linearised]]:
    model, buffer, measurements, start, sd = drive(shaken)
    estimator = kind(model, IMU.gap_s)
    estimator.initialise(0, 0, start, np.zeros(len(sd)), np.diag(sd**2))
    return estimator, buffer, measurements


@pytest.mark.parametrize("shaken", [False, True])
def test_sigmas_are_those_of_every_sample(shaken: bool) -> None:
    whole, buffer, measurements = begun(KalmanEstimator, shaken)
    each, _, _ = begun(KalmanEstimator, shaken)
    largest, apart, row = 0.0, 0.0, 0
    for measurement in measurements:
        whole.propagate(buffer, measurement.t_ns)
        while buffer.times[row] < measurement.t_ns:  # folded in at each sample
            each.propagate(buffer, int(buffer.times[row]))
            row += 1
        each.propagate(buffer, measurement.t_ns)
        sd = np.sqrt(np.diag(each.covariance))
        largest = max(largest, np.abs(np.sqrt(np.diag(whole.covariance)) / sd - 1.0).max())
        moved = (whole.nav[3:6] - each.nav[3:6]) / sd[3:6]
        apart = max(apart, float(np.abs(moved).max()))
        assert whole.update(measurement).name == each.update(measurement).name == "fused"
    assert largest < 1e-5
    assert apart < 1e-5


@pytest.mark.parametrize("kind", FILTERS)
def test_who_asks_in_passing_leaves_no_trace(
    kind: Callable[[Model, float], Estimator],
) -> None:
    """At ends of samples, and at the instant of a measurement before it is folded in."""
    alone, buffer, measurements = begun(kind)
    asked, _, _ = begun(kind)
    rng = np.random.default_rng(2)
    for measurement in measurements:
        alone.propagate(buffer, measurement.t_ns)
        upto = int(np.searchsorted(buffer.times, measurement.t_ns))
        first = int(np.searchsorted(buffer.times, asked.t_ns, side="right"))
        rows = rng.integers(first, upto, 9) if first < upto else np.empty(0, dtype=np.int64)
        for row in np.unique(rows):
            asked.propagate(buffer, int(buffer.times[row]), passing=True)
            if row % 3 == 0:
                asked.restore(asked.snapshot())
        if rng.random() < 0.5:
            asked.propagate(buffer, measurement.t_ns, passing=True)
        asked.propagate(buffer, measurement.t_ns)
        for one, other in zip(alone.snapshot(), asked.snapshot(), strict=True):
            assert np.array_equal(np.asarray(one), np.asarray(other))
        assert alone.update(measurement) == asked.update(measurement)


def test_what_is_seen_in_passing_is_what_a_measurement_would_find() -> None:
    passing, buffer, _ = begun(InvariantFilter)
    found, _, _ = begun(InvariantFilter)
    t_ns = 7 * GRID_NS + 11_000_000
    passing.propagate(buffer, t_ns, passing=True)
    found.propagate(buffer, t_ns)
    assert passing.passing
    assert not found.passing
    assert np.array_equal(passing.covariance, found.covariance)
    assert np.array_equal(passing.covariance, passing.covariance.T)
    assert np.array_equal(passing.sigmas(), found.sigmas())


def test_a_start_forgets_what_was_added_up() -> None:
    estimator, buffer, _ = begun(KalmanEstimator)
    nav, xi = estimator.nav.copy(), estimator.xi.copy()
    estimator.propagate(buffer, GRID_NS // 2, passing=True)
    again, _, _ = begun(KalmanEstimator)
    for one in (estimator, again):
        one.initialise(0, 0, nav, xi, np.eye(one.model.size))
        one.propagate(buffer, 3 * GRID_NS)
    assert np.array_equal(estimator.covariance, again.covariance)


@pytest.mark.parametrize("shaken", [False, True])
def test_what_is_recorded_of_a_sample_is_what_is_found_there(shaken: bool) -> None:
    recorded, buffer, measurements = begun(InvariantFilter, shaken)
    asked, _, _ = begun(InvariantFilter, shaken)
    recorded.publish_by(Published(-1, 0.01, 0.002))  # by its own clock, and by another unit's axes
    asked.publish_by(Published(-1, 0.01, 0.002))
    row, largest = 0, 0.0
    for measurement in measurements:
        recorded.propagate(buffer, measurement.t_ns, record=True)
        while buffer.times[row] < measurement.t_ns:
            asked.propagate(buffer, int(buffer.times[row]), passing=True)
            apart = np.abs(buffer.sigmas[row] / asked.sigmas() - 1.0).max()
            largest = max(largest, float(apart))
            row += 1
        asked.propagate(buffer, measurement.t_ns)
        assert recorded.update(measurement) == asked.update(measurement)
        assert np.array_equal(recorded.covariance, asked.covariance)
    assert row > 7000
    assert 0.0 < largest < 1e-4


def test_more_samples_than_may_wait_are_recorded_all_the_same() -> None:
    imu = Imu(rate_hz=4000.0)
    model = make_model("ins21", imu_noise(imu))
    count = 5 * ROWS
    times = 250_000 * np.arange(1, count + 1)
    samples = np.tile([0.01, 0.0, 0.02, 1.0, 0.0, -9.8], (count, 1))
    buffer = runs.filled_buffer(imu, times, samples)
    nav = runs.level_nav((0.0, 0.0, 0.3), (5.0, 0.0, 0.0))
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    recorded, asked = (KalmanEstimator(model, imu.gap_s) for _ in range(2))
    for each in (recorded, asked):
        each.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
    recorded.propagate(buffer, int(times[-1]), record=True)
    for row in range(count):
        asked.propagate(buffer, int(times[row]), passing=True)
        assert buffer.sigmas[row] == pytest.approx(asked.sigmas(), rel=1e-6)
    asked.propagate(buffer, int(times[-1]))
    assert np.array_equal(recorded.covariance, asked.covariance)
