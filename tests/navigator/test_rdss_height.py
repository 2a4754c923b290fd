"""The height that a request gave: its sigma stands in the fix's covariance (paper 000, eq. 4)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.measurements import DelayedFix, MonotonicStamp
from fusiond.aiding.rdss_fix_covariance import RdssGeometry, Sensitivity
from fusiond.aiding.rdss_position import RdssPositionMeasurement
from fusiond.configuration.schema import Config
from fusiond.navigator.intake.kind import Instants, Sections
from fusiond.navigator.intake.rdss import measurements_of

LAT, LON = math.radians(30.0), math.radians(114.0)
CONFIG = Config.model_validate({"aiding": {"rdss": {"height_sd_m": 40.0}}})


def covariance(height_sd_m: float | None, class_m: float = 1.0) -> np.ndarray:
    fix = DelayedFix(
        "rdss",
        0,
        MonotonicStamp(0),
        LAT,
        LON,
        50.0,
        class_m,
        height_given=height_sd_m is not None,
        height_sd_m=height_sd_m,
    )
    found = measurements_of(fix, Sections(CONFIG.aiding), Instants(0, 0.0, 0))
    assert not isinstance(found, str)
    (measurement,) = [a for a in found if isinstance(a, RdssPositionMeasurement)]
    nn, ne, ee = measurement.covariance
    return np.array([[nn, ne], [ne, ee]])


@given(st.floats(0.0, 100.0))
def test_the_given_heights_sigma_is_that_of_equation_4(height_sd_m: float) -> None:
    geometry = RdssGeometry().sensitivity(LAT, LON, 50.0)
    assert isinstance(geometry, Sensitivity)
    ranging = 15.3**2 * (geometry.ranges @ geometry.ranges.T)
    expected = ranging + height_sd_m**2 * np.outer(geometry.height, geometry.height)
    assert covariance(height_sd_m) == pytest.approx(expected, rel=1e-9)


def test_without_one_the_centres_stands_and_the_class_is_the_floor() -> None:
    assert covariance(None) == pytest.approx(covariance(40.0))
    assert np.linalg.eigvalsh(covariance(1.0, class_m=100.0)).min() == pytest.approx(100.0**2)
    assert np.trace(covariance(2.0)) < np.trace(covariance(None))
