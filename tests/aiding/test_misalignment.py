"""Star tracker and bearing: Jacobians, timing noise and refusals, with misalignment states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusiond.aiding.attitude import STAR_BLOCK, AttitudeMeasurement
from fusiond.aiding.base import Innovation, Linearised, NotApplicable, State
from fusiond.aiding.landmark_bearing import SAR_BLOCK, BearingMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.gnss.ecef import to_ecef
from fusiond.models.blocks import misalignment
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from fusiond.navigation.rotation import dcm_from_quaternion, rpy_from_dcm
from fusiond.navigation.strapdown import STEP_SIZE
from tests import runs

Array = NDArray[np.float64]

SOURCE = ("aid", 0, 0.99)
LEVER = (1.3, -0.4, -2.1)
VELOCITY = (120.0, -70.0, 0.8)
RATE = np.array([0.05, -0.03, 0.2])
ATTITUDES = [(0.08, -0.12, 2.3), (0.5, 1.1, -3.0), (-2.0, -0.9, 1.0)]
MISALIGNED = np.array([3e-4, -2e-4, 5e-4])
# From ORIGIN: 9 km north, 19 km east, 400 m below; and 220 km away, where the Earth is round.
NEAR = (runs.ORIGIN[0] + 1.4e-3, runs.ORIGIN[1] + 3.5e-3, -360.0)
FAR = (runs.ORIGIN[0] - 0.03, runs.ORIGIN[1] + 0.02, 900.0)


def _model(name: str, block: str) -> Model:
    return make_model(name, imu_noise(Imu()), misalignment(block, 2e-3, math.inf))


def _state(model: Model, nav: Array, xi: Array) -> State:
    step = np.zeros(STEP_SIZE)
    step[3:6] = RATE
    step[9:18] = dcm_from_quaternion(nav[6:]).ravel()
    return State(nav, xi, step, model)


def _innovation(measurement: Linearised, state: State) -> Innovation:
    found = measurement.innovation(state)
    assert isinstance(found, Innovation)
    return found


def _check_jacobian(measurement: Linearised, model: Model, nav: Array, tolerance: float) -> None:
    """H against the change of z with one state at a time; a parameter in error by +d is an estimate
    short by d. First order in the misalignment itself: `tolerance` covers it."""
    xi = np.zeros(model.size)
    xi[-3:] = MISALIGNED
    h = _innovation(measurement, _state(model, nav, xi)).h
    unit = np.abs(h).max(axis=1)
    for k in range(model.size):
        if not model.active[k]:
            assert (h[:, k] == 0.0).all()
            continue
        size = 10.0 if 3 <= k < 9 else 1e-4
        ends = []
        for sign in (1.0, -1.0):
            error = np.zeros(model.size)
            error[k] = sign * size
            off = runs.with_error(nav, error[:9])
            ends.append(
                _innovation(measurement, _state(model, off, xi - np.r_[np.zeros(9), error[9:]])).z
            )
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        # Metres act by 1 / distance: what is compared is relative to the largest of their kind.
        scale = np.abs(h[:, 6:9]).max(axis=1) if 6 <= k < 9 else unit
        assert numeric == pytest.approx(h[:, k], abs=tolerance * scale.max()), k


@pytest.mark.parametrize("rpy", ATTITUDES)
@pytest.mark.parametrize("name", ["ins15", "planar15"])
def test_jacobian_of_a_star_tracker(name: str, rpy: tuple[float, float, float]) -> None:
    model, nav = _model(name, STAR_BLOCK), runs.level_nav(rpy, VELOCITY)
    turned = dcm_from_quaternion(nav[6:]) @ Rotation.from_rotvec(MISALIGNED).as_matrix()
    measurement = AttitudeMeasurement(
        *SOURCE, rpy_from_dcm(turned), (0.001, 0.002, 0.003), block=STAR_BLOCK
    )
    # 5e-4 of misalignment turns its own Jacobian by half of that.
    _check_jacobian(measurement, model, nav, 4e-4)
    h = _innovation(measurement, _state(model, nav, np.zeros(model.size))).h
    assert np.abs(h[:, -3:]).max() > 0.5


@pytest.mark.parametrize("rpy", ATTITUDES)
@pytest.mark.parametrize("name", ["ins15", "planar15"])
@pytest.mark.parametrize("point", [NEAR, FAR])
def test_jacobian_of_a_bearing(
    name: str, rpy: tuple[float, float, float], point: tuple[float, float, float]
) -> None:
    v = (*VELOCITY[:2], 0.0) if name == "planar15" else VELOCITY
    model, nav = _model(name, SAR_BLOCK), runs.level_nav(rpy, v)
    measurement = BearingMeasurement(
        *SOURCE, 0.3, 0.1, (1e-3, 1e-3), point, LEVER, 500.0, block=SAR_BLOCK
    )
    _check_jacobian(measurement, model, nav, 1e-3)


def _seen(nav: Array, point: tuple[float, float, float], turn: Rotation) -> tuple[float, float]:
    """Azimuth and elevation by other means: Earth-fixed points and scipy's rotations."""
    lat, lon = float(nav[0]), float(nav[1])
    to_earth = Rotation.from_euler("ZY", [lon, -lat - math.pi / 2.0])
    to_body = Rotation.from_quat(np.roll(nav[6:], -1)).inv()
    apart = np.subtract(to_ecef(*point), to_ecef(lat, lon, float(nav[2])))
    sight = to_body.apply(to_earth.inv().apply(apart)) - LEVER
    x, y, z = turn.inv().apply(sight)
    return math.atan2(y, x), math.asin(-z / math.sqrt(x * x + y * y + z * z))


