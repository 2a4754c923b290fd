"""Unscented filter: equal to the extended one where all is linear, right where it is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.base import AidingMeasurement, Innovation, NotApplicable, State
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.velocity import VelocityMeasurement
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.unscented.filter import SPREAD, UnscentedEstimator
from fusiond.estimators.unscented.sigma_points import linear_form
from fusiond.estimators.update import feed_back
from fusiond.models.catalogue import make_model
from tests import runs
from tests.estimators.side_by_side import (
    GATE,
    IMU,
    MODELS,
    NO_LEVER,
    compare,
    linear_measurements,
    pair_of,
)

Array = NDArray[np.float64]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("holding", [False, True])
def test_linear_measurements_as_the_extended_filter_to_rounding(name: str, holding: bool) -> None:
    """Position without a lever arm and velocity. What is left is the curve of the Earth over a few
    sigmas (20 m / R = 3e-6) and the resolution of a latitude (1e-9 m)."""
    extended, unscented = pair_of(name)
    if holding:
        extended.hold()
        unscented.hold()
    for measurement in linear_measurements(not extended.model.hold_height):
        a, b = extended.update(measurement), unscented.update(measurement)
        assert (a.name, b.name) == ("fused", "fused")
        assert b.nis == pytest.approx(a.nis, rel=1e-5)
    if holding:
        assert np.array_equal(extended.nav, unscented.nav)
        extended.release()
        unscented.release()
    compare(extended, unscented, 3e-5, 1e-5)


@immutable()
class _Square(AidingMeasurement):
    """y = (v_n - v0)^2 + v_e + noise, at the computed v_n = v0: all that EKF sees is v_e."""

    v_n: float
    value: float
    variance: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        d = float(state.nav[3]) - self.v_n
        h = np.zeros((1, state.model.size))
        h[0, 3], h[0, 4] = 2.0 * d, 1.0
        h[0, 3] = h[0, 3] or 1e-300  # depends on it, though not at the centre
        z = np.array([d * d + float(state.nav[4]) - self.value])
        return Innovation(z, h, np.array([self.variance]))


def test_mean_and_variance_of_a_square() -> None:
    """E[x^2] is taken off, and the variance grows by s^2 times the coefficient's square (the
    Gaussian's is 2, s = sqrt(2) gives it exactly)."""
    for spread, factor in ((math.sqrt(2.0), 2.0), (SPREAD, 3.0)):
        model = make_model("ins15", imu_noise(IMU))
        u = UnscentedEstimator(model, IMU.gap_s, spread=spread)
        nav = runs.level_nav((0.0, 0.0, 0.0), (10.0, 0.0, 0.0))
        p = np.zeros((model.size, model.size))
        p[3, 3], p[4, 4] = 0.25, 0.04
        u.initialise(0, 0, nav, np.zeros(model.size), p)
        # The computed square is 0, the measured one 0.7; 0.25 is what the sigma of v_n explains.
        outcome = u.update(_Square("square", 0, GATE, 10.0, 0.7, 0.01))
        s = 0.04 + 0.01 + factor * 0.25**2
        assert outcome.nis == pytest.approx((0.0 - 0.7 + 0.25) ** 2 / s, rel=1e-9)
        assert u.nav[4] == pytest.approx(0.45 * 0.04 / s, rel=1e-9)
        assert u.covariance[4, 4] == pytest.approx(0.04 - 0.04**2 / s, rel=1e-9)
        assert u.covariance[3, 3] == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize("holding", [False, True])
def test_gain_and_covariance_of_the_textbook_transform(holding: bool) -> None:
    """A long lever arm and a poor attitude: against weighted sums over the whole set of points,
    K = P_xz S^-1, P - K S K^T."""
    _, u = pair_of("ins15", p_scale=8.0)
    lat, lon, up = runs.ORIGIN
    measurement = PositionMeasurement(
        "gnss", 0, GATE, lat, lon, up, (0.3, 0.3, 0.3), (30.0, -10.0, -5.0)
    )
    if holding:
        u.hold()
        u.update(VelocityMeasurement("velocity", 0, GATE, (12.5, -7.2, 0.9), (1.0,) * 3, NO_LEVER))
    dx, cov = u._dxs[0].copy(), u.covariance.copy()
    slots = np.flatnonzero(np.r_[np.ones(3), np.zeros(3), np.ones(3), np.zeros(6)])
    root = np.linalg.cholesky(cov[np.ix_(slots, slots)])
    m = len(slots)
    deltas = [np.zeros(m), *(SPREAD * root.T), *(-SPREAD * root.T)]
    weights = np.array([1.0 - m / 3.0, *[1.0 / 6.0] * (2 * m)])
    explained = []
    for delta in deltas:
        error = dx.copy()
        error[slots] += delta
        at = u.nav.copy()
        feed_back(at, np.zeros(u.model.size), error)
        found = measurement.innovation(State(at, u.xi, u.step, u.model))
        assert isinstance(found, Innovation)
        explained.append(-found.z)
    g = np.array(explained)
    mean = weights @ g
    centred = g - mean
    # With beta = alpha^2 the central point counts 1 - alpha^2 + beta = 1 more in the covariance.
    s = (centred.T * weights) @ centred + np.outer(centred[0], centred[0])
    s += np.diag([0.09] * 3)
    p_xz = cov[:, slots] @ np.linalg.inv(cov[np.ix_(slots, slots)])
    p_xz = p_xz @ sum(w * np.outer(d, c) for w, d, c in zip(weights, deltas, centred, strict=True))
    gain = p_xz @ np.linalg.inv(s)
    # `explained` is minus the innovation of a candidate: what it leaves is -mean.
    expected_dx = dx + gain @ (-mean)
    expected = cov - gain @ s @ gain.T
    nav, xi = u.nav.copy(), u.xi.copy()
    outcome = u.update(measurement)
    assert outcome.name == "fused"
    assert outcome.nis == pytest.approx(mean @ np.linalg.solve(s, mean), rel=1e-6)
    if holding:
        assert u._dxs[0] == pytest.approx(expected_dx, rel=1e-5, abs=1e-9)
    else:
        feed_back(nav, xi, expected_dx)
        assert u.nav == pytest.approx(nav, rel=1e-9)
    sd = np.sqrt(np.diag(cov))
    assert np.abs((u.covariance - expected) / np.outer(sd, sd)).max() < 1e-7


