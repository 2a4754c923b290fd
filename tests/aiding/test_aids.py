"""Every aid's Jacobian and noise, numerically, for full, planar and scale-factor models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusiond.aiding.attitude import AttitudeAid, HeadingAid
from fusiond.aiding.base import Innovation, Linearised, NotApplicable, State
from fusiond.aiding.body_velocity import NonHolonomicAid, WheelSpeedAid
from fusiond.aiding.height import BarometerAid, HeightAid
from fusiond.aiding.position import PositionAid
from fusiond.aiding.rdss_position import BIAS_BLOCK, RdssPositionAid
from fusiond.aiding.standstill import ZeroRateAid, ZeroVelocityAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import imu_noise
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.models.vehicle import (
    ANTENNA_LEVER,
    BAROMETER_AIRFLOW,
    BAROMETER_OFFSET,
    BAROMETER_SCALE,
    FIX_TIME,
    SIDE_DRIFT,
    VELOCITY_TIME,
    WHEEL_DRIFT,
    WHEEL_LATENCY,
    WHEEL_ROUNDING,
    WHEEL_SCALE,
    antenna_lever,
    axle_lever,
    barometer_airflow,
    barometer_offset,
    barometer_scale,
    drift,
    mounting,
    time_offset,
    wheel_rounding,
    wheel_scale,
)
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.rotation import dcm_from_quaternion, dcm_from_rpy, rpy_from_dcm
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs

Array = NDArray[np.float64]

SOURCE = ("aid", 0, 0.99)
LEVER = (1.3, -0.4, -2.1)
FIX_BIAS = ("gnss_bias", "gnss_bias_down")
RATE_SENSED = np.array([0.05, -0.03, 0.4])
MODELS = ("ins15", "ins21", "planar15")
VELOCITY = (12.0, -7.0, 0.8)
RPY = (0.08, -0.12, 2.3)


def _model(name: str) -> Model:
    biases = (
        position_bias(BIAS_BLOCK, 30.0, 600.0),
        position_bias(FIX_BIAS[0], 1.5, 1800.0),
        position_bias(FIX_BIAS[1], 5.0, 1800.0, "d"),
    )
    return make_model(name, imu_noise(Imu()), *biases)


VEHICLE = (
    mounting(0.1),
    axle_lever(1.0),
    drift(SIDE_DRIFT, 0.1, 5.0),
    drift(WHEEL_DRIFT, 0.1, 1.0),
    wheel_scale(WHEEL_SCALE, 0.02),
    time_offset(WHEEL_LATENCY, 0.2),
    time_offset(FIX_TIME, 0.1),
    time_offset(VELOCITY_TIME, 0.1),
    antenna_lever(ANTENNA_LEVER, 0.3),
    wheel_rounding(WHEEL_ROUNDING, 0.25),
)
# What the filter holds of them: mounting pitch and yaw, lever, two drifts, scale, latency, two
# offsets in time, lever of the antenna, rounding.
ESTIMATED = (-0.12, 0.09, 0.7, -0.2, 0.3, 0.013, 0.15, 0.12, -0.08, 0.2, -0.1, 0.05, 0.2)
ACCELERATION = (1.4, -0.8, 0.3)
KM_H = 1.0 / 3.6
AIR = (BAROMETER_OFFSET, BAROMETER_SCALE, BAROMETER_AIRFLOW)


def _vehicle_model() -> Model:
    return make_model("ins15", imu_noise(Imu()), *VEHICLE)


def _state(model: Model, nav: Array, xi: Array) -> State:
    """As the filter leaves it: `step` holds the rate with the estimates taken out."""
    step = np.zeros(STEP_SIZE)
    for axis in range(3):
        bias = sum(xi[s] for s in model.parameters(9 + axis))
        scale = sum(xi[s] for s in model.parameters(15 + axis))
        step[3 + axis] = (RATE_SENSED[axis] - bias) / (1.0 + scale)
    step[9:18] = dcm_from_quaternion(nav[6:]).ravel()
    felt = np.array(ACCELERATION) - [0.0, 0.0, gravity(float(nav[0]), float(nav[2]))]
    step[18:] = dcm_from_quaternion(nav[6:]) @ (dcm_from_rpy(*RPY).T @ felt)
    return State(nav, xi, step, model)


def _innovation(aid: Linearised, state: State) -> Innovation:
    found = aid.innovation(state)
    assert isinstance(found, Innovation)
    return found


def _check_jacobian(
    make: Callable[[Array], Linearised],
    name: str,
    rpy: tuple[float, float, float] = RPY,
    tolerance: float = 1e-6,
    model: Model | None = None,
    estimated: tuple[float, ...] = (),
) -> None:
    """H against the change of z when the *computed* state is off by one state at a time.

    Parameters in error by +d are estimates short by d. `tolerance` covers the curvature over the
    step of the central difference and latitude's rounding.
    """
    model = model or _model(name)
    v = (*VELOCITY[:2], 0.0) if model.hold_height else VELOCITY
    nav = runs.level_nav(rpy, v)
    xi = np.zeros(model.size)
    for axis in range(3):
        xi[model.parameters(9 + axis)[0]] = 1e-3 * (axis + 1)
    if estimated:
        xi[-len(estimated) :] = estimated
    aid = make(nav)
    z, h, r = _innovation(aid, _state(model, nav, xi))
    assert h.shape == (len(z), model.size)
    assert r.shape == z.shape
    assert (r > 0.0).all()
    for k in range(model.size):
        if not model.active[k]:
            assert (h[:, k] == 0.0).all()
            continue
        if model.column_of[k] in range(15, 18):
            continue  # see test_scale_factors_are_left_out_of_lever_arms
        size = 1.0 if 6 <= k < 9 else 1e-4
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(model.size)
            error[k] = sign * size
            off = runs.with_error(nav, error[:9])
            ends.append(_innovation(aid, _state(model, off, xi - np.r_[np.zeros(9), error[9:]])).z)
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        assert numeric == pytest.approx(h[:, k], abs=tolerance), (k, numeric, h[:, k])


def _position(nav: Array, height: bool = True) -> PositionAid:
    lat, lon, up = (float(x) for x in nav[:3])
    sd = (1.0, 2.0, 3.0)
    return PositionAid(*SOURCE, lat + 1e-6, lon - 2e-6, up + 3.0 if height else None, sd, LEVER)


def _rdss(nav: Array, moved_s: float = 0.0) -> RdssPositionAid:
    lat, lon = float(nav[0]) + 1e-6, float(nav[1]) - 2e-6
    return RdssPositionAid(*SOURCE, lat, lon, (400.0, -150.0, 200.0), LEVER, moved_s=moved_s)


AIDS: dict[str, Callable[[Array], Linearised]] = {
    "position": _position,
    "horizontal position": lambda nav: _position(nav, False),
    "position with a shared error": lambda nav: replace(_position(nav), bias=FIX_BIAS),
    "horizontal, shared error": lambda nav: replace(_position(nav, False), bias=FIX_BIAS),
    "rdss": _rdss,
    "rdss, moved by the delay": lambda nav: _rdss(nav, 1.5),
    "velocity": lambda nav: VelocityAid(*SOURCE, (12.3, -7.2, 0.7), (0.1, 0.1, 0.2), LEVER),
    "horizontal velocity": lambda nav: VelocityAid(*SOURCE, (12.3, -7.2), (0.1, 0.1), LEVER),
    "heading": lambda nav: HeadingAid(*SOURCE, 2.25, 0.01),
    "non-holonomic": lambda nav: NonHolonomicAid(*SOURCE, 0.1, 0.2, 2.0, LEVER),
    "wheel speed": lambda nav: WheelSpeedAid(*SOURCE, 14.0, 0.1, LEVER),
    "zero velocity": lambda nav: ZeroVelocityAid(*SOURCE, 0.05, runs.rest(100.0)),
    "zero rate": lambda nav: ZeroRateAid(*SOURCE, (2e-3, 1e-3, 3e-3), 1e-3, runs.rest(100.0)),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", sorted(AIDS))
def test_jacobian(kind: str, model: str) -> None:
    # Position: a metre north turns east's scale by cos' / R; zero rate: the Earth's own rate in H.
    tolerance = {"zero rate": 1e-4, "heading": 2e-6}.get(kind, 2e-6)
    _check_jacobian(AIDS[kind], model, tolerance=tolerance)


IN_TIME: dict[str, Callable[[Array], Linearised]] = {
    "no slip": AIDS["non-holonomic"],
    "wheel": lambda nav: replace(
        WheelSpeedAid(*SOURCE, 14.0, 0.1, LEVER),
        drift=WHEEL_DRIFT,
        scale=WHEEL_SCALE,
        latency=WHEEL_LATENCY,
        rounding=WHEEL_ROUNDING,
        shared_step_m_s=KM_H,
    ),
    "position": lambda nav: replace(_position(nav), time=FIX_TIME, rest=ANTENNA_LEVER),
    "horizontal position": lambda nav: replace(_position(nav, False), time=FIX_TIME),
    "velocity": lambda nav: replace(
        VelocityAid(*SOURCE, (12.3, -7.2, 0.7), (0.1, 0.1, 0.2), LEVER),
        time=VELOCITY_TIME,
        rest=ANTENNA_LEVER,
    ),
}


@pytest.mark.parametrize("kind", sorted(IN_TIME))
def test_jacobian_of_what_an_owner_cannot_measure(kind: str) -> None:
    """With estimates of 5 to 7 deg, decimetres and tenths of seconds."""
    model = _vehicle_model()
    # Third order of the mounting.
    _check_jacobian(IN_TIME[kind], "", tolerance=1e-3, model=model, estimated=ESTIMATED)


def test_a_mounting_scale_and_offset_explain_what_is_measured() -> None:
    """z = 0 where the parameters are those that the measurement was made with, by other means."""
    model = _vehicle_model()
    nav = runs.level_nav(RPY, VELOCITY)
    xi = np.zeros(model.size)
    xi[-len(ESTIMATED) :] = ESTIMATED
    state = _state(model, nav, xi)
    pitch, yaw, lever, _, slipping, scale, latency, late, _, *rest, share = ESTIMATED
    to_vehicle = Rotation.from_rotvec([0.0, pitch, yaw]).as_matrix()
    dcm = Rotation.from_euler("ZYX", RPY[::-1]).as_matrix()
    at_wheel = dcm.T @ VELOCITY + np.cross(RATE_SENSED, np.add(LEVER, (lever, 0.0, 0.0)))
    before = to_vehicle @ (at_wheel - dcm.T @ ACCELERATION * latency)
    reads = float((1.0 + scale) * before[0] + slipping)
    reads -= math.copysign(share * KM_H, reads)
    wheel = WheelSpeedAid(*SOURCE, reads, 0.1, LEVER)
    wheel = replace(wheel, drift=WHEEL_DRIFT, scale=WHEEL_SCALE, latency=WHEEL_LATENCY)
    wheel = replace(wheel, rounding=WHEEL_ROUNDING, shared_step_m_s=KM_H)
    assert _innovation(wheel, state).z == pytest.approx([0.0], abs=1e-9)
    arm = dcm @ np.add(LEVER, rest)
    moved = np.array(VELOCITY) + dcm @ np.cross(RATE_SENSED, np.add(LEVER, rest))
    moved = moved * late + 0.5 * np.array(ACCELERATION) * late**2
    antenna = nav[:3] + (arm + moved) / runs.metres(*nav[[0, 2]])
    lat, lon, height = (float(x) for x in antenna)
    fix = PositionAid(*SOURCE, lat, lon, height, (1.0, 1.0, 1.0), LEVER)
    fix = replace(fix, time=FIX_TIME, rest=ANTENNA_LEVER)
    assert _innovation(fix, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)


def test_what_a_late_fix_leaves_out_of_its_jacobian_is_noise() -> None:
    """Innovations of drawn errors, less H dx: their variance is what r states beyond the fix's."""
    model = _vehicle_model()
    nav, xi = runs.level_nav(RPY, VELOCITY), np.zeros(model.size)
    (late,) = model.slots_of(FIX_TIME)
    aid = replace(_position(nav), time=FIX_TIME, rest=ANTENNA_LEVER)
    root = np.zeros((model.size, 4))  # of the offset, correlated with the velocity, and that
    root[late, 0] = 0.08
    root[3:6, 0] = 0.3, -0.2, 0.1
    root[3:6, 1:] = np.diag([0.5, 0.8, 0.3])
    state = _state(model, nav, xi)._replace(covariance=root @ root.T)
    z, h, r = _innovation(aid, state)
    rng, left = np.random.default_rng(5), []
    for error in rng.standard_normal((3000, 4)) @ root.T:
        off = runs.with_error(nav, error[:9])
        found = _innovation(aid, _state(model, off, xi - np.r_[np.zeros(9), error[9:]]))
        left.append(found.z - z - h @ error)
    assert r - np.square(aid.sd) == pytest.approx(np.var(left, axis=0), rel=0.15)
    assert (_innovation(aid, _state(model, nav, xi)).r == np.square(aid.sd)).all()


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.5, 1.1, -3.0), (-2.0, -0.9, 1.0)])
def test_jacobian_at_steep_attitudes(rpy: tuple[float, float, float]) -> None:
    _check_jacobian(lambda nav: HeadingAid(*SOURCE, rpy[2], 0.01), "ins15", rpy, 1e-5)
    _check_jacobian(lambda nav: AttitudeAid(*SOURCE, rpy, (0.01, 0.02, 0.03)), "ins15", rpy)
    _check_jacobian(AIDS["velocity"], "ins15", rpy, 2e-6)


