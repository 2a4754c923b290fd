"""What every measurement says of a state: innovations, noise, and when it says nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusiond.aiding.attitude import AttitudeMeasurement, HeadingMeasurement
from fusiond.aiding.base import Innovation, NotApplicable
from fusiond.aiding.body_velocity import NonHolonomicConstraint, WheelSpeedMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.standstill import ZeroAngularRateUpdate, ZeroVelocityUpdate
from fusiond.aiding.velocity import AVERAGED, VelocityMeasurement
from fusiond.models.vehicle_parameter_blocks import (
    ANTENNA_LEVER,
    FIX_TIME,
    VELOCITY_TIME,
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
)
from fusiond.navigation.earth import EARTH_RATE_RAD_S
from fusiond.navigation.rotation import dcm_from_rpy, rpy_from_dcm
from tests import runs
from tests.aiding.measurement_bench import (
    ACCELERATION,
    ESTIMATED,
    KM_H,
    LEVER,
    RATE_SENSED,
    RPY,
    SOURCE,
    VELOCITY,
    innovation_of,
    measurement_model,
    position_measurement,
    rdss_measurement,
    state_of,
    vehicle_model,
)


def test_a_mounting_scale_and_offset_explain_what_is_measured() -> None:
    """z = 0 where the parameters are those that the measurement was made with, by other means."""
    model = vehicle_model()
    nav = runs.level_nav(RPY, VELOCITY)
    xi = np.zeros(model.size)
    xi[-len(ESTIMATED) :] = ESTIMATED
    state = state_of(model, nav, xi)
    pitch, yaw, lever, _, slipping, scale, latency, late, _, *rest, share = ESTIMATED
    to_vehicle = Rotation.from_rotvec([0.0, pitch, yaw]).as_matrix()
    dcm = Rotation.from_euler("ZYX", RPY[::-1]).as_matrix()
    at_wheel = dcm.T @ VELOCITY + np.cross(RATE_SENSED, np.add(LEVER, (lever, 0.0, 0.0)))
    before = to_vehicle @ (at_wheel - dcm.T @ ACCELERATION * latency)
    reads = float((1.0 + scale) * before[0] + slipping)
    reads -= math.copysign(share * KM_H, reads)
    wheel = WheelSpeedMeasurement(*SOURCE, reads, 0.1, LEVER)
    wheel = replace(wheel, drift=WHEEL_DRIFT, scale=WHEEL_SCALE, latency=WHEEL_LATENCY)
    wheel = replace(wheel, rounding=WHEEL_ROUNDING, shared_step_m_s=KM_H)
    assert innovation_of(wheel, state).z == pytest.approx([0.0], abs=1e-9)
    arm = dcm @ np.add(LEVER, rest)
    moved = np.array(VELOCITY) + dcm @ np.cross(RATE_SENSED, np.add(LEVER, rest))
    moved = moved * late + 0.5 * np.array(ACCELERATION) * late**2
    antenna = nav[:3] + (arm + moved) / runs.metres_per_unit(*nav[[0, 2]])
    lat, lon, height = (float(x) for x in antenna)
    fix = PositionMeasurement(*SOURCE, lat, lon, height, (1.0, 1.0, 1.0), LEVER)
    fix = replace(fix, time=FIX_TIME, rest=ANTENNA_LEVER)
    assert innovation_of(fix, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)


def test_what_a_late_fix_leaves_out_of_its_jacobian_is_noise() -> None:
    """Innovations of drawn errors, less H dx: their variance is what r states beyond the fix's."""
    model = vehicle_model()
    nav, xi = runs.level_nav(RPY, VELOCITY), np.zeros(model.size)
    (late,) = model.slots_of(FIX_TIME)
    measurement = replace(position_measurement(nav), time=FIX_TIME, rest=ANTENNA_LEVER)
    root = np.zeros((model.size, 4))  # of the offset, correlated with the velocity, and that
    root[late, 0] = 0.08
    root[3:6, 0] = 0.3, -0.2, 0.1
    root[3:6, 1:] = np.diag([0.5, 0.8, 0.3])
    state = state_of(model, nav, xi)._replace(covariance=root @ root.T)
    z, h, r = innovation_of(measurement, state)
    rng, left = np.random.default_rng(5), []
    for error in rng.standard_normal((3000, 4)) @ root.T:
        off = runs.with_error(nav, error[:9])
        found = innovation_of(measurement, state_of(model, off, xi - np.r_[np.zeros(9), error[9:]]))
        left.append(found.z - z - h @ error)
    assert r - np.square(measurement.sd) == pytest.approx(np.var(left, axis=0), rel=0.15)
    assert (
        innovation_of(measurement, state_of(model, nav, xi)).r == np.square(measurement.sd)
    ).all()


