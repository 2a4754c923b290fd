"""The robust update against a minimiser that knows nothing of weights; and what it is for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.aiding.base import Innovation
from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.aiding import GnssAiding
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.robust import DEGREES
from fusiond.models.catalogue import make_model
from fusiond.navigator.intake import Intake
from tests import runs
from tests.estimators import side_by_side, town_drive
from tests.estimators.screened_ranges import ranges

Array = NDArray[np.float64]

SD = (1.5, 2.0, 3.0)
LEVER = (0.4, -0.3, -1.2)


def _loss(t: Array) -> Array:
    found: Array = 0.5 * (DEGREES + 1.0) * np.log1p(t * t / DEGREES)
    return found


def _fix(north_m: float, east_m: float, robust: bool = True) -> PositionMeasurement:
    lat, lon, height = runs.ORIGIN
    north, east, _ = runs.metres_per_unit(lat, height)
    place = lat + north_m / north, lon + east_m / east, height - 2.0
    return PositionMeasurement("gnss", 0, 1.0 - 1e-9, *place, SD, LEVER, robust=robust)


@pytest.mark.parametrize("off_m", [(1.0, -1.0), (9.0, 2.0), (-6.0, 30.0)])
def test_is_the_minimum_of_its_sum(off_m: tuple[float, float]) -> None:
    """Minimised over the whole error state; the covariance is that of weighted least squares."""
    estimator, _ = side_by_side.pair_of("ins21", p_scale=0.3)
    p, nav = estimator.covariance.copy(), estimator.nav.copy()
    n = estimator.model.size
    measurement = _fix(*off_m)
    rows = measurement.innovation(estimator.state)
    assert isinstance(rows, Innovation)
    z, h, r = rows
    root = np.linalg.cholesky(p)

    def cost(u: Array) -> float:
        return float(0.5 * u @ u + _loss((z - h @ (root @ u)) / np.sqrt(r)).sum())

    found = minimize(cost, np.zeros(n), method="BFGS", options={"gtol": 1e-9})
    x = root @ found.x
    outcome = estimator.update(measurement)
    assert outcome.name == "fused"
    fed_back = runs.nav_error(nav, estimator.nav)
    assert np.abs((fed_back - x[:9]) / np.sqrt(np.diag(p)[:9])).max() < 1e-3
    t = (z - h @ x) / np.sqrt(r)
    weight = (DEGREES + 1.0) / (DEGREES + t * t)
    expected = np.linalg.inv(np.linalg.inv(p) + h.T @ np.diag(weight / r) @ h)
    sd = np.sqrt(np.diag(expected))
    assert np.abs((estimator.covariance - expected) / np.outer(sd, sd)).max() < 1e-3


def _after(robust: bool, off_m: float) -> float:
    """By how much (m) a fix that is off northward moves a filter that is sure to 1 m."""
    estimator, _ = side_by_side.pair_of("ins21", p_scale=0.01)
    estimator.covariance[6:9, 6:9] = np.eye(3)
    before = estimator.nav.copy()
    estimator.update(replace(_fix(off_m, 0.0, robust), gate=1.0 - 1e-15))
    return float(runs.nav_error(estimator.nav, before)[6])


def test_a_wrong_fix_moves_the_filter_less() -> None:
    assert _after(True, 9.0) < 0.5 * _after(False, 9.0)


def test_a_clock_that_jumps_is_no_wrong_range() -> None:
    """All ranges jump by 3 km: the clock is renewed, as without weights, and the track is held."""
    _, buffer, measurements, start, _ = town_drive.drive()
    model = make_model("ins23", imu_noise(town_drive.IMU))
    sd = model.initial.copy()
    sd[:9] = np.r_[np.radians([0.3, 0.3, 2.0]), [0.2] * 3, [3.0] * 3]
    ends = []
    for robust in (False, True):
        estimator = KalmanEstimator(model, town_drive.IMU.gap_s)
        estimator.initialise(0, 0, start, np.zeros(model.size), np.diag(sd**2))
        epochs: list[Any] = ranges(measurements, jump_at=20)
        drive = [[v, replace(raw, robust=robust)] for v, raw in epochs]
        town_drive.run(estimator, buffer, drive)
        ends.append((estimator.nav.copy(), estimator.sigmas()[:3]))
    off = runs.nav_error(ends[1][0], ends[0][0])[6:]
    assert np.abs(off / ends[0][1]).max() < 1.5
    assert np.all(ends[1][1] < 1.5 * ends[0][1])


@pytest.mark.parametrize("source", ["gnss", "roof"])
def test_a_section_says_so(source: str) -> None:
    """Its own, or the one named after its kind."""
    intake = Intake({"gnss": GnssAiding(robust=True)})
    fix = PositionFix(
        source,
        *(0, MonotonicStamp(0), *runs.ORIGIN),
        quality=1,
        satellites=9,
        sd_ned_m=(1.0, 1.0, 2.0),
        v_ned_m_s=(1.0, 0.0, 0.0),
    )
    measurements = intake.measurements_of(fix, 1_000_000_000, 0.0)
    assert not isinstance(measurements, str)
    assert [measurement.robust for measurement in measurements] == [True, True]
