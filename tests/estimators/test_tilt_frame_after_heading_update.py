"""The axes in which a tilt is known, when an update turns the heading."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.attitude import AttitudeMeasurement, HeadingMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.invariant import InvariantFilter
from fusiond.estimators.tilt_axes_rotation_after_update import heading_turn
from fusiond.models.catalogue import make_model
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.navigation.error_model import DV, PHI
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    quaternion_from_rpy,
    rpy_from_dcm,
)
from tests import runs

Array = NDArray[np.float64]

FORCE_SD, KNOWN_SD = 0.1, 1e-3
# A damaged or loose unit: a hundred times what a data sheet says.
LOOSE_FORCE_M_S2 = 0.5
HEADING_SD_RAD = math.radians(3.0)


def _sensed(f: InvariantFilter) -> Array:
    """What tilt and force biases make of the acceleration, north, east, down: rows (3, n)."""
    rows = np.zeros((3, f.model.size))
    rows[:2, PHI : PHI + 2] = STANDARD_GRAVITY_M_S2 * np.array([[0.0, 1.0], [-1.0, 0.0]])
    rows[:, 12:15] = dcm_from_quaternion(f.nav[6:])
    return rows


def _straight_on(
    yaw_rad: float, heading_sd: float = HEADING_SD_RAD, force_sd: float = FORCE_SD
) -> InvariantFilter:
    """At 20 m/s: heading to `heading_sd`, force biases to `force_sd`, and what they and the tilt
    make together to `KNOWN_SD`."""
    f = InvariantFilter(make_model("ins15", imu_noise(Imu())), 1.0)
    n = f.model.size
    nav = runs.level_nav(
        (0.0, 0.0, yaw_rad), (20.0 * math.cos(yaw_rad), 20.0 * math.sin(yaw_rad), 0.0)
    )
    p = np.diag(f.model.initial**2)
    p[PHI : PHI + 2, PHI : PHI + 2] = KNOWN_SD**2 * np.eye(2)
    p[PHI + 2, PHI + 2] = heading_sd**2
    p[DV : DV + 6, DV : DV + 6] = 0.01 * np.eye(6)
    p[12:15, 12:15] = np.diag([force_sd**2, force_sd**2, KNOWN_SD**2])
    f.initialise(0, 0, nav, np.zeros(n), np.eye(n))
    sensed = np.eye(n)
    sensed[[PHI, PHI + 1, 14]] = _sensed(f)
    from_felt = np.linalg.inv(sensed)
    f.covariance[:] = from_felt @ p @ from_felt.T
    return f


@pytest.mark.parametrize("yaw_deg", [0.0, 75.0, -160.0])
@pytest.mark.parametrize(("heading_deg", "force_sd"), [(3.0, FORCE_SD), (1.0, LOOSE_FORCE_M_S2)])
def test_a_turned_heading_leaves_what_tilt_and_bias_make_together(
    heading_deg: float, force_sd: float, yaw_deg: float
) -> None:
    """Of a start on the move, and of a heading known to a degree and a unit that came loose."""
    sd = math.radians(heading_deg)
    f = _straight_on(math.radians(yaw_deg), sd, force_sd)
    for off in (1.0, -4.0 / 3.0, 5.0 / 3.0):
        f.covariance[2, 2] = sd**2
        yaw = math.radians(yaw_deg) + off * sd
        assert f.update(HeadingMeasurement("compass", 0, 0.9999, yaw, sd)).name == "fused"
        known = _sensed(f) @ f.covariance @ _sensed(f).T
        assert np.sqrt(np.diag(known)) == pytest.approx(KNOWN_SD, rel=0.05)
        assert np.sqrt(np.diag(f.covariance)[12:14]) == pytest.approx(force_sd, rel=0.01)
        assert f.covariance == pytest.approx(f.covariance.T, abs=1e-15)


def test_a_fault_that_is_taken_out_turns_the_axes_as_an_update_does() -> None:
    """A yaw gyro that was off at rest had turned the unit's axes, and P's with them; corrected
    twice, a parked vehicle was surer of its tilt than anything had told, by six sigma."""
    f = _straight_on(0.3)
    nothing = np.zeros((f.model.size, f.model.size))
    for turned in (0.2, -0.4):
        mean = np.zeros(f.model.size)
        mean[PHI + 2] = turned
        f.adopt(mean, nothing)
        known = _sensed(f) @ f.covariance @ _sensed(f).T
        assert np.sqrt(np.diag(known)) == pytest.approx(KNOWN_SD, rel=0.05)
        assert f.covariance == pytest.approx(f.covariance.T, abs=1e-15)


@pytest.mark.parametrize("turns", [False, True])
def test_a_corrected_tilt_leaves_what_the_biases_make_downward(turns: bool) -> None:
    """A vehicle at rest whose unit had come loose, and whose tilt was corrected by a tenth of a
    degree at each fix, was told by them what tilt and bias are apart, as far as 0.3 deg, and was
    wrong by seven sigma."""
    f = _straight_on(0.3)
    f.turns = turns
    level = math.radians(2.0)
    measurement = AttitudeMeasurement(
        "attitude", 0, 0.9999, (level, -level, math.nan), (0.01, 0.01, 1.0)
    )
    assert f.update(measurement).name == "fused"
    known = _sensed(f) @ f.covariance @ _sensed(f).T
    assert np.sqrt(np.diag(known)) == pytest.approx(KNOWN_SD, rel=0.05)


@pytest.mark.parametrize("turns", [False, True])
def test_a_corrected_tilt_does_not_move_the_vehicle_downward(turns: bool) -> None:
    """What is felt at rest is taken for the same acceleration before and after tilt and force
    biases have changed together; g (3 deg)^2 / 2 is 0.013 m/s^2."""
    f = _straight_on(0.3, math.radians(1.0), LOOSE_FORCE_M_S2)
    f.turns = turns
    level = math.radians(3.0)
    measurement = AttitudeMeasurement(
        "attitude", 0, 0.9999, (level, -level, math.nan), (0.01, 0.01, 1.0)
    )
    assert f.update(measurement).name == "fused"
    attitude = dcm_from_quaternion(f.nav[6:])
    assert math.degrees(rpy_from_dcm(attitude)[0]) > 2.5
    sensed = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
    assert abs(attitude[2] @ (sensed - f.xi[12:15]) + STANDARD_GRAVITY_M_S2) < 1e-3


@pytest.mark.parametrize("turns", [False, True])
def test_a_tilt_that_is_corrected_alone_leaves_the_biases(turns: bool) -> None:
    """As after samples that were lost: what had been learned of the biases was with another."""
    f = _straight_on(0.3, math.radians(1.0), KNOWN_SD)
    f.covariance[PHI : PHI + 2, PHI : PHI + 2] += 0.03**2 * np.eye(2)
    f.turns = turns
    level = math.radians(3.0)
    measurement = AttitudeMeasurement(
        "attitude", 0, 0.9999, (level, -level, math.nan), (0.01, 0.01, 1.0)
    )
    assert f.update(measurement).name == "fused"
    assert math.degrees(rpy_from_dcm(dcm_from_quaternion(f.nav[6:]))[0]) > 2.5
    assert np.abs(f.xi[12:15]).max() < 1e-3


def test_how_far_a_heading_was_turned() -> None:
    before = np.array(quaternion_from_rpy(0.1, -0.2, 3.0))
    for psi in (0.0, 1e-3, -0.4, 2.5):
        turned = dcm_from_rpy(0.0, 0.0, psi) @ dcm_from_quaternion(before)
        after = np.array(quaternion_from_rpy(*rpy_from_dcm(turned)))
        assert heading_turn(before, after) == pytest.approx(psi, abs=1e-12)
        assert heading_turn(before, -after) == pytest.approx(psi, abs=1e-12)