def test_innovation_is_zero_where_the_measurement_is_true() -> None:
    """z = h(truth) - y = 0 for measurements made by other means than the measurements' own
    formulas."""
    model = measurement_model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    dcm = Rotation.from_euler("ZYX", RPY[::-1]).as_matrix()
    state = state_of(model, nav, np.zeros(model.size))
    antenna = nav[:3] + (dcm @ LEVER) / runs.metres_per_unit(*nav[[0, 2]])
    lat, lon, height = (float(x) for x in antenna)
    fix = PositionMeasurement(*SOURCE, lat, lon, height, (1.0, 1.0, 1.0), LEVER)
    assert innovation_of(fix, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    moving = VELOCITY + dcm @ np.cross(RATE_SENSED, LEVER)
    n, e, d = (float(x) for x in moving)
    measurement = VelocityMeasurement(*SOURCE, (n, e, d), (0.1, 0.1, 0.1), LEVER)
    assert innovation_of(measurement, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    wheel = WheelSpeedMeasurement(*SOURCE, float((dcm.T @ moving)[0]), 0.1, LEVER)
    assert innovation_of(wheel, state).z == pytest.approx([0.0], abs=1e-12)
    lat = runs.ORIGIN[0]
    sensed = dcm.T @ (EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)]))
    x, y, z = (float(v) for v in sensed)
    still = ZeroAngularRateUpdate(*SOURCE, (x, y, z), 1e-3, runs.rest(99.0))
    assert innovation_of(still, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_position_across_the_date_line() -> None:
    model = measurement_model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    nav[1] = math.pi - 1e-7
    fix = PositionMeasurement(
        *SOURCE, float(nav[0]), -math.pi + 1e-7, 40.0, (1.0, 1.0, 1.0), (0.0,) * 3
    )
    z = innovation_of(fix, state_of(model, nav, np.zeros(model.size))).z
    assert z[1] == pytest.approx(-2e-7 * runs.metres_per_unit(*nav[[0, 2]])[1], rel=1e-6)


def test_rdss_rows_are_whitened_by_the_covariance_of_the_fix() -> None:
    """z and H in units of sigma: with R the fix's covariance, H^T H = R^-1 for its position."""
    model = measurement_model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    state = state_of(model, nav, np.zeros(model.size))
    z, h, r = innovation_of(rdss_measurement(nav), state)
    whiten = h[:, 6:8]
    cov = np.array([[400.0, -150.0], [-150.0, 200.0]])
    assert whiten.T @ whiten == pytest.approx(np.linalg.inv(cov), rel=1e-9)
    assert r == pytest.approx([1.0, 1.0])
    lever = state.dcm @ LEVER
    metres = np.array([-1e-6, 2e-6]) * runs.metres_per_unit(*nav[[0, 2]])[:2] + lever[:2]
    assert z == pytest.approx(whiten @ metres, rel=1e-6)
    timed = innovation_of(replace(rdss_measurement(nav), sd_time_s=0.5), state).h[:, 6:8]
    v = np.array(VELOCITY[:2])
    expected = np.linalg.inv(cov + 0.25 * np.outer(v, v))
    assert timed.T @ timed == pytest.approx(expected, rel=1e-9)


def test_timing_error_adds_along_the_velocity() -> None:
    model = measurement_model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    state = state_of(model, nav, np.zeros(model.size))
    r = innovation_of(replace(position_measurement(nav), sd_time_s=0.1), state).r
    assert r == pytest.approx([1.0 + 1.2**2, 4.0 + 0.7**2, 9.0 + 0.08**2])


def test_timing_error_of_a_velocity_adds_along_the_acceleration() -> None:
    model = measurement_model("ins15")
    state = state_of(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    sd = (0.1, 0.1, 0.2)
    measurement = VelocityMeasurement(*SOURCE, (12.3, -7.2, 0.7), sd, LEVER, sd_time_s=0.5)
    assert np.abs(state.acceleration).min() > 0.01
    expected = np.square(sd) + np.square(0.5 * state.acceleration)
    assert innovation_of(measurement, state).r == pytest.approx(expected)


def test_a_velocity_that_lags_is_an_average_where_the_vehicle_jolts() -> None:
    """By 0.13 s behind the position: half of what the lag makes of the acceleration."""
    model = vehicle_model()
    xi = np.zeros(model.size)
    xi[model.slots_of(FIX_TIME)], xi[model.slots_of(VELOCITY_TIME)] = 0.1, -0.03
    state = state_of(model, runs.level_nav(RPY, VELOCITY), xi)
    sd = (0.1, 0.1, 0.2)
    alone = VelocityMeasurement(*SOURCE, (12.3, -7.2, 0.7), sd, LEVER, VELOCITY_TIME)
    beside = replace(alone, fix_time=FIX_TIME)
    assert innovation_of(alone, state).r == pytest.approx(np.square(sd))
    expected = np.square(sd) + np.square(AVERAGED * 0.13 * state.acceleration)
    assert innovation_of(beside, state).r == pytest.approx(expected)
    assert innovation_of(beside, state).z == pytest.approx(innovation_of(alone, state).z)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(-3.1, 3.1),
    st.floats(-1.3, 1.3),
    st.floats(-3.1, 3.1),
    st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=3),
)
def test_attitude_and_heading_innovations(
    roll: float, pitch: float, yaw: float, phi: list[float]
) -> None:
    """z = -W phi to second order for any attitude; heading agrees with the attitude's third row."""
    model = measurement_model("ins15")
    nav = runs.level_nav((roll, pitch, yaw), VELOCITY)
    off = runs.with_error(nav, np.array([*phi, *[0.0] * 6]))
    state = state_of(model, off, np.zeros(model.size))
    measurement = AttitudeMeasurement(*SOURCE, (roll, pitch, yaw), (0.01, 0.01, 0.01))
    z, h, _ = innovation_of(measurement, state)
    assert z == pytest.approx(h[:, :3] @ phi, abs=1e-12)
    # The rows are roll, pitch and yaw: to first order what the angles themselves say.
    computed = rpy_from_dcm(state.dcm)
    direct = np.array(computed) - [roll, pitch, yaw]
    direct = (direct + math.pi) % (2 * math.pi) - math.pi
    assert z == pytest.approx(direct, abs=0.02**2 * 30.0)
    heading = innovation_of(HeadingMeasurement(*SOURCE, yaw, 0.01), state).z
    assert heading == pytest.approx(direct[2:], abs=1e-12)


