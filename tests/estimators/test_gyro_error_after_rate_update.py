"""What is known of gyros stays with the rate of turn that it is known of."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.gyro_error_after_rate_update import gyro_slots, keep_turn
from fusiond.estimators.tilt_axes_rotation_after_update import heading_turn, turn_rows
from fusiond.models.catalogue import make_model
from fusiond.navigation.error_model import PHI
from fusiond.navigation.rotation import dcm_from_quaternion, quaternion_from_rpy

ACROSS = np.array([[0.0, -1.0], [1.0, 0.0]])
"""z x of what is horizontal."""


@pytest.mark.parametrize("seed", range(8))
def test_the_change_of_what_moves_the_vehicle_is_as_known_as_it_was(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = make_model("ins21", imu_noise(Imu(sensor_class="consumer")))
    gyros = gyro_slots(model)
    rpy = rng.normal(0.0, (0.1, 0.1, 1.0))
    before = np.array(quaternion_from_rpy(*rpy))
    after = np.array(quaternion_from_rpy(*(rpy + rng.normal(0.0, 0.03, 3))))
    told, sensed = rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.1, 3)
    psi = heading_turn(before, after)
    old, new = dcm_from_quaternion(before), dcm_from_quaternion(after)
    error = rng.normal(0.0, 0.1, (model.size, 4))
    carried = error.copy()
    none = np.empty(0, dtype=np.int64)
    turn_rows(carried, before, after, none, none)
    keep_turn(carried, before, after, psi, told, gyros)
    turned = np.array([[math.cos(psi), -math.sin(psi)], [math.sin(psi), math.cos(psi)]])
    # The old axes for both: what the corrections of the tilt make of the turn is no part of it.
    rate, rate_now = (float(old[2] @ (sensed - x)) for x in (np.zeros(3), told))
    was = (old @ error[gyros])[:2] + rate * ACROSS @ error[PHI : PHI + 2]
    now = (new @ carried[gyros])[:2] + rate_now * ACROSS @ carried[PHI : PHI + 2]
    assert now == pytest.approx(turned @ was, abs=1e-12)
    assert (new @ carried[gyros])[2] == pytest.approx((old @ error[gyros])[2], abs=1e-12)
    others = np.setdiff1d(np.arange(PHI + 2, model.size), gyros)
    assert np.array_equal(carried[others], error[others])


def test_gyros_with_several_biases_an_axis_are_left_alone() -> None:
    noise = imu_noise(Imu())
    assert gyro_slots(make_model("ins15", noise)).tolist() == [9, 10, 11]
    assert gyro_slots(make_model("ins23", noise)).size == 0
