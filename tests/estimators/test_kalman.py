"""The filter's kernels against plain dense linear algebra, and its covariance over long runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.aiding.attitude import HeadingMeasurement
from fusiond.aiding.base import Innovation, NotApplicable, State
from fusiond.aiding.position import PositionMeasurement
from fusiond.configuration.schema import Imu
from fusiond.estimators.base import gate_threshold
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.multi_sample_covariance import GAP_FORCE_M_S2, GAP_RATE_RAD_S
from fusiond.models.model import Model
from fusiond.navigation.error_model import dense_transition
from tests import runs
from tests.estimators.covariances import random_covariance

Array = NDArray[np.float64]

IMU = Imu(rate_hz=50.0)
MODELS = ("ins15", "ins21", "planar15")
STEP_NS = 20_000_000


def started(name: str, seed: int = 1) -> tuple[Model, KalmanEstimator, Array]:
    """A filter with a full covariance and non-zero parameters, and that covariance."""
    model, estimator = runs.make_estimator(name, IMU)
    rng = np.random.default_rng(seed)
    v = (12.0, -7.0, 0.0) if model.hold_height else (12.0, -7.0, 0.8)
    p = random_covariance(rng, model)
    xi = np.zeros(model.size)
    xi[9:] = 0.3 * model.initial[9:] * rng.standard_normal(model.size - 9)
    estimator.initialise(0, 0, runs.level_nav((0.1, -0.05, 0.8), v), xi, p)
    return model, estimator, p


def dense_step(model: Model, estimator: KalmanEstimator, p: Array, h: float) -> Array:
    """P after the interval of h seconds that the estimator has just crossed, as documented."""
    m = dense_transition(estimator.nav, estimator.step, h)
    phi = np.zeros((model.size, model.size))
    phi[:9, :9] = m[:, :9]
    decay = np.ones(model.size)
    q = np.zeros(model.size)
    for block, column, i in (
        (b, c, slot)
        for b in model.blocks
        for c, slot in zip(b.columns, model.slots_of(b.name), strict=True)
    ):
        if column >= 9:
            phi[:9, i] = m[:, column]
            decay[i] = math.exp(-h / block.tau_s)
            q[i] = block.white * h + block.steady**2 * (1.0 - decay[i] ** 2)
    phi[range(9, model.size), range(9, model.size)] = decay[9:]
    keep = np.diag(model.active.astype(float))
    core = np.zeros(model.size)
    for block in model.blocks:
        if block.columns[0] < 9:
            core[list(block.columns)] = 0.5 * h * block.white
    phi = keep @ phi @ keep
    # Half of the noise before; of a Markov state what that decays by comes after.
    after = core + (1.0 - 0.5 * decay**2) * q
    return np.asarray(phi @ (p + np.diag(core + 0.5 * q)) @ phi.T + np.diag(after))


@pytest.mark.parametrize("name", MODELS)
def test_covariance_against_dense_products(name: str) -> None:
    model, estimator, p = started(name)
    rng = np.random.default_rng(2)
    count = 200
    samples = rng.standard_normal((count, 6)) * [0.3] * 1 + [0.1, 0.0, 0.2, 1.0, 0.5, -9.8]
    times = STEP_NS * np.arange(1, count + 1)
    buffer = runs.filled_buffer(IMU, times, samples)
    for t in times:
        before = p
        estimator.propagate(buffer, int(t))
        p = dense_step(model, estimator, before, 0.02)
        scale = np.sqrt(np.maximum(np.diag(p), 1e-300))
        # A few hundred roundings of 1e-16 an interval.
        relative = (estimator.covariance - p) / np.outer(scale, scale)
        active = np.ix_(model.active, model.active)
        assert np.abs(relative[active]).max() < 1e-11
        assert (estimator.covariance[~model.active] == 0.0).all()
        assert (estimator.covariance[:, ~model.active] == 0.0).all()
        assert (estimator.covariance == estimator.covariance.T).all()


def test_markov_parameters_decay_and_constants_stay() -> None:
    model, estimator, _ = started("planar15")
    before = estimator.xi.copy()
    times = STEP_NS * np.arange(1, 501)
    buffer = runs.filled_buffer(IMU, times, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.8], (500, 1)))
    estimator.propagate(buffer, int(times[-1]))
    decay = math.exp(-10.0 / IMU.bias_correlation_s)
    markov = model.slots_of("gyro_markov") + model.slots_of("accel_markov")
    assert estimator.xi[markov] == pytest.approx(before[markov] * decay, rel=1e-12)
    constant = model.slots_of("gyro_bias")
    assert (estimator.xi[constant] == before[constant]).all()


def test_a_markov_state_settles_at_its_steady_variance() -> None:
    model, first, _ = started("planar15")
    estimator = KalmanEstimator(model, gap_s=60.0)
    estimator.initialise(
        0, 0, first.nav.copy(), np.zeros(model.size), np.zeros((model.size, model.size))
    )
    count = 3000  # 10 s each: more than eight correlation times
    times = 10 * runs.SECOND * np.arange(1, count + 1)
    buffer = runs.filled_buffer(
        Imu(rate_hz=0.1, gap_s=60.0), times, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.8], (count, 1))
    )
    estimator.propagate(buffer, int(times[-1]))
    slots = model.slots_of("gyro_markov")
    steady = next(b.steady for b in model.blocks if b.name == "gyro_markov")
    sd = np.sqrt(np.diag(estimator.covariance)[slots])
    assert sd == pytest.approx([steady] * 3, rel=1e-6)


@dataclass(frozen=True)
class Row:
    """A linear measurement."""

    z: Array
    h: Array
    r: Array
    gate: float = 1.0 - 1e-12
    source: str = "row"
    t_ns: int = 0
    screened: bool = False
    robust: bool = False

    def innovation(self, state: State) -> Innovation | NotApplicable:
        return Innovation(self.z, self.h, self.r)


@settings(max_examples=40)
@given(st.sampled_from(MODELS), st.integers(1, 6), st.integers(0, 2**31), st.floats(-8.0, 1.0))
def test_update_is_the_textbook_batch_update(name: str, m: int, seed: int, log_r: float) -> None:
    """Sequential rows against K = P H^T S^-1, (I - K H) P; NIS against nu^T S^-1 nu."""
    model, estimator, p = started(name, seed)
    rng = np.random.default_rng(seed + 1)
    sd = np.sqrt(np.where(model.active, np.diag(p), 1.0))
    h = rng.standard_normal((m, model.size)) / sd * model.active
    r = 10.0**log_r * rng.uniform(0.5, 2.0, m)
    s = h @ p @ h.T + np.diag(r)
    z = np.linalg.cholesky(s) @ rng.standard_normal(m)
    nav, xi = estimator.nav.copy(), estimator.xi.copy()
    outcome = estimator.update(Row(z, h, r))
    assert outcome.name == "fused"
    assert outcome.degrees == m
    assert outcome.nis == pytest.approx(z @ np.linalg.solve(s, z), rel=1e-6)
    gain = np.linalg.solve(s, h @ p).T
    dx = gain @ z
    expected = p - gain @ h @ p
    size = np.outer(sd, sd)
    assert np.abs((estimator.covariance - expected) / size).max() < 1e-7
    assert (estimator.covariance == estimator.covariance.T).all()
    assert estimator.xi[9:] - xi[9:] == pytest.approx(dx[9:], rel=1e-6, abs=1e-9)
    # Feedback takes the estimated error out of the navigation state: to first order in dx.
    moved = -runs.nav_error(estimator.nav, nav)
    # (|phi|^2 and position over the Earth's radius).
    assert moved == pytest.approx(dx[:9], abs=1e-5 + 1e-5 * float(np.abs(dx[:9]).max()))


def test_feedback_restores_the_true_state() -> None:
    """The exact error, measured without noise, is gone after one update."""
    model, estimator, _ = started("ins21")
    true = runs.level_nav((0.1, -0.05, 0.8), (12.0, -7.0, 0.8))
    error = np.array([0.01, -0.02, 0.03, 0.5, -0.3, 0.2, 20.0, -30.0, 10.0])
    estimator.nav[:] = runs.with_error(true, error)
    h = np.eye(9, model.size)
    assert estimator.update(Row(error, h, np.full(9, 1e-12), gate=1.0)).name == "fused"
    left = runs.nav_error(estimator.nav, true)
    assert left == pytest.approx(np.zeros(9), abs=1e-3 * 0.5)  # 30 m of a spheroid: 0.1 mm


def test_gate_is_the_chi_square_quantile() -> None:
    assert gate_threshold(0.9999, 3) == pytest.approx(chi2.ppf(0.9999, 3))
    for factor, name in ((0.999, "fused"), (1.001, "gated")):
        model, estimator, p = started("ins15")
        before = estimator.snapshot()
        h = np.zeros((1, model.size))
        h[0, 6] = 1.0
        s = p[6, 6] + 4.0
        z = np.array([math.sqrt(factor * chi2.ppf(0.99, 1) * s)])
        outcome = estimator.update(Row(z, h, np.array([4.0]), 0.99))
        assert outcome.name == name
        assert outcome.nis == pytest.approx(factor * chi2.ppf(0.99, 1), rel=1e-9)
        if name == "gated":
            for now, then in zip(estimator.snapshot(), before, strict=True):
                assert np.array_equal(np.asarray(now), np.asarray(then))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_measurement_that_is_no_number_changes_nothing(bad: float) -> None:
    model, estimator, _ = started("ins15")
    before = estimator.snapshot()
    measurement = PositionMeasurement(
        "gnss", 0, 0.999, bad, 2.0, 40.0, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    )
    assert estimator.update(measurement).name in ("not_finite", "gated")
    assert estimator.update(HeadingMeasurement("h", 0, 0.999, math.nan, 0.01)).name == "not_finite"
    nan_noise = Row(np.zeros(1), np.eye(1, model.size), np.array([math.nan]))
    assert estimator.update(nan_noise).name == "not_finite"
    for now, then in zip(estimator.snapshot(), before, strict=True):
        assert np.array_equal(np.asarray(now), np.asarray(then))


@settings(max_examples=12)
@given(st.sampled_from(MODELS), st.integers(0, 2**31), st.sampled_from([1e-12, 1e-6, 1.0]))
def test_covariance_stays_symmetric_and_positive(name: str, seed: int, r: float) -> None:
    """Rates of a tumbling body, thousands of steps, measurements of absurd precision."""
    model, estimator, _ = started(name, seed)
    rng = np.random.default_rng(seed)
    count = 3000
    samples = rng.standard_normal((count, 6)) * ([1.0] * 3 + [5.0] * 3) + [0, 0, 0, 0, 0, -9.8]
    times = STEP_NS * np.arange(1, count + 1)
    buffer = runs.filled_buffer(IMU, times, samples)
    for t in times[::10]:
        estimator.propagate(buffer, int(t))
        rows = int(rng.integers(1, 4))
        h = rng.standard_normal((rows, model.size)) * model.active
        s = h @ estimator.covariance @ h.T + r * np.eye(rows)
        z = 0.5 * rng.standard_normal(rows) * np.sqrt(np.diag(s))
        assert estimator.update(Row(z, h, np.full(rows, r), gate=1.0)).name == "fused"
        p = estimator.covariance
        assert (p == p.T).all()
        sd = np.sqrt(np.diag(p)[model.active])
        assert (sd > 0.0).all()
        correlation = p[np.ix_(model.active, model.active)] / np.outer(sd, sd)
        # Rounding may take the smallest below zero by parts in 1e16 of the largest terms.
        assert np.linalg.eigvalsh(correlation).min() > -1e-6
    assert np.isfinite(estimator.nav).all()


def test_a_gap_widens_the_covariance_by_what_a_vehicle_may_do() -> None:
    model, estimator, p = started("ins15")
    estimator.initialise(0, 0, estimator.nav.copy(), np.zeros(model.size), p * 0.0)
    gap = 3.0
    times = np.array([STEP_NS, 2 * STEP_NS, 2 * STEP_NS + round(gap * 1e9)])
    buffer = runs.filled_buffer(IMU, times, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.8], (3, 1)))
    assert buffer.counters["gap"] == 1
    estimator.propagate(buffer, int(times[-1]))
    sd = np.sqrt(np.diag(estimator.covariance))
    assert sd[2] == pytest.approx(GAP_RATE_RAD_S * gap, rel=0.05)
    # It goes where it heads: a pitch that is unknown is a speed downward.
    turned = GAP_RATE_RAD_S * np.hypot(*estimator.nav[3:5])
    assert sd[8] == pytest.approx(0.5 * gap**2 * np.hypot(GAP_FORCE_M_S2, turned), rel=0.05)
    assert sd[5] == pytest.approx(gap * np.hypot(GAP_FORCE_M_S2, turned), rel=0.05)
    p, v = estimator.covariance, estimator.nav[3:6]
    assert p[3, 2] == pytest.approx(v[1] * (GAP_RATE_RAD_S * gap) ** 2, rel=0.05)
    assert p[4, 2] == pytest.approx(-v[0] * (GAP_RATE_RAD_S * gap) ** 2, rel=0.05)


def test_snapshot_and_restore_are_exact() -> None:
    _, estimator, _ = started("ins21")
    buffer = runs.filled_buffer(IMU, STEP_NS * np.arange(1, 51), np.full((50, 6), 0.1))
    snapshot = estimator.snapshot()
    estimator.propagate(buffer, 777_000_000)
    first = estimator.snapshot()
    estimator.restore(snapshot)
    estimator.propagate(buffer, 777_000_000)
    for a, b in zip(estimator.snapshot(), first, strict=True):
        assert np.array_equal(np.asarray(a), np.asarray(b))
    assert first.t_ns == 777_000_000
    assert first.sample == 38  # the sample that holds until 780 ms is not finished


@pytest.mark.parametrize("name", MODELS)
def test_a_span_in_one_call_is_to_the_bit_that_span_in_many(name: str) -> None:
    """What a call keeps to itself, half of P among it, must not show where a span is cut."""
    rng = np.random.default_rng(3)
    count = 300
    samples = rng.standard_normal((count, 6)) * [0.3] + [0.1, 0.0, 0.2, 1.0, 0.5, -9.8]
    times = STEP_NS * np.arange(1, count + 1)
    buffer = runs.filled_buffer(IMU, times, samples)
    _, whole, _ = started(name)
    _, cut, _ = started(name)
    whole.propagate(buffer, int(times[-1]), passing=True)
    for t in (*times[:-1:7], times[-1]):
        cut.propagate(buffer, int(t), passing=True)
    for a, b in zip(whole.snapshot(), cut.snapshot(), strict=True):
        assert np.array_equal(np.asarray(a), np.asarray(b))