def test_a_heading_is_the_same_across_the_turn() -> None:
    """The points straddle the angle at which the innovation jumps by a turn."""
    model = make_model("ins15", imu_noise(IMU))
    p = np.diag(runs.initial_sd(model, np.array([0.001, 0.001, 0.6]), 0.1, 1.0) ** 2)
    found = []
    for off in (0.0, 3.1):
        u = UnscentedEstimator(model, IMU.gap_s)
        e = KalmanEstimator(model, IMU.gap_s)
        for f in (u, e):
            nav = runs.level_nav((0.0, 0.0, 0.3 + off), (1.0, 0.0, 0.0))
            f.initialise(0, 0, nav, np.zeros(model.size), p)
            heading = HeadingMeasurement("h", 0, GATE, 0.3, 0.3)
            if f.update(heading).name == "gated":
                f.covariance[2, 2] += 3.1**2
                assert f.update(heading).name == "fused"
        assert u.covariance[2, 2] == pytest.approx(e.covariance[2, 2], rel=1e-4)
        found.append(u)


def test_rows_judged_one_by_one_stay_apart_with_no_less_noise() -> None:
    """10 km of position: the second order of a range of 4e7 m is metres, and common to ranges of
    like direction. The same numbers decorrelated, and with a variance for each."""
    rng = np.random.default_rng(2)
    m, rows, n = 4, 5, 15
    slots = np.array([3, 5, 6, 9])
    root = np.ascontiguousarray(np.linalg.cholesky(np.eye(m) + 0.5).T)
    points = rng.standard_normal((2 * m + 1, rows))
    r, dx = rng.uniform(0.5, 2.0, rows), np.zeros(n)
    forms = []
    for one_by_one in (False, True):
        z, h, d = np.empty(rows), np.empty((rows, n)), np.empty(rows)
        linear_form(points, np.zeros((rows, n)), r, dx, slots, root, SPREAD, one_by_one, z, h, d)
        forms.append((z, h, d))
    (z, h, d), (apart_z, apart_h, apart_d) = forms
    even = (points[1::2] + points[2::2] - 2.0 * points[0]) / (2.0 * SPREAD)
    odd = (points[2::2] - points[1::2]) / (2.0 * SPREAD)
    noise = np.diag(r) + even.T @ even
    assert apart_z == pytest.approx(points[0] + even.sum(axis=0) / SPREAD)
    assert apart_h[:, slots] @ root.T == pytest.approx(odd.T)
    assert np.linalg.eigvalsh(np.diag(apart_d) - noise).min() > -1e-12
    # U from the rows themselves: U^-1 noise U^-T = D.
    unit = np.linalg.cholesky(noise) / np.diag(np.linalg.cholesky(noise))
    assert np.linalg.solve(unit, apart_z) == pytest.approx(z)
    assert np.linalg.solve(unit, apart_h) == pytest.approx(h)
    assert np.diag(np.linalg.cholesky(noise)) ** 2 == pytest.approx(d)


@immutable()
class _OnlyNorth(AidingMeasurement):
    """Holds only where the true velocity may be above what is computed."""

    v_n: float

    def innovation(self, state: State) -> Innovation | NotApplicable:
        if state.nav[3] < self.v_n:
            return NotApplicable("too_slow")
        h = np.zeros((1, state.model.size))
        h[0, 3] = 1.0
        return Innovation(np.array([state.nav[3] - 12.3]), h, np.array([0.01]))


def test_where_a_measurement_does_not_hold_at_a_point_the_jacobian_serves() -> None:
    extended, unscented = pair_of("ins15")
    for f in (extended, unscented):
        assert f.update(_OnlyNorth("north", 0, GATE, 12.0)).name == "fused"
    compare(extended, unscented, 1e-9, 1e-9)
    assert unscented.update(_OnlyNorth("north", 0, GATE, 20.0)).name == "too_slow"


def test_states_without_variance_take_no_part() -> None:
    extended, unscented = pair_of("ins21")
    for f in (extended, unscented):
        p = f.covariance.copy()
        p[6], p[:, 6] = 0.0, 0.0
        p[7], p[:, 7] = 2.0 * p[8], 2.0 * p[:, 8]
        p[7, 7] = 4.0 * p[8, 8]
        f.initialise(0, 0, f.nav.copy(), f.xi.copy(), p)
        for measurement in linear_measurements(True):
            assert f.update(measurement).name == "fused"
    compare(extended, unscented, 1e-4, 1e-5)