def test_height_jacobian_and_planar() -> None:
    _check_jacobian(lambda nav: HeightAid(*SOURCE, 41.0, 5.0), "ins15")
    model = _model("planar15")
    state = _state(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    assert HeightAid(*SOURCE, 41.0, 5.0).innovation(state) == NotApplicable("height_held")
    assert BarometerAid(*SOURCE, 41.0, 5.0, *AIR).innovation(state) == NotApplicable("height_held")


def test_barometer_jacobian_and_what_explains_it() -> None:
    blocks = (
        barometer_offset(AIR[0], 100.0, 0.15),
        barometer_scale(AIR[1], 0.04),
        barometer_airflow(AIR[2], 0.1),
    )
    model = make_model("ins15", imu_noise(Imu()), *blocks)
    aid = BarometerAid(*SOURCE, 120.0, 5.0, *AIR)
    _check_jacobian(lambda nav: aid, "", model=model, estimated=(70.0, 0.05, 0.2))
    nav, xi = runs.level_nav(RPY, VELOCITY), np.zeros(model.size)
    xi[-3:] = 70.0, 0.05, 0.2
    lift_m = 0.2 * math.hypot(*VELOCITY[:2]) ** 2 / (2.0 * 9.80665)
    felt = replace(aid, height_m=1.05 * float(nav[2]) + 70.0 + lift_m)
    assert _innovation(felt, _state(model, nav, xi)).z == pytest.approx([0.0], abs=1e-9)


def test_scale_factors_are_left_out_of_lever_arms() -> None:
    """What a scale factor does over a lever arm: 2000 ppm of 0.5 rad/s over 2 m is 2 mm/s."""
    model = _model("ins21")
    nav = runs.level_nav(RPY, VELOCITY)
    aid = AIDS["velocity"](nav)
    xi = np.zeros(model.size)
    base = _innovation(aid, _state(model, nav, xi)).z
    xi[model.parameters(17)] = 2e-3
    assert np.abs(_innovation(aid, _state(model, nav, xi)).z - base).max() < 2e-3


def test_innovation_is_zero_where_the_measurement_is_true() -> None:
    """z = h(truth) - y = 0 for measurements made by other means than the aids' own formulas."""
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    dcm = Rotation.from_euler("ZYX", RPY[::-1]).as_matrix()
    state = _state(model, nav, np.zeros(model.size))
    antenna = nav[:3] + (dcm @ LEVER) / runs.metres(*nav[[0, 2]])
    lat, lon, height = (float(x) for x in antenna)
    fix = PositionAid(*SOURCE, lat, lon, height, (1.0, 1.0, 1.0), LEVER)
    assert _innovation(fix, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    moving = VELOCITY + dcm @ np.cross(RATE_SENSED, LEVER)
    n, e, d = (float(x) for x in moving)
    aid = VelocityAid(*SOURCE, (n, e, d), (0.1, 0.1, 0.1), LEVER)
    assert _innovation(aid, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    wheel = WheelSpeedAid(*SOURCE, float((dcm.T @ moving)[0]), 0.1, LEVER)
    assert _innovation(wheel, state).z == pytest.approx([0.0], abs=1e-12)
    lat = runs.ORIGIN[0]
    sensed = dcm.T @ (EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)]))
    x, y, z = (float(v) for v in sensed)
    still = ZeroRateAid(*SOURCE, (x, y, z), 1e-3, runs.rest(99.0))
    assert _innovation(still, state).z == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_position_across_the_date_line() -> None:
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    nav[1] = math.pi - 1e-7
    fix = PositionAid(*SOURCE, float(nav[0]), -math.pi + 1e-7, 40.0, (1.0, 1.0, 1.0), (0.0,) * 3)
    z = _innovation(fix, _state(model, nav, np.zeros(model.size))).z
    assert z[1] == pytest.approx(-2e-7 * runs.metres(*nav[[0, 2]])[1], rel=1e-6)


