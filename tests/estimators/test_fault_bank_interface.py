"""The bank of hypotheses: effects against two filters, one of which has the fault."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.estimators.fault_bank import NO_FAULTS, ONSET, RESTARTS
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.tilt_frame_after_heading_update import TiltAxesFilter
from fusiond.integrity.catalogue import Kind, kinds_of, table_of
from fusiond.models.model import Model
from fusiond.navigation.error_model import DR, DV, FORCE_ERROR, PHI, RATE_ERROR
from fusiond.navigation.imu_buffer import ImuBuffer
from tests import runs
from tests.estimators import town_drive

Array = NDArray[np.float64]

BEFORE, AFTER = 20, 6
"""Epochs of a second before a fault begins and with it."""


def kinds(model: Model) -> list[Kind]:
    return kinds_of(model, {"gnss": "gnss"}, slips=False)


def driven(
    kind: type[TiltAxesFilter] = TiltAxesFilter, faults: bool = True
) -> tuple[TiltAxesFilter, list[list[Linearised]], ImuBuffer]:
    """A filter after `BEFORE` epochs, of small errors, and what comes."""
    model, buffer, measurements, start, sd = town_drive.drive(noise=1e-3)
    estimator = kind(model, town_drive.IMU.gap_s, table_of(kinds(model)) if faults else NO_FAULTS)
    town_drive.begun(estimator, start, sd)
    town_drive.run(estimator, buffer, measurements[:BEFORE])
    return estimator, measurements[BEFORE : BEFORE + AFTER], buffer


def effect(estimator: KalmanEstimator, name: str, onset_ns: int) -> Array:
    """V (n, p) of a kind since an onset."""
    bank = estimator.hypotheses
    assert bank is not None
    row = next(k for k, kind in enumerate(kinds(estimator.model)) if kind.name == name)
    onsets = bank.each(ONSET)[row].tolist()
    return bank.effect(RESTARTS * row + onsets.index(onset_ns * 1e-9))


def apart(wrong: KalmanEstimator, right: KalmanEstimator) -> Array:
    """What the error state of one is more than that of the other (n,)."""
    error = np.zeros(right.model.size)
    error[:9] = runs.nav_error(wrong.nav, right.nav)
    error[9:] = right.xi[9:] - wrong.xi[9:]
    return error


def test_a_bank_changes_nothing_while_nothing_is_wrong() -> None:
    """To the bit, though beside it two hundred and more hypotheses run."""
    (plain, measurements, buffer), (watched, _, _) = driven(faults=False), driven()
    assert watched.hypotheses is not None
    assert watched.hypotheses.table.groups > 100
    for estimator in (plain, watched):
        town_drive.run(estimator, buffer, measurements)
    assert np.array_equal(plain.nav, watched.nav)
    assert np.array_equal(plain.xi, watched.xi)
    assert np.array_equal(plain.covariance, watched.covariance)
    watched.hypotheses.judge(watched.t_ns)
    assert watched.hypotheses.weights.sum() < 0.1


@pytest.mark.parametrize(
    ("name", "slot", "amount"), [("gyro", RATE_ERROR, 1e-6), ("accelerometer", FORCE_ERROR, 1e-5)]
)
@pytest.mark.parametrize("axis", range(3))
def test_a_sensor_that_steps_moves_the_state_as_its_hypothesis_says(
    name: str, slot: int, amount: float, axis: int
) -> None:
    right, measurements, buffer = driven()
    wrong, _, _ = driven()
    onset_ns = right.t_ns
    assert right.hypotheses is not None
    right.hypotheses.begin(onset_ns, right.nav, right.step)
    wrong.xi[slot + axis] -= amount  # true minus estimated is larger by it
    for estimator in (right, wrong):
        town_drive.run(estimator, buffer, measurements)
    expected = effect(right, name, onset_ns)[:, axis] * amount
    found = apart(wrong, right)
    for part in (slice(PHI, PHI + 3), slice(DV, DV + 3), slice(DR, DR + 3), slice(9, 15)):
        scale = np.abs(expected[part]).max()
        assert found[part] == pytest.approx(expected[part], abs=0.02 * scale)


@pytest.mark.parametrize("ramp", [False, True])
@pytest.mark.parametrize("moves", [False, True])
def test_a_receiver_that_is_off_moves_the_state_as_its_hypothesis_says(
    ramp: bool, moves: bool
) -> None:
    right, measurements, buffer = driven()
    wrong, _, _ = driven()
    onset_ns, north = right.t_ns, 1e-3
    assert right.hypotheses is not None
    right.hypotheses.begin(onset_ns, right.nav, right.step)
    shifted: list[list[Linearised]] = []
    for epoch in measurements:
        position, velocity = (
            cast("PositionMeasurement", epoch[0]),
            cast("VelocityMeasurement", epoch[1]),
        )
        off = north * ((position.t_ns - onset_ns) * 1e-9 if ramp else 1.0)
        if moves:
            n, e, d = velocity.v_ned
            velocity = replace(velocity, v_ned=(n + off, e, d))
        else:
            by = off / float(runs.metres_per_unit(position.lat_rad, position.height_m or 0.0)[0])
            position = replace(position, lat_rad=position.lat_rad + by)
        shifted.append([position, velocity])
    town_drive.run(right, buffer, measurements)
    town_drive.run(wrong, buffer, shifted)
    name = ("velocity" if moves else "position") + ("_drift" if ramp else "")
    expected = effect(right, name, onset_ns)[:, 0] * north
    found = apart(wrong, right)
    for part in (slice(PHI, PHI + 3), slice(DV, DV + 3), slice(DR, DR + 3)):
        scale = np.abs(expected[part]).max()
        assert found[part] == pytest.approx(expected[part], abs=0.02 * scale + 1e-12)


def test_what_is_adopted_is_taken_out_of_the_state_and_widens_it() -> None:
    estimator, _, _ = driven()
    n = estimator.model.size
    before, p = estimator.nav.copy(), estimator.covariance.copy()
    xi = estimator.xi.copy()
    mean, spread = np.zeros(n), np.zeros((n, n))
    mean[DV], mean[RATE_ERROR] = 0.5, 1e-3
    spread[DV, DV], spread[DV, RATE_ERROR] = 0.04, 1e-5
    spread[RATE_ERROR, DV], spread[RATE_ERROR, RATE_ERROR] = 1e-5, 1e-6
    estimator.wider[:] = 1.0
    estimator.adopt(mean, spread)
    assert estimator.nav[3] == pytest.approx(before[3] - 0.5)
    assert estimator.xi[RATE_ERROR] == pytest.approx(xi[RATE_ERROR] + 1e-3)
    assert estimator.covariance == pytest.approx(p + spread)
    assert estimator.sigmas()[3] == pytest.approx(math.sqrt(p[DV, DV] + 0.04))
    assert estimator.hypotheses is not None
    assert (estimator.hypotheses.each(ONSET) == estimator.t_ns * 1e-9).all()
