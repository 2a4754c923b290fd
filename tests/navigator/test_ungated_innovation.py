"""Innovations in metres and m/s: distances that were put in come out, whatever the rows are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.body_velocity import NonHolonomicConstraint, WheelSpeedMeasurement
from fusiond.aiding.height import HeightMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.navigator.ungated_innovation import raw_innovation
from tests import runs
from tests.aiding.measurement_bench import (
    RPY,
    SOURCE,
    VELOCITY,
    measurement_model,
    rdss_measurement,
)

NO_LEVER = (0.0, 0.0, 0.0)


@pytest.fixture
def estimator() -> KalmanEstimator:
    model = measurement_model("ins15")
    made = KalmanEstimator(model, 0.5)
    nav = runs.level_nav(RPY, VELOCITY)
    made.initialise(0, 0, nav, np.zeros(model.size), np.eye(model.size))
    return made


def test_a_fix_is_as_far_off_as_it_was_put(estimator: KalmanEstimator) -> None:
    lat, lon, height = estimator.nav[:3].tolist()
    north, east = runs.metres_per_unit(lat, height)[:2]
    place = lat - 3.0 / north, lon + 4.0 / east, height + 2.0
    fix = PositionMeasurement(*SOURCE, *place, (0.5, 7.0, 20.0), NO_LEVER)
    found = raw_innovation(fix, estimator)
    assert found is not None
    assert (found.unit, found.axes) == ("m", "ned")
    assert found.values == pytest.approx((3.0, -4.0, 2.0), rel=1e-5)


def test_a_fix_that_is_whitened_is_in_metres_again(estimator: KalmanEstimator) -> None:
    """Its rows are in sigmas of a covariance that is not diagonal."""
    lat, lon, height = estimator.nav[:3].tolist()
    north, east = runs.metres_per_unit(lat, height)[:2]
    fix = replace(rdss_measurement(estimator.nav), lever=NO_LEVER, sd_time_s=0.3)
    fix = replace(fix, lat_rad=lat - 30.0 / north, lon_rad=lon + 40.0 / east)
    found = raw_innovation(fix, estimator)
    assert found is not None
    assert (found.unit, found.axes) == ("m", "ne")
    assert found.values == pytest.approx((30.0, -40.0), rel=1e-5)


def test_velocities_speeds_and_heights(estimator: KalmanEstimator) -> None:
    north, east, down = estimator.nav[3:6].tolist()
    velocity = VelocityMeasurement(
        *SOURCE, (north - 0.3, east + 0.2, down), (0.1, 0.1, 0.1), NO_LEVER
    )
    found = raw_innovation(velocity, estimator)
    assert found is not None
    assert (found.unit, found.axes) == ("m/s", "ned")
    assert found.values == pytest.approx((0.3, -0.2, 0.0), abs=1e-9)
    forward = float(estimator.state.dcm[:, 0] @ estimator.nav[3:6])
    found = raw_innovation(WheelSpeedMeasurement(*SOURCE, forward - 0.25, 0.1, NO_LEVER), estimator)
    assert found is not None
    assert (found.unit, found.axes) == ("m/s", "")
    assert found.values == pytest.approx((0.25,), rel=1e-6)
    found = raw_innovation(
        HeightMeasurement(*SOURCE, float(estimator.nav[2]) + 1.5, 1.0), estimator
    )
    assert found is not None
    assert (found.unit, found.axes) == ("m", "d")
    assert abs(found.values[0]) == pytest.approx(1.5)


def test_a_constraint_is_along_the_vehicles_axes(estimator: KalmanEstimator) -> None:
    found = raw_innovation(NonHolonomicConstraint(*SOURCE, 0.1, 0.1, 0.5, NO_LEVER), estimator)
    assert found is not None
    across = estimator.state.dcm[:, 1:].T @ estimator.nav[3:6]
    assert (found.unit, found.axes) == ("m/s", "")
    assert np.abs(found.values) == pytest.approx(np.abs(across), rel=1e-6)


def test_an_angle_has_none(estimator: KalmanEstimator) -> None:
    assert raw_innovation(HeadingMeasurement(*SOURCE, 0.1, 0.01), estimator) is None
