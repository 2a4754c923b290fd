"""Unscented filter: sigma points through the strapdown equations, and the filter as a whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import SPREAD, UnscentedEstimator
from fusiond.estimators.unscented.propagation import error_of
from fusiond.estimators.update import feed_back
from fusiond.models.blocks import clock_blocks
from fusiond.models.catalogue import make_model
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.strapdown import STEP_SIZE, strapdown_step
from fusiond.navigator.timeline import Timeline
from tests import runs
from tests.estimators.covariances import random_covariance
from tests.estimators.monte_carlo import interval
from tests.estimators.side_by_side import (
    GATE,
    IMU,
    LEVER,
    MODELS,
    NO_LEVER,
    compare,
    linear_measurements,
    pair_of,
)
from tests.navigator import vehicle

Array = NDArray[np.float64]


def _buffer(seconds: float) -> tuple[NDArray[np.int64], Array]:
    truth = runs.town_truth(seconds, IMU.rate_hz)
    return runs.sample_times(truth), runs.imu_run(IMU, truth, 3).samples


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("holding", [False, True])
def test_propagation_as_the_extended_filter_while_errors_are_small(
    name: str, holding: bool
) -> None:
    """A hundredth of usual errors (0.2 mrad): of a force of g the attitude's second order is 4e-7
    m/s^2, which the extended filter does not see: a hundredth of a sigma of the velocity."""
    times, samples = _buffer(20.0)
    extended, unscented = pair_of(name, 0.01, propagation=True)
    xi = np.zeros(extended.model.size)
    for f in (extended, unscented):
        f.initialise(0, 0, f.nav.copy(), xi, f.covariance.copy())
        if holding:
            f.hold()
            f.update(linear_measurements(not f.model.hold_height)[1])
        f.propagate(runs.filled_buffer(IMU, times, samples), int(times[-1]) - 7_000_000)
        assert f.t_ns == int(times[-1]) - 7_000_000
    if holding:
        assert np.abs(extended._dxs).max() > 0.0
        extended.release()
        unscented.release()
    assert np.array_equal(unscented.covariance, unscented.covariance.T)
    compare(extended, unscented, 1e-2, 1e-3)


def test_propagation_against_points_of_the_whole_state() -> None:
    """One interval with 10 deg of attitude error: all 2 n + 1 points through the strapdown
    equations, weighted sums. What the kernel takes to be linear leaves 1e-5 of a sigma."""
    times, samples = _buffer(2.0)
    _, u = pair_of("ins21", propagation=True)
    model, n = u.model, u.model.size
    h = 0.02
    wide = np.r_[np.full(3, 8.0), np.ones(n - 3)]
    p, nav0, xi0 = wide[:, None] * u.covariance * wide, u.nav.copy(), u.xi.copy()
    u.initialise(0, 0, nav0, xi0, p)
    white = model.noise[1]
    p[range(9), range(9)] += 0.5 * h * white[:9]
    root = np.linalg.cholesky(p)
    zero, unused = np.zeros(3), np.zeros(STEP_SIZE)

    def crossed(error: Array) -> Array:
        nav, xi = nav0.copy(), xi0.copy()
        feed_back(nav, xi, error)
        sensor = np.zeros(12)
        slot, kind = model.sensor_terms
        for k in range(12):
            if kind[k]:
                sensor[k // 2 + (6 if kind[k] == 2 else 0)] += xi[slot[k]]
        taken = (samples[0] - sensor[:6]) / (1.0 + sensor[6:])
        strapdown_step(nav, taken[:3].copy(), taken[3:].copy(), zero, zero, h, False, unused)
        return nav

    centre = crossed(np.zeros(n))
    lat, height = float(centre[0]), float(centre[2])
    scale = np.array(
        [meridian_radius(lat) + height, (transverse_radius(lat) + height) * math.cos(lat)]
    )
    ends, weights = [], [1.0 - n / 3.0, *[1.0 / 6.0] * (2 * n)]
    for error in np.array([np.zeros(n), *(SPREAD * root.T), *(-SPREAD * root.T)]):
        end = error.copy()
        error_of(centre, crossed(error), scale, end[:9])
        ends.append(end)
    points, w = np.array(ends), np.array(weights)
    mean = w @ points
    expected = ((points - mean).T * w) @ (points - mean) + np.outer(mean, mean)
    expected[range(9), range(9)] += 0.5 * h * white[:9]
    expected[range(9, n), range(9, n)] += h * white[9:]
    u.propagate(runs.filled_buffer(IMU, times[:1], samples[:1]), int(times[0]))
    sd = np.sqrt(np.diag(expected))
    assert np.abs((u.covariance - expected) / np.outer(sd, sd)).max() < 1e-5
    feed_back(centre, xi0, mean)
    gap = runs.nav_error(u.nav, centre)
    # The mean's own shift, to a thousandth: gravity along a force that is 10 deg off.
    assert np.abs(mean[3:6]).max() > 1e-3
    assert gap[3:6] == pytest.approx(np.zeros(3), abs=1e-3 * np.abs(mean[3:6]).max())


def test_splitting_a_propagation_changes_no_bit() -> None:
    times, samples = _buffer(4.0)
    ends = []
    for stops in ([int(times[-1])], [int(t) for t in times]):
        _, u = pair_of("ins23", propagation=True)
        buffer = runs.filled_buffer(IMU, times, samples)
        for stop in stops:
            u.propagate(buffer, stop, record=True)
        ends.append((u.nav.copy(), u.covariance.copy(), u.xi.copy(), buffer.sigmas.copy()))
        assert np.isfinite(buffer.nav[: len(times)]).all()
    for a, b in zip(*ends, strict=True):
        assert np.array_equal(a, b, equal_nan=True)


def test_an_imu_silence_widens_as_in_the_extended_filter() -> None:
    times, samples = _buffer(3.0)
    times = np.r_[times[:50], times[50:] + 2_000_000_000]
    extended, unscented = pair_of("ins15", 0.01, propagation=True)
    for f in (extended, unscented):
        f.propagate(runs.filled_buffer(IMU, times, samples), int(times[50]))
    assert unscented.sigmas()[0] > 1.0
    compare(extended, unscented, 1e-2, 1e-3)


def test_clock_states_follow_their_rate() -> None:
    times, samples = _buffer(3.0)
    model = make_model("ins21", imu_noise(IMU), *clock_blocks(("C", "G", "E", "R", "J")))
    assert model.width == 32  # the widest rows that the kernels have
    p = np.diag(runs.initial_sd(model, np.full(3, 1e-4), 0.01, 0.1) ** 2)
    xi = np.zeros(model.size)
    xi[model.slots_of("clock_drift")] = 5.0
    pair = (
        KalmanEstimator(model, IMU.gap_s),
        UnscentedEstimator(model, IMU.gap_s, propagation=True),
    )
    for f in pair:
        f.initialise(0, 0, runs.level_nav((0.0, 0.0, 0.8), (1.0, 2.0, 0.0)), xi, p)
        f.propagate(runs.filled_buffer(IMU, times, samples), int(times[-1]))
    assert pair[1].xi[model.slots_of("clock_offset")] == pytest.approx(5.0 * times[-1] * 1e-9)
    compare(*pair, 1e-2, 1e-3)


# ------------------------------------------------------------------------------ whole filters


@pytest.mark.parametrize("propagation", [False, True])
def test_a_rewind_gives_the_bits_of_arrival_in_order(propagation: bool) -> None:
    times, samples = _buffer(12.0)
    truth = runs.town_truth(12.0, IMU.rate_hz)
    navs = runs.true_nav(truth, np.arange(1.0, 12.0))
    measurements = [
        PositionMeasurement(
            "gnss",
            k * runs.SECOND - 3_000_000,
            GATE,
            float(nav[0]),
            float(nav[1]),
            float(nav[2]),
            (2.0, 2.0, 2.0),
            LEVER,
        )
        for k, nav in enumerate(navs, 1)
    ]
    ends = []
    for late in (False, True):
        model = make_model("ins21", imu_noise(IMU))
        u = UnscentedEstimator(model, IMU.gap_s, propagation=propagation)
        sd = runs.initial_sd(model, np.radians([0.5, 0.5, 5.0]), 0.2, 3.0)
        nav = runs.true_nav(truth, np.array([0.0]))[0]
        u.initialise(0, 0, nav, np.zeros(model.size), np.diag(sd**2))
        timeline = Timeline(u, runs.filled_buffer(IMU, times, samples), 15.0, 0.5)
        timeline.start()
        for measurement in measurements[:5] + measurements[6:] if late else measurements:
            timeline.insert(measurement)
        timeline.advance()
        if late:
            timeline.insert(measurements[5])
            timeline.advance()
            assert timeline.counters.rewinds == 1
        assert timeline.counters.outcomes["gnss"]["fused"] >= len(measurements)
        ends.append((u.nav.copy(), u.covariance.copy(), u.xi.copy()))
    for a, b in zip(*ends, strict=True):
        assert np.array_equal(a, b)


def test_the_covariance_turns_with_the_attitude() -> None:
    """True attitudes drawn about the computed one: what they are off by after a correction of half
    a radian has the turned covariance (to the third order of their own 2 mrad)."""
    model = make_model("ins15", imu_noise(IMU))
    u = UnscentedEstimator(model, IMU.gap_s, propagation=True)
    p = random_covariance(np.random.default_rng(5), model)
    p[:3] *= 0.1
    p[:, :3] *= 0.1
    nav = runs.level_nav((0.1, -0.2, 0.7), (3.0, 0.0, 0.0))
    u.initialise(0, 0, nav, np.zeros(model.size), p)
    u.hold()
    u._dxs[0, :3] = [0.2, -0.3, 0.35]
    u.release()
    turned = np.zeros((3, 3))
    for column, sign in ((k, s) for k in range(3) for s in (1.0, -1.0)):
        error = np.zeros(9)
        error[:3] = [0.2, -0.3, 0.35]
        error[column] += sign * 1e-5
        true, zero = nav.copy(), np.zeros(9)
        feed_back(true, zero, error)
        turned[:, column] += runs.nav_error(u.nav, true)[:3] * sign / 2e-5
    assert u.covariance[:3, :3] == pytest.approx(turned @ p[:3, :3] @ turned.T, rel=1e-6)
    assert u.covariance[:3, 3:] == pytest.approx(turned @ p[:3, 3:], rel=1e-5, abs=1e-12)
    assert u.covariance[3:, 3:] == pytest.approx(p[3:, 3:], rel=1e-12)
    assert np.array_equal(u.covariance, u.covariance.T)
    assert np.abs(turned - np.eye(3)).max() > 0.1


def _nees(unscented: bool, count: int, heading_deg: float) -> float:
    """Mean NEES of attitude, velocity and position 60 s after a start with a poor heading, GNSS
    positions of 2 m every second."""
    imu = Imu(rate_hz=20.0, gyro_scale_ppm=1e-6, accel_scale_ppm=1e-6)
    truth = runs.town_truth(60.0, imu.rate_hz)
    times = runs.sample_times(truth)
    model = make_model("ins15", imu_noise(imu))
    f: KalmanEstimator = KalmanEstimator(model, imu.gap_s)
    if unscented:
        f = UnscentedEstimator(model, imu.gap_s, propagation=True)
    fixes_s = np.arange(1.0, 60.0)
    true_at = runs.true_nav(truth, np.r_[0.0, fixes_s])
    sd = runs.initial_sd(model, np.radians([2.0, 2.0, heading_deg]), 0.5, 5.0)
    total = 0.0
    for k in range(count):
        rng = np.random.default_rng([500 + k, 7])
        buffer = runs.filled_buffer(imu, times, runs.imu_run(imu, truth, 500 + k).samples)
        start = runs.with_error(true_at[0], rng.standard_normal(9) * sd[:9])
        f.initialise(0, 0, start, np.zeros(model.size), np.diag(sd**2))
        for t_s, nav in zip(fixes_s, true_at[1:], strict=True):
            scale = runs.metres_per_unit(float(nav[0]), float(nav[2]))
            lat, lon, up = (float(x) for x in nav[:3] + 2.0 * rng.standard_normal(3) / scale)
            measurement = PositionMeasurement(
                "gnss", round(t_s * 1e9), GATE, lat, lon, up, (2.0,) * 3, NO_LEVER
            )
            f.propagate(buffer, measurement.t_ns)
            f.update(measurement)
        error = runs.nav_error(f.nav, true_at[-1])
        total += float(error @ np.linalg.solve(f.covariance[:9, :9], error))
    return total / count


RUNS = 150
"""A sigma that is 9 % off is noticed with 90 % probability."""
POOR_RUNS = 300


@pytest.mark.parametrize("heading_deg", [3.0, 5.0])
def test_stated_sigma_is_honest(heading_deg: float) -> None:
    low, high = (x / RUNS for x in interval(RUNS * 9, 0.999))
    found = _nees(True, RUNS, heading_deg)
    print(f"NEES of 9: {found:.2f} [{low:.2f}, {high:.2f}]")
    assert low < found < high


def test_with_a_poor_heading_it_is_nearer_to_honest_than_the_extended_filter() -> None:
    """30 deg: measured 14.5 and 22.5 where 9 is right. The posterior is not Gaussian any more; the
    excess is at most half of the extended filter's."""
    unscented, extended = _nees(True, POOR_RUNS, 30.0), _nees(False, POOR_RUNS, 30.0)
    print(f"NEES of 9: unscented {unscented:.2f}, extended {extended:.2f}")
    assert unscented - 9.0 < 0.5 * (extended - 9.0)


