"""Trajectories and IMU truth against an independent integrator of the strapdown equations."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import (
    Leg,
    Path,
    Profile,
    dcm_from_rpy,
    drive,
    flight,
    follow,
    static,
)

Array = NDArray[np.float64]
ORIGIN = (math.radians(30.5), math.radians(114.3), 40.0)
RATE_HZ = 200.0
ARM = (1.0, 0.2, -0.5)


@numba.njit(cache=True)
def _derivative(x, w, f, out):  # type: ignore[no-untyped-def]
    """Rates of x = [C_nb by rows, v_ned, lat, lon, h]: the textbook equations, written out anew.

    Element by element: numba takes 10 s to compile the same with matrix products.
    """
    a, b, omega = 6378137.0, 6356752.314245179, 7.292115e-5
    e2 = 1.0 - b * b / (a * a)
    v_n, v_e, v_d, lat, h = x[9], x[10], x[11], x[12], x[14]
    s = math.sin(lat)
    rn = a / math.sqrt(1 - e2 * s * s)
    rm = rn * (1 - e2) / (1 - e2 * s * s)
    wie_n, wie_d = omega * math.cos(lat), -omega * s
    wen_n, wen_e, wen_d = v_e / (rn + h), -v_n / (rm + h), -v_e * math.tan(lat) / (rn + h)
    k = b * 9.8321849378 / (a * 9.7803253359) - 1.0
    m = omega**2 * a**2 * b / 3.986004418e14
    fl = (a - b) / a
    g0 = 9.7803253359 * (1 + k * s * s) / math.sqrt(1 - e2 * s * s)
    g = g0 * (1 - 2 * h / a * (1 + fl + m - 2 * fl * s * s) + 3 * h * h / (a * a))
    n, e, d = wie_n + wen_n, wen_e, wie_d + wen_d
    # dC/dt = C [w x] - [w_in x] C: rows of C cross w, less w_in cross columns of C.
    for i in range(0, 9, 3):
        out[i] = x[i + 1] * w[2] - x[i + 2] * w[1]
        out[i + 1] = x[i + 2] * w[0] - x[i] * w[2]
        out[i + 2] = x[i] * w[1] - x[i + 1] * w[0]
    for j in range(3):
        out[j] -= e * x[6 + j] - d * x[3 + j]
        out[3 + j] -= d * x[j] - n * x[6 + j]
        out[6 + j] -= n * x[3 + j] - e * x[j]
    # dv/dt = C f - (2 w_ie + w_en) x v + g
    n, d = n + wie_n, d + wie_d
    for i in range(3):
        out[9 + i] = x[3 * i] * f[0] + x[3 * i + 1] * f[1] + x[3 * i + 2] * f[2]
    out[9] -= e * v_d - d * v_e
    out[10] -= d * v_n - n * v_d
    out[11] += g - (n * v_e - e * v_n)
    out[12], out[13] = v_n / (rm + h), v_e / ((rn + h) * math.cos(lat))
    out[14] = -v_d


@numba.njit(cache=True)
def _reference(x, gyro, accel, dt):  # type: ignore[no-untyped-def]
    """Runge-Kutta 4, one step an interval, of parabolas whose means are three samples."""
    ws = np.empty((3, 3))
    fs = np.empty((3, 3))
    rate = np.empty(15)
    moved = np.empty(15)
    total = np.empty(15)
    for k in range(gyro.shape[0]):
        m = min(max(k, 1), gyro.shape[0] - 2)
        for i in range(3):
            u = (k - m) - 0.5 + 0.5 * i  # in intervals from the middle sample's centre
            for table, out in ((gyro, ws), (accel, fs)):
                for axis in range(3):
                    before, middle, after = (
                        table[m - 1, axis],
                        table[m, axis],
                        table[m + 1, axis],
                    )
                    second = before - 2.0 * middle + after
                    slope = 0.5 * (after - before)
                    out[i, axis] = middle - second / 24.0 + slope * u + 0.5 * second * u * u
        total[:] = 0.0
        for stage in range(4):
            at = (stage + 1) // 2  # start, middle, middle, end
            for i in range(15):
                moved[i] = x[i] + (0.5 * at * dt * rate[i] if stage else 0.0)
            _derivative(moved, ws[at], fs[at], rate)
            for i in range(15):
                total[i] += rate[i] if stage in (0, 3) else 2.0 * rate[i]
        for i in range(15):
            x[i] += dt / 6.0 * total[i]
    return x


def _closing_error(path: Path, seconds: float) -> tuple[float, float, float]:
    """Position (m), velocity (m/s) and attitude (rad) error of the reference integration."""
    truth = Truth(path, ORIGIN, RATE_HZ, seconds)
    ends = truth.at(np.array([0.0, seconds]))
    start = np.concatenate((dcm_from_rpy(ends.rpy)[0].ravel(), ends.v_ned[0], ends.position[0]))
    x = _reference(start, truth.gyro, truth.accel, 1.0 / RATE_HZ)
    d = x[12:15] - truth.position[-1]
    metres = np.array([d[0] * 6.36e6, d[1] * 6.38e6 * math.cos(x[12]), d[2]])
    turn = x[:9].reshape(3, 3) @ dcm_from_rpy(ends.rpy)[1].T
    angle = np.linalg.norm(turn - turn.T) / math.sqrt(8.0)
    return (
        float(np.linalg.norm(metres)),
        float(np.linalg.norm(x[9:12] - ends.v_ned[1])),
        float(angle),
    )


@pytest.mark.parametrize(
    ("path", "seconds"),
    [
        (static(60.0), 60.0),
        (drive(600.0), 600.0),
        (replace(drive(600.0), arm_m=ARM), 600.0),
        (flight(600.0), 600.0),
    ],
)
def test_integrated_truth_returns_to_the_trajectory(path: Path, seconds: float) -> None:
    """Measured: 0.3 um (drive) and 0.2 nm (flight) after 600 s at 200 Hz."""
    position, velocity, attitude = _closing_error(path, seconds)
    print(f"after {seconds} s: {position:.2e} m, {velocity:.2e} m/s, {attitude:.2e} rad")
    assert position < 1e-5
    assert velocity < 1e-7
    assert attitude < 1e-10


def test_a_wrong_gyro_would_be_noticed() -> None:
    """The closing error does react: one earth rate less about the vertical turns the attitude."""
    truth = Truth(static(60.0), ORIGIN, RATE_HZ, 60.0)
    ends = truth.at(np.array([0.0, 60.0]))
    start = np.concatenate((dcm_from_rpy(ends.rpy)[0].ravel(), ends.v_ned[0], ends.position[0]))
    x = _reference(start, truth.gyro * 0.999, truth.accel, 1.0 / RATE_HZ)
    turn = x[:9].reshape(3, 3) @ dcm_from_rpy(ends.rpy)[1].T
    assert np.linalg.norm(turn - turn.T) / math.sqrt(8.0) > 1e-6


def test_profile_is_twice_continuous_and_constant_between_equal_knots() -> None:
    profile = Profile([0.0, 2.0, 5.0, 9.0], [1.0, 1.0, 4.0, -2.0])
    t = np.linspace(-1.0, 10.0, 11_001)
    value, first, second, third = profile(t)
    assert np.max(np.abs(np.diff(second))) < 0.05
    np.testing.assert_allclose(np.gradient(value, t)[1:-1], first[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(first, t)[1:-1], second[1:-1], atol=1e-2)
    away = np.min(np.abs(t[:, None] - [0.0, 2.0, 5.0, 9.0]), axis=1) > 2e-3
    np.testing.assert_allclose(np.gradient(second, t)[away], third[away], atol=1e-2)
    still = (t >= 0.0) & (t <= 2.0)
    assert np.all(value[still] == 1.0)
    assert np.all(first[still] == 0.0)
    with pytest.raises(ValueError, match="increasing"):
        Profile([0.0, 0.0], [1.0, 2.0])


def test_stops_of_the_drive_are_real_standstill() -> None:
    truth = Truth(drive(400.0), ORIGIN, 100.0, 400.0)
    at_rest = np.linalg.norm(truth.at(truth.t_s).v_ned, axis=1) == 0.0
    assert at_rest[: 60 * 100].all()
    assert 0.1 < at_rest.mean() < 0.5
    both = at_rest[:-1] & at_rest[1:]
    moved = np.abs(np.diff(truth.position, axis=0)[both])
    assert moved.max() == 0.0
    earth_rate = np.linalg.norm(truth.gyro[both], axis=1)
    np.testing.assert_allclose(earth_rate, 7.292115e-5, rtol=1e-9)


def test_car_does_not_slip_and_stays_drivable() -> None:
    truth = Truth(replace(drive(1560.0), arm_m=ARM), ORIGIN, 100.0, 1560.0)
    axle = (-ARM[0], -ARM[1], -ARM[2])
    states = truth.at(truth.t_s, axle)
    v_body = np.einsum("nji,nj->ni", dcm_from_rpy(states.rpy), states.v_ned)
    assert np.abs(v_body[:, 1:]).max() < 1e-12
    imu_states = truth.at(truth.t_s)
    imu_body = np.einsum("nji,nj->ni", dcm_from_rpy(imu_states.rpy), imu_states.v_ned)
    assert np.abs(imu_body[:, 1]).max() > 0.2
    assert np.abs(truth.accel[:, :2]).max() < 5.0
    assert np.ptp(states.position[:, 2]) < 60.0
    assert 20.0 < v_body[:, 0].max() < 30.0


def test_tyres_slip_outwards_as_far_as_they_are_pushed() -> None:
    """And the body turns and feels as its attitude and velocity have it, forward and back."""
    slip = math.radians(0.5)
    ahead = Leg(5), Leg(6, 12.0), Leg(8, turn_deg=70.0), Leg(8, 0.0)
    path = follow([*ahead, Leg(4, -2.0), Leg(6, turn_deg=30.0)], 37.0, bank_ratio=-0.08)
    path = replace(path, arm_m=ARM, slip_rad_s2_m=slip)
    truth = Truth(path, ORIGIN, RATE_HZ, 37.0)
    states = truth.at(truth.t_s, (-ARM[0], -ARM[1], -ARM[2]))
    forward, right = np.einsum("nji,nj->ni", dcm_from_rpy(states.rpy), states.v_ned)[:, :2].T
    speed, course = path.speed(truth.t_s)[0], path.course(truth.t_s)[1]
    pushed = speed * course
    assert pushed.max() > 1.5
    assert speed.min() < -1.9
    np.testing.assert_allclose(np.arctan2(right, np.abs(forward)), -slip * pushed, atol=3e-4)
    position, velocity, attitude = _closing_error(path, 37.0)
    assert position < 1e-5
    assert velocity < 1e-7
    assert attitude < 1e-9


def test_flight_reaches_cruise_and_banks_into_turns() -> None:
    truth = Truth(flight(4000.0), ORIGIN, 50.0, 4000.0)
    states = truth.at(truth.t_s)
    assert np.linalg.norm(states.v_ned, axis=1).max() == pytest.approx(300.0)
    assert 9_000.0 < states.position[:, 2].max() < 13_000.0
    assert 15.0 < np.degrees(np.abs(states.rpy[:, 0]).max()) < 35.0
    # Coordinated turns: the specific force has next to no sideways part.
    assert np.abs(truth.accel[:, 1]).max() < 0.2


def test_truth_between_samples_agrees_with_a_finer_sampling() -> None:
    path = flight(300.0)
    coarse = Truth(path, ORIGIN, 50.0, 300.0)
    fine = Truth(path, ORIGIN, 400.0, 300.0)
    between = coarse.at(fine.t_s)
    np.testing.assert_allclose(between.position[:, :2], fine.position[:, :2], atol=1e-14)
    np.testing.assert_allclose(between.position[:, 2], fine.position[:, 2], atol=1e-7)


def test_lever_arm_moves_with_the_body() -> None:
    path = follow([Leg(10, speed_m_s=10.0), Leg(10, turn_deg=90.0)], 20.0)
    truth = Truth(path, ORIGIN, 100.0, 20.0)
    t = np.arange(1.0, 19.0, 0.01)
    centre, front = truth.at(t), truth.at(t, (2.0, 0.0, -1.0))
    north = (front.position[:, 0] - centre.position[:, 0]) * 6.353e6
    np.testing.assert_allclose(north, 2.0 * np.cos(centre.rpy[:, 2]), atol=2e-3)
    np.testing.assert_allclose(front.position[:, 2] - centre.position[:, 2], 1.0, atol=1e-9)
    swing = front.v_ned[:, 1] - centre.v_ned[:, 1]
    expected = np.gradient(2.0 * np.sin(centre.rpy[:, 2]), t)
    np.testing.assert_allclose(swing[1:-1], expected[1:-1], atol=1e-4)