@pytest.mark.parametrize("rpy", [(0.1, 0.2, 1.0), (1.0, -1.2, -2.0), (0.0, 1.35, 0.5)])
def test_attitude_noise_is_white_in_its_rows(rpy: tuple[float, float, float]) -> None:
    """Monte Carlo: noise on roll, pitch and yaw with different sigma gives cov(z) = diag(r).

    20 000 draws: a correlation is known to 0.007, a sigma to 0.5 %; four sigma is allowed.
    """
    model = measurement_model("ins15")
    nav = runs.level_nav(rpy, VELOCITY)
    state = state_of(model, nav, np.zeros(model.size))
    sd = np.array([1e-4, 4e-4, 2e-4])
    rng = np.random.default_rng(4)
    z = []
    for noise in rng.standard_normal((20_000, 3)) * sd:
        roll, pitch, yaw = (float(x) for x in np.array(rpy) + noise)
        found = innovation_of(
            AttitudeMeasurement(*SOURCE, (roll, pitch, yaw), (1e-4, 4e-4, 2e-4)), state
        )
        z.append(found.z / np.sqrt(found.r))
    cov = np.cov(np.array(z).T)
    assert np.sqrt(np.diag(cov)) == pytest.approx(np.ones(3), abs=0.02)
    assert np.abs(cov - np.diag(np.diag(cov))).max() < 0.03


def test_an_angle_that_was_not_measured_says_nothing() -> None:
    model = measurement_model("ins15")
    nav = runs.level_nav((0.1, 0.2, 1.0), VELOCITY)
    off = runs.with_error(nav, np.array([0.0, 0.0, -0.01, *[0.0] * 6]))
    state = state_of(model, off, np.zeros(model.size))
    nan = math.nan
    z, _, r = innovation_of(AttitudeMeasurement(*SOURCE, (nan, nan, 1.0), (nan, nan, 0.01)), state)
    heading = innovation_of(HeadingMeasurement(*SOURCE, 1.0, 0.01), state)
    assert z[2] == pytest.approx(heading.z[0], rel=1e-6)
    assert np.sqrt(r) == pytest.approx([math.pi, math.pi, 0.01])


def test_measurements_that_do_not_hold_say_why() -> None:
    model = measurement_model("ins15")
    moving = state_of(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    slow = state_of(model, runs.level_nav(RPY, (0.3, 0.1, 0.0)), np.zeros(model.size))
    steep = state_of(model, runs.level_nav((0.0, 1.45, 0.0), VELOCITY), np.zeros(model.size))
    assert ZeroVelocityUpdate(*SOURCE, 0.05, runs.rest()).innovation(moving) == NotApplicable(
        "moving"
    )
    rest = ZeroAngularRateUpdate(*SOURCE, (0.0, 0.0, 0.0), 1e-3, runs.rest())
    assert rest.innovation(moving) == NotApplicable("moving")
    assert isinstance(rest.innovation(slow), Innovation)
    slide = NonHolonomicConstraint(*SOURCE, 0.1, 0.2, 2.0, LEVER)
    assert slide.innovation(slow) == NotApplicable("too_slow")
    assert HeadingMeasurement(*SOURCE, 0.0, 0.01).innovation(steep) == NotApplicable("too_steep")


def test_non_holonomic_point_follows_the_forward_axis() -> None:
    """A point that moves along the body's forward axis has no innovation, whatever the rate."""
    model = measurement_model("ins15")
    dcm = dcm_from_rpy(*RPY)
    v = dcm @ (np.array([9.0, 0.0, 0.0]) - np.cross(RATE_SENSED, LEVER))
    n, e, d = (float(x) for x in v)
    state = state_of(model, runs.level_nav(RPY, (n, e, d)), np.zeros(model.size))
    z = innovation_of(NonHolonomicConstraint(*SOURCE, 0.1, 0.2, 2.0, LEVER), state).z
    assert z == pytest.approx([0.0, 0.0], abs=1e-12)