@pytest.mark.parametrize("propagation", [False, True])
def test_in_the_navigator_whatever_the_delays(propagation: bool) -> None:
    """The drive of the navigator's tests, constraints included; measurements up to 8 s late."""
    d = vehicle.drive()
    filter_ = {"filter": "unscented", "unscented": {"propagation": propagation}}
    data = {**vehicle.CONFIG, "estimator": {"buffer_s": 12.0, **filter_}}
    rng = np.random.default_rng(1)
    late = rng.choice([0.0, 0.1, 1.5, 8.0], len(d.measurements)).tolist()
    found = []
    for delays in ([0.0] * len(late), late):
        navigator, row = vehicle.started(data)
        vehicle.feed(navigator, row, [7], delays)
        found.append(navigator)
    on_time, delayed = found
    assert isinstance(on_time.estimator, UnscentedEstimator)
    assert on_time.estimator.propagation is propagation
    assert vehicle.state_bytes(on_time) == vehicle.state_bytes(delayed)
    outcomes = vehicle.outcomes_of(on_time)
    assert outcomes == vehicle.outcomes_of(delayed)
    assert outcomes["gnss"]["fused"] == outcomes["wheel"]["fused"] == 34
    assert outcomes["non_holonomic"]["fused"] > 60
    true = runs.true_nav(d.truth, np.array([vehicle.SECONDS]))[0]
    error = runs.nav_error(on_time.estimator.nav, true)
    sd = np.sqrt(np.diag(on_time.estimator.covariance)[:9])
    assert (np.abs(error) < 4.0 * sd).all()