@pytest.mark.parametrize("rpy", ATTITUDES)
def test_a_true_bearing_has_no_innovation(rpy: tuple[float, float, float]) -> None:
    model, nav = _model("ins15", SAR_BLOCK), runs.level_nav(rpy, VELOCITY)
    xi = np.zeros(model.size)
    xi[-3:] = 0.02, -0.03, 0.01
    azimuth, elevation = _seen(nav, NEAR, Rotation.from_rotvec(xi[-3:]))
    measurement = BearingMeasurement(
        *SOURCE, azimuth, elevation, (1e-3, 1e-3), NEAR, LEVER, 0.0, block=SAR_BLOCK
    )
    z = _innovation(measurement, _state(model, nav, xi)).z
    assert z == pytest.approx([0.0, 0.0], abs=1e-11)
    # Azimuth runs from x to y, elevation against z: a level vehicle that heads north.
    level = runs.level_nav((0.0, 0.0, 0.0), VELOCITY)
    azimuth, elevation = _seen(level, NEAR, Rotation.identity())
    assert azimuth == pytest.approx(math.atan2(3.5e-3 * math.cos(nav[0]), 1.4e-3), abs=0.01)
    assert elevation == pytest.approx(-400.0 / 21.2e3, abs=0.003)


def test_a_true_star_tracker_has_no_innovation() -> None:
    model, nav = _model("ins15", STAR_BLOCK), runs.level_nav(ATTITUDES[1], VELOCITY)
    xi = np.zeros(model.size)
    xi[-3:] = 0.02, -0.03, 0.01
    turned = dcm_from_quaternion(nav[6:]) @ Rotation.from_rotvec(xi[-3:]).as_matrix()
    measurement = AttitudeMeasurement(*SOURCE, rpy_from_dcm(turned), (1e-3,) * 3, block=STAR_BLOCK)
    assert _innovation(measurement, _state(model, nav, xi)).z == pytest.approx(
        np.zeros(3), abs=1e-12
    )
    # A model without the block takes the attitude as the body's.
    plain = make_model("ins15", imu_noise(Imu()))
    z, h, _ = _innovation(measurement, _state(plain, nav, np.zeros(plain.size)))
    assert np.abs(z).max() > 0.01
    assert h.shape == (3, plain.size)


def _moved(nav: Array, seconds: float) -> Array:
    """Straight on with the turn of RATE, for so short a time that nothing bends."""
    after = nav.copy()
    after[:3] += nav[3:6] * seconds / runs.metres_per_unit(float(nav[0]), float(nav[2]))
    turned = dcm_from_quaternion(nav[6:]) @ Rotation.from_rotvec(RATE * seconds).as_matrix()
    after[6:] = np.roll(Rotation.from_matrix(turned).as_quat(), 1)
    return after


@pytest.mark.parametrize(
    ("block", "make"),
    [
        (STAR_BLOCK, lambda: AttitudeMeasurement(*SOURCE, ATTITUDES[0], (1e-4,) * 3)),
        (SAR_BLOCK, lambda: BearingMeasurement(*SOURCE, 0.0, 0.0, (1e-4,) * 2, NEAR, LEVER, 0.0)),
    ],
)
def test_timing_error_adds_what_turns_and_moves_in_it(
    block: str, make: Callable[[], AttitudeMeasurement | BearingMeasurement]
) -> None:
    model, nav = _model("ins15", block), runs.level_nav(ATTITUDES[0], VELOCITY)
    measurement, xi = make(), np.zeros(model.size)
    before = _innovation(measurement, _state(model, nav, xi))
    rate = (_innovation(measurement, _state(model, _moved(nav, 1e-3), xi)).z - before.z) / 1e-3
    added = _innovation(replace(measurement, sd_time_s=0.02), _state(model, nav, xi)).r - before.r
    assert np.sqrt(added) == pytest.approx(0.02 * np.abs(rate), rel=2e-3)


def test_bearings_that_do_not_hold_say_why() -> None:
    model = _model("ins15", SAR_BLOCK)
    measurement = BearingMeasurement(
        *SOURCE, 0.3, 0.1, (1e-3, 1e-3), NEAR, LEVER, 30_000.0, block=SAR_BLOCK
    )
    state = _state(model, runs.level_nav((0.0, 0.0, 0.0), VELOCITY), np.zeros(model.size))
    assert measurement.innovation(state) == NotApplicable("too_close")
    assert isinstance(replace(measurement, least_range_m=15_000.0).innovation(state), Innovation)
    below = replace(measurement, point=(*runs.ORIGIN[:2], -9000.0), least_range_m=0.0)
    assert below.innovation(state) == NotApplicable("too_steep")
