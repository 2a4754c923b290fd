"""Screened measurements in the multi-scale filter: bad rows, and a receiver that sets its clock."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from fusiond.aiding.base import Innovation, NotApplicable, State
from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multiscale.filter import MultiscaleEstimator
from fusiond.models.blocks import CLOCK_OFFSET, clock_blocks
from fusiond.models.catalogue import make_model
from tests import runs
from tests.estimators.screened_ranges import Ranges, ranges
from tests.estimators.town_drive import IMU, begun, drive, run


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_a_bad_row_goes_alone(scales: int) -> None:
    _, buffer, measurements, start, _ = drive()
    model = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    found = []
    for left_out in (False, True):
        estimator = MultiscaleEstimator(model, IMU.gap_s, scales)
        begun(estimator, start, sd)
        run(estimator, buffer, ranges(measurements, wrong_at=20, left_out=left_out))
        found.append(estimator)
    np.testing.assert_allclose(found[0].nav, found[1].nav, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-9, atol=1e-15)


def test_screened_measurements_in_one_scale_are_the_ordinary_filters() -> None:
    _, buffer, measurements, start, _ = drive()
    model = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    one, ordinary = MultiscaleEstimator(model, IMU.gap_s, 1), KalmanEstimator(model, IMU.gap_s)
    for estimator in (one, ordinary):
        begun(estimator, start, sd)
        run(estimator, buffer, ranges(measurements, jump_at=25, wrong_at=20))
    np.testing.assert_allclose(one.nav, ordinary.nav, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(one.xi, ordinary.xi, rtol=1e-6, atol=1e-9)


def test_a_clock_that_was_set_gives_the_blocks_up() -> None:
    _, buffer, measurements, start, _ = drive()
    model = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    estimator = MultiscaleEstimator(model, IMU.gap_s, 3)
    begun(estimator, start, sd)
    epochs = ranges(measurements, jump_at=20)
    run(estimator, buffer, epochs[:20])
    assert estimator.epochs == 7
    before = estimator.nav.copy()
    estimator.propagate(buffer, epochs[20][0].t_ns)
    velocity, raw = epochs[20]
    assert estimator.update(velocity).name == "fused"
    outcome = estimator.update(raw)
    assert outcome.name == "fused"
    assert outcome.degrees == 6
    assert estimator.epochs == 1
    slot = model.slots_of(CLOCK_OFFSET)[0]
    assert abs(estimator.xi[slot] - 3000.0) < 5.0
    run(estimator, buffer, epochs[21:])
    assert abs(estimator.xi[slot] - 3000.0) < 5.0
    assert np.abs(runs.nav_error(estimator.nav, before)[6:]).max() < 400.0


def test_no_row_left_is_gated_and_leaves_nothing() -> None:
    _, buffer, measurements, start, _ = drive()
    model = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    estimator = MultiscaleEstimator(model, IMU.gap_s, 2)
    begun(estimator, start, sd)
    run(estimator, buffer, ranges(measurements)[:20])
    far = measurements[20][0]
    assert isinstance(far, PositionMeasurement)
    estimator.propagate(buffer, far.t_ns)
    off = replace(far, lat_rad=far.lat_rad + 1e-3, lon_rad=far.lon_rad + 1e-3, height_m=9e3)
    nav, p = estimator.nav.copy(), estimator.covariance.copy()
    one_row = Ranges("raw", far.t_ns, 1 - 1e-9, off, 5.0)
    outcome = estimator.update(OneRow(one_row))
    assert outcome.name == "gated"
    assert outcome.rows == (1,)
    assert (estimator.nav == nav).all()
    assert (estimator.covariance == p).all()


@dataclass(frozen=True)
class OneRow:
    """The first row of another screened measurement: too few for a clock that was set."""

    of: Ranges
    screened: ClassVar[bool] = True
    source: str = "raw"
    gate: float = 1 - 1e-9
    robust: bool = False

    @property
    def t_ns(self) -> int:
        return self.of.t_ns

    def innovation(self, state: State) -> Innovation | NotApplicable:
        rows = self.of.innovation(state)
        assert isinstance(rows, Innovation)
        return Innovation(rows.z[:1], rows.h[:1], rows.r[:1])
