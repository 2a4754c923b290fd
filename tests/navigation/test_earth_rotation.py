"""Earth and rotations against published figures and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusiond.navigation import earth
from fusiond.navigation.rotation import (
    dcm_from_quaternion,
    dcm_from_rpy,
    quaternion_from_rpy,
    rotate_quaternion,
    rotation_vector_from_dcm,
    rotation_vector_to_quaternion,
    rpy_from_dcm,
    rpy_from_quaternion,
    skew,
    wrap_angle,
)

Array = NDArray[np.float64]
ANGLE = st.floats(-math.pi, math.pi)
PITCH = st.floats(-1.55, 1.55)


@pytest.mark.parametrize(
    ("lat_deg", "gravity_m_s2"),
    [
        # NGA.STND.0036, table 3.6: equator and pole; 45 deg: GRS 80 has 9.806199.
        (0.0, 9.7803253359),
        (90.0, 9.8321849378),
        (45.0, 9.8061977),
    ],
)
def test_normal_gravity_on_the_ellipsoid(lat_deg: float, gravity_m_s2: float) -> None:
    assert earth.gravity(math.radians(lat_deg), 0.0) == pytest.approx(gravity_m_s2, abs=2e-7)
    assert earth.gravity(math.radians(-lat_deg), 0.0) == earth.gravity(math.radians(lat_deg), 0.0)


def _gravity_of_the_ellipsoid(lat: float, height: float) -> float:
    """Magnitude of normal gravity in closed form, by ellipsoidal coordinates.

    NGA.STND.0036 equations 4-5 to 4-14 (Heiskanen and Moritz 1967, section 2-8).
    """
    a, f, omega, gm = 6378137.0, 1.0 / 298.257223563, 7.292115e-5, 3.986004418e14
    b = a * (1.0 - f)
    e = math.sqrt(a * a - b * b)
    n = a / math.sqrt(1.0 - f * (2.0 - f) * math.sin(lat) ** 2)
    p = (n + height) * math.cos(lat)
    z = (n * (b / a) ** 2 + height) * math.sin(lat)
    r2 = p * p + z * z - e * e
    u = math.sqrt(0.5 * r2 * (1.0 + math.sqrt(1.0 + 4.0 * e * e * z * z / (r2 * r2))))
    beta = math.atan2(z * math.hypot(u, e), u * p)
    w = math.sqrt((u * u + (e * math.sin(beta)) ** 2) / (u * u + e * e))
    q = 0.5 * ((1.0 + 3.0 * u * u / (e * e)) * math.atan(e / u) - 3.0 * u / e)
    q0 = 0.5 * ((1.0 + 3.0 * b * b / (e * e)) * math.atan(e / b) - 3.0 * b / e)
    q1 = 3.0 * (1.0 + u * u / (e * e)) * (1.0 - u / e * math.atan(e / u)) - 1.0
    s2 = math.sin(beta) ** 2
    common = omega * omega * a * a / (u * u + e * e)
    along = -(gm / (u * u + e * e) + common * e * q1 / q0 * (0.5 * s2 - 1.0 / 6.0)) / w
    along += omega * omega * u * math.cos(beta) ** 2 / w
    across = common * math.sqrt(u * u + e * e) * q / q0 - omega * omega * math.sqrt(u * u + e * e)
    across *= math.sin(beta) * math.cos(beta) / w
    return math.hypot(along, across)


@pytest.mark.parametrize("lat_deg", [0.0, 20.0, 45.0, 70.0, 90.0])
@pytest.mark.parametrize("height", [-100.0, 0.0, 1000.0, 12000.0])
def test_gravity_with_height_against_the_closed_form(lat_deg: float, height: float) -> None:
    """The series of second order in h / a: below 1.2e-10 a metre (1.4 um/s^2 at 12 km)."""
    lat = math.radians(lat_deg)
    assert earth.gravity(lat, height) == pytest.approx(
        _gravity_of_the_ellipsoid(lat, height), abs=1e-9 + 1.2e-10 * abs(height)
    )


def test_radii_of_curvature() -> None:
    """At the equator b^2/a and a; at the pole both a^2/b (NGA.STND.0036, table 3.3)."""
    a, b = 6378137.0, 6356752.3142
    assert earth.meridian_radius(0.0) == pytest.approx(b * b / a, abs=1e-3)
    assert earth.transverse_radius(0.0) == a
    assert earth.meridian_radius(math.pi / 2) == pytest.approx(6399593.6258, abs=1e-3)
    assert earth.transverse_radius(math.pi / 2) == pytest.approx(6399593.6258, abs=1e-3)


@given(st.floats(-1.5, 1.5))
def test_meridian_radius_is_the_arc_of_the_ellipse(lat: float) -> None:
    """Distance between two points of the meridian over the latitude between them."""
    a, e2 = 6378137.0, earth.ECCENTRICITY_SQUARED

    def point(x: float) -> Array:
        n = a / math.sqrt(1.0 - e2 * math.sin(x) ** 2)
        return np.array([n * math.cos(x), n * (1.0 - e2) * math.sin(x)])

    d = 1e-4
    chord = float(np.linalg.norm(point(lat + d) - point(lat - d)))
    assert chord / (2.0 * d) == pytest.approx(earth.meridian_radius(lat), rel=1e-8)


@given(ANGLE, PITCH, ANGLE)
def test_roll_pitch_yaw_against_scipy(roll: float, pitch: float, yaw: float) -> None:
    reference = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    dcm = dcm_from_rpy(roll, pitch, yaw)
    assert dcm == pytest.approx(reference.as_matrix(), abs=1e-14)
    q = quaternion_from_rpy(roll, pitch, yaw)
    scalar_last = reference.as_quat()
    assert abs(float(q @ scalar_last[[3, 0, 1, 2]])) == pytest.approx(1.0, abs=1e-14)
    assert dcm_from_quaternion(q) == pytest.approx(dcm, abs=1e-15)
    back = rpy_from_dcm(dcm)
    assert dcm_from_rpy(*back) == pytest.approx(dcm, abs=1e-12)
    assert back[1] == pytest.approx(pitch, abs=1e-12)
    assert wrap_angle(back[2] - yaw) == pytest.approx(0.0, abs=1e-12)


VECTOR = st.tuples(st.floats(-1.7, 1.7), st.floats(-1.7, 1.7), st.floats(-1.7, 1.7))


def test_roll_pitch_yaw_of_quaternions_are_those_of_their_matrices() -> None:
    q = np.ascontiguousarray(Rotation.random(200, random_state=7).as_quat()[:, [3, 0, 1, 2]])
    q[0] = quaternion_from_rpy(0.0, 0.5 * math.pi, 0.3)
    q[1] = math.nan
    rpy = np.array([rpy_from_quaternion(w, x, y, z) for w, x, y, z in q.tolist()])
    assert rpy[0, 1] == pytest.approx(0.5 * math.pi, abs=1e-7)
    assert np.isnan(rpy[1]).all()
    each = [rpy_from_dcm(dcm_from_quaternion(row)) for row in q[2:]]
    assert rpy[2:] == pytest.approx(np.array(each), abs=1e-9)


@given(VECTOR, st.sampled_from([1.0, 1e-3, 0.9e-3, 1e-6, 0.0]))
def test_rotation_vectors_against_scipy(v: tuple[float, float, float], scale: float) -> None:
    vector = np.array(v) * scale
    reference = Rotation.from_rotvec(vector)
    q = np.array(rotation_vector_to_quaternion(*(float(x) for x in vector)))
    assert dcm_from_quaternion(q) == pytest.approx(reference.as_matrix(), abs=1e-14)
    assert rotation_vector_from_dcm(reference.as_matrix()) == pytest.approx(vector, abs=1e-8)
    assert math.hypot(*q) == pytest.approx(1.0, abs=1e-15)


@given(VECTOR, VECTOR)
def test_rotating_a_quaternion_left_and_right(
    v: tuple[float, float, float], w: tuple[float, float, float]
) -> None:
    base = Rotation.from_rotvec(v)
    start = base.as_quat()[[3, 0, 1, 2]]
    for on_the_left, expected in (
        (True, Rotation.from_rotvec(w) * base),
        (False, base * Rotation.from_rotvec(w)),
    ):
        q = start.copy()
        rotate_quaternion(q, *w, on_the_left)
        assert dcm_from_quaternion(q) == pytest.approx(expected.as_matrix(), abs=1e-14)


@given(VECTOR, VECTOR)
def test_skew_is_the_cross_product(
    v: tuple[float, float, float], w: tuple[float, float, float]
) -> None:
    assert skew(np.array(v)) @ w == pytest.approx(np.cross(v, w), abs=1e-15)


@given(st.floats(-100.0, 100.0))
def test_wrapped_angle(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


def test_quaternion_stays_a_unit_one_over_a_million_turns() -> None:
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(100_000):
        rotate_quaternion(q, 0.01, -0.02, 0.03, k % 2 == 0)
    assert float(q @ q) == pytest.approx(1.0, abs=1e-15)