def test_rdss_rows_are_whitened_by_the_covariance_of_the_fix() -> None:
    """z and H in units of sigma: with R the fix's covariance, H^T H = R^-1 for its position."""
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    state = _state(model, nav, np.zeros(model.size))
    z, h, r = _innovation(_rdss(nav), state)
    whiten = h[:, 6:8]
    cov = np.array([[400.0, -150.0], [-150.0, 200.0]])
    assert whiten.T @ whiten == pytest.approx(np.linalg.inv(cov), rel=1e-9)
    assert r == pytest.approx([1.0, 1.0])
    lever = state.dcm @ LEVER
    metres = np.array([-1e-6, 2e-6]) * runs.metres(*nav[[0, 2]])[:2] + lever[:2]
    assert z == pytest.approx(whiten @ metres, rel=1e-6)
    timed = _innovation(replace(_rdss(nav), sd_time_s=0.5), state).h[:, 6:8]
    v = np.array(VELOCITY[:2])
    expected = np.linalg.inv(cov + 0.25 * np.outer(v, v))
    assert timed.T @ timed == pytest.approx(expected, rel=1e-9)


def test_timing_error_adds_along_the_velocity() -> None:
    model = _model("ins15")
    nav = runs.level_nav(RPY, VELOCITY)
    state = _state(model, nav, np.zeros(model.size))
    r = _innovation(replace(_position(nav), sd_time_s=0.1), state).r
    assert r == pytest.approx([1.0 + 1.2**2, 4.0 + 0.7**2, 9.0 + 0.08**2])


