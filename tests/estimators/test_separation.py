"""Solution separation: the published estimate is untouched, a subset is the filter without its
device, and separations spread as P_k - P_0 says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.models.catalogue import make_model
from tests import runs

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
MODEL = make_model("ins15", imu_noise(IMU))
DEVICES = ("fine", "coarse")
SD = {"fine": 1.5, "coarse": 10.0}
SECONDS = 60.0
INITIAL = runs.initial_sd(MODEL, np.radians([0.5, 0.5, 2.0]), 0.5, 5.0)


def fix(
    source: str, t_ns: int, place: Array, rng: np.random.Generator, off_m: float = 0.0
) -> PositionMeasurement:
    sd = SD[source]
    noise = rng.standard_normal(3) * sd + (off_m, 0.0, 0.0)
    lat, lon, up = (float(x) for x in place + noise / runs.metres_per_unit(place[0], place[2]))
    return PositionMeasurement(source, t_ns, 1 - 1e-9, lat, lon, up, (sd, sd, sd), (0.0, 0.0, -1.0))


def drive(
    estimators: dict[str, tuple[KalmanEstimator, tuple[str, ...]]],
    off_m: float = 0.0,
    off_from_s: float = math.inf,
) -> None:
    """Each estimator through the same town, with the measurements of the sources named; the fine
    device is off by `off_m` north from `off_from_s`."""
    truth = runs.town_truth(SECONDS, IMU.rate_hz)
    imu = runs.imu_run(IMU, truth, 5)
    buffer = runs.filled_buffer(IMU, runs.sample_times(truth), imu.samples)
    rng = np.random.default_rng(6)
    sd = INITIAL
    start = runs.with_error(runs.true_nav(truth, np.zeros(1))[0], sd[:9] * rng.standard_normal(9))
    for estimator, _ in estimators.values():
        estimator.initialise(0, 0, start.copy(), np.zeros(MODEL.size), np.diag(sd**2))
    for second in range(1, int(SECONDS) + 1):
        t_ns = second * runs.SECOND
        states = truth.at(np.array([float(second)]))
        off = off_m if second >= off_from_s else 0.0
        measurements: list[PositionMeasurement | VelocityMeasurement] = [
            fix("fine", t_ns, states.position[0], rng, off)
        ]
        n, e, d = (float(x) for x in states.v_ned[0] + 0.1 * rng.standard_normal(3))
        measurements.append(
            VelocityMeasurement(
                "fine_velocity", t_ns, 1 - 1e-9, (n, e, d), (0.1, 0.1, 0.1), (0.0, 0.0, -1.0)
            )
        )
        if second % 5 == 0:
            measurements.append(fix("coarse", t_ns, states.position[0], rng))
        for estimator, sources in estimators.values():
            estimator.propagate(buffer, t_ns)
            for measurement in measurements:
                if measurement.source.split("_")[0] in sources:
                    assert estimator.update(measurement).name in ("fused", "gated")


def kalman() -> KalmanEstimator:
    return KalmanEstimator(MODEL, IMU.gap_s)


def test_what_is_published_is_the_filter_without_subsets() -> None:
    plain, separated = kalman(), SeparatedEstimator(MODEL, IMU.gap_s, DEVICES)
    drive({"plain": (plain, DEVICES), "separated": (separated, DEVICES)})
    sd = np.sqrt(np.diag(plain.covariance))
    off = np.abs(runs.nav_error(separated.nav, plain.nav)) / sd[:9]
    assert off.max() < 1e-6
    assert separated.covariance == pytest.approx(plain.covariance, rel=1e-6, abs=1e-18)


def test_a_subset_is_the_filter_without_its_device() -> None:
    separated, fine, coarse = SeparatedEstimator(MODEL, IMU.gap_s, DEVICES), kalman(), kalman()
    drive({"s": (separated, DEVICES), "f": (fine, ("fine",)), "c": (coarse, ("coarse",))})
    for k, alone in enumerate((coarse, fine)):
        p = alone.covariance[6:9, 6:9]
        # Each linearises about its own state, and the coarse one's heading is poor.
        own = np.diag(separated.covariances()[1 + k])
        assert own == pytest.approx(np.diag(p), rel=0.05)
        apart = runs.nav_error(alone.nav, separated.nav)[6:9]
        off = (separated.separations()[k] - apart) / np.sqrt(np.diag(p))
        assert np.abs(off).max() < 0.2
    assert separated.covariances()[1, 0, 0] > 4.0 * separated.covariances()[0, 0, 0]


def test_a_device_that_goes_wrong_separates_its_subset_alone() -> None:
    """A ramp would do it slowly; a step inside the gate does it at once."""
    separated = SeparatedEstimator(MODEL, IMU.gap_s, DEVICES)
    drive({"s": (separated, DEVICES)}, off_m=6.0, off_from_s=20.0)
    without_fine, without_coarse = separated.separations()[:, 0]
    assert without_fine < -2.0
    assert abs(without_coarse) < 1.0


def static_pair(draws: int) -> tuple[Array, Array]:
    """Separations (draws, 2, 3) and P_k - P_0 (2, 3) of filters that hear both devices."""
    found = []
    place = np.array(runs.ORIGIN)
    sd = INITIAL
    estimator = SeparatedEstimator(MODEL, IMU.gap_s, DEVICES)
    for seed in range(draws):
        rng = np.random.default_rng(1000 + seed)
        nav = runs.level_nav((0.0, 0.0, 0.3), (0.0, 0.0, 0.0))
        nav = runs.with_error(nav, sd[:9] * rng.standard_normal(9))
        estimator.initialise(0, 0, nav, np.zeros(MODEL.size), np.diag(sd**2))
        for _ in range(3):
            for source in DEVICES:
                assert estimator.update(fix(source, 0, place, rng)).name == "fused"
        found.append(estimator.separations())
    variance = np.diagonal(estimator.covariances(), axis1=1, axis2=2)
    return np.array(found), variance[1:] - variance[0]


def test_separations_spread_as_the_covariances_say() -> None:
    separations, variance = static_pair(400)
    # A mean square of 400 draws is within 5 sqrt(2 / 400) of its own.
    assert (separations**2).mean(axis=0) == pytest.approx(variance, rel=5.0 * math.sqrt(2.0 / 400))


def test_held_back_and_restored_it_is_the_same() -> None:
    rng = np.random.default_rng(8)
    place, sd = np.array(runs.ORIGIN), INITIAL
    measurements = [fix(source, 0, place, rng) for source in DEVICES]
    ends = []
    for held in (False, True):
        estimator = SeparatedEstimator(MODEL, IMU.gap_s, DEVICES)
        nav = runs.level_nav((0.0, 0.0, 0.3), (0.0, 0.0, 0.0))
        estimator.initialise(0, 0, nav, np.zeros(MODEL.size), np.diag(sd**2))
        before = estimator.snapshot()
        estimator.update(measurements[0])
        estimator.restore(before)
        if held:
            estimator.hold()
        for measurement in measurements:
            estimator.update(measurement)
        estimator.release()
        ends.append((estimator.nav.copy(), estimator.separations().copy()))
    assert np.abs(runs.nav_error(ends[0][0], ends[1][0])[6:9]).max() < 1e-3
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-3)


def test_without_a_device_there_is_nothing_to_separate() -> None:
    with pytest.raises(ValueError, match="at least one device"):
        SeparatedEstimator(MODEL, IMU.gap_s, ())
