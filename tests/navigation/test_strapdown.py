"""Strapdown integration against exact truth, coning and sculling motions; split intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j1

from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.navigation.earth import EARTH_RATE_RAD_S, gravity
from fusiond.navigation.rotation import dcm_from_quaternion, rotation_vector_from_dcm
from fusiond.navigation.strapdown import STEP_SIZE, strapdown_step
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Path, drive, flight
from tests import runs

Array = NDArray[np.float64]
RATE_HZ = 200.0
ZERO = np.zeros(3)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("path", "position_m", "velocity_m_s", "attitude_rad"),
    [
        # Measured: 2.2 mm, 1.6 um/s, 0.3 nrad; 0.6 mm, 3.2 um/s, 2.2 nrad.
        pytest.param(drive(600.0), 0.007, 5e-6, 2e-9, id="drive"),
        pytest.param(flight(600.0), 0.003, 1e-5, 1e-8, id="flight"),
    ],
)
def test_returns_to_the_truth(
    path: Path, position_m: float, velocity_m_s: float, attitude_rad: float
) -> None:
    truth = Truth(path, runs.ORIGIN, RATE_HZ, 600.0)
    imu = Imu(rate_hz=RATE_HZ)
    buffer = runs.filled_buffer(imu, runs.sample_times(truth), np.hstack([truth.gyro, truth.accel]))
    model = make_model("ins15", imu_noise(imu))
    estimator = KalmanEstimator(model, 1.0)
    start, end = runs.true_nav(truth, np.array([0.0, 600.0]))
    estimator.initialise(0, 0, start, np.zeros(model.size), np.zeros((model.size, model.size)))
    estimator.propagate(buffer, buffer.latest_ns)
    error = runs.nav_error(estimator.nav, end)
    phi, dv, dr = (float(np.linalg.norm(error[i : i + 3])) for i in (0, 3, 6))
    print(f"after 600 s: {dr:.2e} m, {dv:.2e} m/s, {phi:.2e} rad")
    assert dr < position_m
    assert dv < velocity_m_s
    assert phi < attitude_rad


def _mean_sin_cos(omega: float, t: Array, h: float) -> tuple[Array, Array]:
    """Means of sin(omega t) and cos(omega t) over the intervals of length h that end at t."""
    sine = (np.cos(omega * (t - h)) - np.cos(omega * t)) / (omega * h)
    cosine = (np.sin(omega * t) - np.sin(omega * (t - h))) / (omega * h)
    return sine, cosine


def _integrate(rate: Array, force: Array, h: float, slopes: bool, q0: Array) -> tuple[Array, Array]:
    """Attitude (3, 3) and the sum of C f h (3,); velocity and position are held at the start."""
    hold = np.array([*runs.ORIGIN, 0.0, 0.0, 0.0])
    nav = np.concatenate([hold, q0])
    step, total = np.zeros(STEP_SIZE), np.zeros(3)
    rate_slope = np.diff(rate, axis=0, prepend=rate[:1]) / h * slopes
    force_slope = np.diff(force, axis=0, prepend=force[:1]) / h * slopes
    for k in range(len(rate)):
        strapdown_step(nav, rate[k], force[k], rate_slope[k], force_slope[k], h, False, step)
        total += step[:3] * h
        nav[:6] = hold
    return dcm_from_quaternion(nav[6:]), total


def test_coning() -> None:
    """Body axes nutate on a cone of half-angle b at w (Savage 1998, part 1, section V).

    q = [cos b/2, sin b/2 cos wt, sin b/2 sin wt, 0] has the rate [-w sin b sin wt, w sin b cos wt,
    -2 w sin^2 b/2]. Means alone drift by (w sin b)^2 / 2w (1 - sin(wh)/wh) about z.
    """
    b, omega, h, seconds = math.radians(1.0), 2.0 * math.pi * 5.0, 0.01, 10.0
    t = h * np.arange(1.0, round(seconds / h) + 1)
    sine, cosine = _mean_sin_cos(omega, t, h)
    z = np.full_like(t, -2.0 * omega * math.sin(b / 2.0) ** 2)
    rate = np.column_stack([-omega * math.sin(b) * sine, omega * math.sin(b) * cosine, z])
    q0 = np.array([math.cos(b / 2.0), math.sin(b / 2.0), 0.0, 0.0])
    lat = runs.ORIGIN[0]
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)]) * seconds
    drifts = []
    for slopes in (False, True):
        dcm, _ = _integrate(rate, np.zeros_like(rate), h, slopes, q0)
        # Back at the starting phase; the navigation axes have turned with the Earth.
        turn = rotation_vector_from_dcm(dcm @ dcm_from_quaternion(q0).T) + earth
        drifts.append(float(np.linalg.norm(turn)) / seconds)
    theory = (omega * math.sin(b)) ** 2 / (2.0 * omega) * (1.0 - math.sin(omega * h) / (omega * h))
    print(
        f"coning drift: {drifts[0]:.3e} rad/s without, {drifts[1]:.3e} with; {theory:.3e} expected"
    )
    assert drifts[0] == pytest.approx(theory, rel=0.02)
    # Two-sample terms leave a part of the order of (wh)^2 = 0.1; measured 0.02.
    assert drifts[1] < 0.05 * drifts[0]


def test_sculling() -> None:
    """Roll by b sin wt while the force along y is A sin wt: rectified to A J1(b) along z."""
    b, a, omega, h, seconds = math.radians(1.0), 5.0, 2.0 * math.pi * 5.0, 0.01, 10.0
    t = h * np.arange(1.0, round(seconds / h) + 1)
    sine, cosine = _mean_sin_cos(omega, t, h)
    lat = runs.ORIGIN[0]
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    zero = np.zeros_like(t)
    rate = np.column_stack([b * omega * cosine, zero, zero]) + earth
    force = np.column_stack([zero, a * sine, zero])
    error = []
    for slopes in (False, True):
        _, total = _integrate(rate, force, h, slopes, LEVEL)
        error.append(abs(float(total[2]) / seconds - a * float(j1(b))))
    print(f"sculling error: {error[0]:.3e} m/s^2 without, {error[1]:.3e} with two-sample terms")
    assert error[0] > 5e-4
    assert error[1] < 0.05 * error[0]


def test_free_fall_and_rest() -> None:
    """At rest on the ellipsoid nothing moves; without force it falls by g t^2 / 2."""
    lat, _, height = runs.ORIGIN
    g = gravity(lat, height)
    earth = EARTH_RATE_RAD_S * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    step = np.zeros(STEP_SIZE)
    nav = np.array([*runs.ORIGIN, 0.0, 0.0, 0.0, *LEVEL])
    for _ in range(1000):
        strapdown_step(nav, earth, np.array([0.0, 0.0, -g]), ZERO, ZERO, 0.01, False, step)
    error = runs.nav_error(nav, np.array([*runs.ORIGIN, 0.0, 0.0, 0.0, *LEVEL]))
    assert np.abs(error).max() < 1e-6  # leveling torque w_ie^2 R: what rounding leaves
    for _ in range(100):
        strapdown_step(nav, earth, ZERO, ZERO, ZERO, 0.01, False, step)
    assert nav[5] == pytest.approx(g, rel=1e-5)
    assert height - nav[2] == pytest.approx(g / 2.0, rel=1e-5)


def test_height_is_held_in_a_planar_model() -> None:
    nav = np.array([*runs.ORIGIN, 10.0, -5.0, 0.0, *LEVEL])
    step = np.zeros(STEP_SIZE)
    for _ in range(100):
        strapdown_step(nav, ZERO, np.array([1.0, 0.0, -9.0]), ZERO, ZERO, 0.01, True, step)
    assert nav[2] == runs.ORIGIN[2]
    assert nav[5] == 0.0
    assert nav[3] == pytest.approx(11.0, abs=0.01)


@pytest.mark.parametrize("at", [0.1, 0.37, 0.5, 0.9])
def test_a_split_interval_differs_in_third_order_only(at: float) -> None:
    """The parts share the whole's mean, so a split loses up to h^3/12 of (w x wd, w x fd + f x wd)
    and moves the velocity inside the interval by h^2/8 fd, the position by h^3/12 fd."""
    rng = np.random.default_rng(3)
    rate, force = np.array([0.4, -0.3, 0.6]), np.array([1.0, -2.0, -9.5])
    rate_slope, force_slope = rng.standard_normal(3) * 2.0, rng.standard_normal(3) * 20.0
    start = runs.level_nav((0.1, -0.2, 1.0), (15.0, 5.0, 0.5))
    step = np.zeros(STEP_SIZE)
    differences = []
    for h in (0.02, 0.01, 0.005):
        whole, parts = start.copy(), start.copy()
        strapdown_step(whole, rate, force, rate_slope, force_slope, h, False, step)
        strapdown_step(parts, rate, force, rate_slope, force_slope, at * h, False, step)
        strapdown_step(parts, rate, force, rate_slope, force_slope, (1 - at) * h, False, step)
        d = runs.nav_error(parts, whole)
        attitude = np.linalg.norm(np.cross(rate, rate_slope)) / 12.0 * h**3
        product = np.cross(rate, force_slope) + np.cross(force, rate_slope)
        # and the rotation term 1/2 (w h) x (f h) once per part instead of once: (w h)^2 f h / 6
        turning = float(rate @ rate) * np.linalg.norm(force) / 6.0
        assert np.linalg.norm(d[:3]) < attitude * 1.01 + 1e-12
        assert np.linalg.norm(d[3:6]) < (np.linalg.norm(product) / 12.0 + turning) * h**3 * 1.5
        assert np.linalg.norm(d[6:9]) < 0.5 * h**3 * np.linalg.norm(force) + 1e-8
        differences.append(np.linalg.norm(d[3:6]))
    assert differences[0] / differences[1] == pytest.approx(8.0, rel=0.1)
    assert differences[1] / differences[2] == pytest.approx(8.0, rel=0.1)
