"""The error coordinates in which a wrong heading turns what was felt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.invariant import InvariantFilter, Turning
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle_parameter_blocks import mounting_block
from fusiond.navigation.error_model import DR, DV, PHI
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    rpy_from_dcm,
    skew,
    wrap_angle,
)
from tests import runs

Array = NDArray[np.float64]

VELOCITY = np.array([9.0, -11.0, 0.6])
PLACE = np.array([12.0, 4.5, 0.3])


def _filter() -> InvariantFilter:
    found = InvariantFilter(make_model("ins15", imu_noise(Imu()), mounting_block(0.1)), 1.0)
    n = found.model.size
    nav = runs.level_nav((0.03, -0.05, 2.1), (9.0, -11.0, 0.6))
    found.initialise(0, 0, nav, np.zeros(n), np.diag(found.model.initial**2))
    found.xi[found.model.slots_of("mounting")] = 0.06, -0.04
    return found


def _error(f: InvariantFilter, yaw_rad: float) -> Array:
    error = 0.02 * np.random.default_rng(3).standard_normal(f.model.size)
    error[DV : DV + 3], error[DR : DR + 3] = (1.5, -0.8, 0.2), (6.0, -9.0, 2.0)
    error[PHI : PHI + 2] *= 0.1
    error[PHI + 2] = yaw_rad
    return error


@pytest.mark.parametrize("speeds", [True, False])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, -2.5])
def test_jacobian_about_the_state_that_an_error_leads_to(yaw_rad: float, speeds: bool) -> None:
    """Against differences, up to what a tilt of 0.1 deg makes of 12 m."""
    f = _filter()
    turning, error = Turning(VELOCITY, PLACE, speeds), _error(f, yaw_rad)
    nav, xi = f.without(f.nav, f.xi, error, turning)
    jacobian = f.of_vehicle(nav, xi) @ f.jacobian(error, turning)
    turn = dcm_from_rpy(0.0, 0.0, yaw_rad)
    for k in range(f.model.size):
        ends = []
        for step in (1e-5, -1e-5):
            more = error.copy()
            more[k] += step
            there, parameters = f.without(f.nav, f.xi, more, turning)
            ends.append(np.r_[runs.nav_error(nav, there), (parameters - xi)[9:]])
        numeric = (ends[0] - ends[1]) / 2e-5
        if k == PHI + 2:  # what does not turn keeps the axes of the estimate
            numeric[DR : DR + 3] += skew(turn @ error[DR : DR + 3])[:, 2]
            if not speeds:
                numeric[DV : DV + 3] += skew(turn @ error[DV : DV + 3])[:, 2]
        assert numeric == pytest.approx(jacobian[:, k], abs=0.04), k


@pytest.mark.parametrize("speeds", [True, False])
def test_an_error_is_what_is_between_two_states(speeds: bool) -> None:
    f = _filter()
    turning, error = Turning(VELOCITY, PLACE, speeds), _error(f, 2.9)
    nav, xi = f.without(f.nav, f.xi, error, turning)
    # The mounting's turn and the tilt do not commute; metres are those of either place.
    assert f.between(nav, xi, turning) == pytest.approx(error, abs=2e-3)


def test_no_jacobian_is_undone_twice() -> None:
    f = _filter()
    turning, nothing = Turning(VELOCITY, PLACE, True), np.zeros(f.model.size)
    product = f.jacobian(nothing, turning) @ f.straight(turning)
    assert product == pytest.approx(np.eye(f.model.size), abs=1e-12)
    product = f.of_vehicle(f.nav, f.xi) @ f.of_vehicle(f.nav, f.xi, -1.0)
    assert product == pytest.approx(np.eye(f.model.size), abs=1e-12)


def test_an_arc_of_headings_is_found_at_any_angle() -> None:
    """Driven off from rest in an unknown direction: a velocity tells heading and velocity at once,
    and P says so; a velocity of nothing tells no heading."""
    for off_deg in (-170.0, -100.0, 20.0, 90.0, 180.0):
        f, truth = _filter(), runs.level_nav((0.03, -0.05, 2.1), (9.0, -11.0, 0.6))
        n, sd = f.model.size, math.radians(104.0)
        p = np.diag(np.r_[1e-6, 1e-6, sd**2, [0.01] * 3, [1.0] * 3, f.model.initial[9:] ** 2])
        by_turn = np.eye(n)
        by_turn[DV : DV + 3, PHI : PHI + 3] = skew(np.array([9.0, -11.0, 0.0]))
        f.covariance[:] = by_turn @ p @ by_turn.T
        f.turns = True
        turn = dcm_from_rpy(0.0, 0.0, math.radians(off_deg))
        truth[3:6] = turn @ truth[3:6]
        velocity = tuple(float(v) for v in truth[3:6])
        measurement = VelocityMeasurement(
            "gnss", 0, 0.9999, velocity, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)
        )
        assert f.update(measurement).name == "fused"
        yaw = rpy_from_dcm(dcm_from_quaternion(f.nav[6:]))[2]
        assert wrap_angle(yaw - 2.1 - math.radians(off_deg)) == pytest.approx(0.0, abs=0.02)
        assert f.nav[3:6] == pytest.approx(truth[3:6], abs=0.3)
        # 0.14 m/s of felt and measured velocity across 14 m/s.
        assert f.covariance[2, 2] == pytest.approx((math.sqrt(0.02) / 14.2) ** 2, rel=0.2)
    f = _filter()
    f.nav[3:6] = 0.02, -0.03, 0.0
    f.covariance[2, 2] = math.radians(104.0) ** 2
    f.covariance[3:5, 2] = f.covariance[2, 3:5] = 0.01
    f.covariance[3, 3] = f.covariance[4, 4] = 0.05**2
    f.turns = True
    still = VelocityMeasurement("gnss", 0, 0.9999, (0.0, 0.0, 0.0), (0.05,) * 3, (0.0, 0.0, 0.0))
    for _ in range(20):
        assert f.update(still).name == "fused"
    assert math.degrees(math.sqrt(f.covariance[2, 2])) == pytest.approx(104.0, abs=1.0)