def test_timing_error_of_a_velocity_adds_along_the_acceleration() -> None:
    model = _model("ins15")
    state = _state(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    sd = (0.1, 0.1, 0.2)
    aid = VelocityAid(*SOURCE, (12.3, -7.2, 0.7), sd, LEVER, sd_time_s=0.5)
    assert np.abs(state.acceleration).min() > 0.01
    expected = np.square(sd) + np.square(0.5 * state.acceleration)
    assert _innovation(aid, state).r == pytest.approx(expected)


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
    model = _model("ins15")
    nav = runs.level_nav((roll, pitch, yaw), VELOCITY)
    off = runs.with_error(nav, np.array([*phi, *[0.0] * 6]))
    state = _state(model, off, np.zeros(model.size))
    aid = AttitudeAid(*SOURCE, (roll, pitch, yaw), (0.01, 0.01, 0.01))
    z, h, _ = _innovation(aid, state)
    assert z == pytest.approx(h[:, :3] @ phi, abs=1e-12)
    # The rows are roll, pitch and yaw: to first order what the angles themselves say.
    computed = rpy_from_dcm(state.dcm)
    direct = np.array(computed) - [roll, pitch, yaw]
    direct = (direct + math.pi) % (2 * math.pi) - math.pi
    assert z == pytest.approx(direct, abs=0.02**2 * 30.0)
    heading = _innovation(HeadingAid(*SOURCE, yaw, 0.01), state).z
    assert heading == pytest.approx(direct[2:], abs=1e-12)


@pytest.mark.parametrize("rpy", [(0.1, 0.2, 1.0), (1.0, -1.2, -2.0), (0.0, 1.35, 0.5)])
def test_attitude_noise_is_white_in_its_rows(rpy: tuple[float, float, float]) -> None:
    """Monte Carlo: noise on roll, pitch and yaw with different sigma gives cov(z) = diag(r).

    20 000 draws: a correlation is known to 0.007, a sigma to 0.5 %; four sigma is allowed.
    """
    model = _model("ins15")
    nav = runs.level_nav(rpy, VELOCITY)
    state = _state(model, nav, np.zeros(model.size))
    sd = np.array([1e-4, 4e-4, 2e-4])
    rng = np.random.default_rng(4)
    z = []
    for noise in rng.standard_normal((20_000, 3)) * sd:
        roll, pitch, yaw = (float(x) for x in np.array(rpy) + noise)
        found = _innovation(AttitudeAid(*SOURCE, (roll, pitch, yaw), (1e-4, 4e-4, 2e-4)), state)
        z.append(found.z / np.sqrt(found.r))
    cov = np.cov(np.array(z).T)
    assert np.sqrt(np.diag(cov)) == pytest.approx(np.ones(3), abs=0.02)
    assert np.abs(cov - np.diag(np.diag(cov))).max() < 0.03


def test_an_angle_that_was_not_measured_says_nothing() -> None:
    model = _model("ins15")
    nav = runs.level_nav((0.1, 0.2, 1.0), VELOCITY)
    off = runs.with_error(nav, np.array([0.0, 0.0, -0.01, *[0.0] * 6]))
    state = _state(model, off, np.zeros(model.size))
    nan = math.nan
    z, _, r = _innovation(AttitudeAid(*SOURCE, (nan, nan, 1.0), (nan, nan, 0.01)), state)
    heading = _innovation(HeadingAid(*SOURCE, 1.0, 0.01), state)
    assert z[2] == pytest.approx(heading.z[0], rel=1e-6)
    assert np.sqrt(r) == pytest.approx([math.pi, math.pi, 0.01])


def test_aids_that_do_not_hold_say_why() -> None:
    model = _model("ins15")
    moving = _state(model, runs.level_nav(RPY, VELOCITY), np.zeros(model.size))
    slow = _state(model, runs.level_nav(RPY, (0.3, 0.1, 0.0)), np.zeros(model.size))
    steep = _state(model, runs.level_nav((0.0, 1.45, 0.0), VELOCITY), np.zeros(model.size))
    assert ZeroVelocityAid(*SOURCE, 0.05, runs.rest()).innovation(moving) == NotApplicable("moving")
    rest = ZeroRateAid(*SOURCE, (0.0, 0.0, 0.0), 1e-3, runs.rest())
    assert rest.innovation(moving) == NotApplicable("moving")
    assert isinstance(rest.innovation(slow), Innovation)
    slide = NonHolonomicAid(*SOURCE, 0.1, 0.2, 2.0, LEVER)
    assert slide.innovation(slow) == NotApplicable("too_slow")
    assert HeadingAid(*SOURCE, 0.0, 0.01).innovation(steep) == NotApplicable("too_steep")


def test_non_holonomic_point_follows_the_forward_axis() -> None:
    """A point that moves along the body's forward axis has no innovation, whatever the rate."""
    model = _model("ins15")
    dcm = dcm_from_rpy(*RPY)
    v = dcm @ (np.array([9.0, 0.0, 0.0]) - np.cross(RATE_SENSED, LEVER))
    n, e, d = (float(x) for x in v)
    state = _state(model, runs.level_nav(RPY, (n, e, d)), np.zeros(model.size))
    z = _innovation(NonHolonomicAid(*SOURCE, 0.1, 0.2, 2.0, LEVER), state).z
    assert z == pytest.approx([0.0, 0.0], abs=1e-12)
