"""Errors that become others: P, estimates and a bank's sensitivities by dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusiond.aiding.base import Renewal
from fusiond.aiding.pseudorange import RANGE_BIAS
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.separation import SeparatedEstimator
from fusiond.estimators.shared_error_renewal import renew, transition
from fusiond.estimators.smoothing.node_recorder import TapedKalman
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.models.model import Model
from tests.runs import level_nav

LEVEL, DOWN = RANGE_BIAS
BLOCKS = position_bias(LEVEL, 0.5, 1800.0), position_bias(DOWN, 1.0, 1800.0, "d")


def model() -> Model:
    return make_model("ins15", imu_noise(Imu()), *BLOCKS)


def positive(size: int, seed: int) -> Any:
    a = np.random.default_rng(seed).normal(size=(size, size))
    return a @ a.T


def renewal() -> Renewal:
    kept = np.random.default_rng(2).normal(0.0, 0.4, (3, 3))
    return Renewal(RANGE_BIAS, kept, 0.1 * positive(3, 3))


def whole(m: Model) -> tuple[Any, Any]:
    """T and Q (n, n) of all states, in their units."""
    t, q = np.eye(m.size), np.zeros((m.size, m.size))
    slots, sd = m.slots_of_all(RANGE_BIAS), np.diag([0.5, 0.5, 1.0])
    own = np.ix_(slots, slots)
    t[own] = sd @ renewal().kept @ np.linalg.inv(sd)
    q[own] = sd @ renewal().new @ sd
    return t, q


def begun(estimator: KalmanEstimator) -> Any:
    m = estimator.model
    p = positive(m.size, 1)
    xi = np.random.default_rng(4).normal(size=m.size)
    estimator.initialise(0, 0, level_nav((0.0, 0.0, 0.3), (1.0, 0.0, 0.0)), xi, p)
    return p, xi


@pytest.mark.parametrize("make", [KalmanEstimator, TapedKalman])
def test_what_is_kept_and_what_is_new(make: Any) -> None:
    estimator = make(model(), 0.1)
    p, xi = begun(estimator)
    t, q = whole(estimator.model)
    estimator._renew(renewal())
    assert estimator.covariance == pytest.approx(t @ p @ t.T + q)
    assert estimator.xi == pytest.approx(t @ xi)


@pytest.mark.parametrize("name", ["ins15", "planar15"])
def test_noise_that_the_place_shares(name: str) -> None:
    """It is that of both by one draw, in the states' units; what a planar model holds stays."""
    m = make_model(name, imu_noise(Imu()), *BLOCKS)
    estimator = KalmanEstimator(m, 0.1)
    begun(estimator)
    held = np.flatnonzero(~m.active)
    estimator._covs[:, held] = estimator._covs[..., held] = 0.0
    p = estimator.covariance.copy()
    taken, noise = np.zeros((9, 3)), positive(3, 7)
    taken[6:9] = np.random.default_rng(8).normal(size=(3, 3))
    shared = renewal()._replace(with_navigation=(taken, noise), kept=np.eye(3))
    estimator._renew(shared)
    of_noise = np.zeros((m.size, 3))
    of_noise[:9] = taken * m.active[:9, None]
    of_noise[m.slots_of_all(RANGE_BIAS)] = np.diag([0.5, 0.5, 1.0])
    own = np.zeros((m.size, 3))
    own[m.slots_of_all(RANGE_BIAS)] = np.diag([0.5, 0.5, 1.0])
    expected = p + of_noise @ noise @ of_noise.T + own @ renewal().new @ own.T
    assert estimator.covariance == pytest.approx(expected)


def test_of_each_subset() -> None:
    estimator = SeparatedEstimator(model(), 0.1, ("gnss",))
    p, _ = begun(estimator)
    t, q = whole(estimator.model)
    super(SeparatedEstimator, estimator)._renew(renewal())
    n = estimator.model.size
    for cov in estimator._covs:
        assert cov[:n, :n] == pytest.approx(t @ p @ t.T + q)


def test_a_tape_has_the_transition() -> None:
    estimator = TapedKalman(model(), 0.1)
    begun(estimator)
    before = estimator.newest
    t, _ = whole(estimator.model)
    estimator._renew(renewal())
    n = estimator.model.size
    assert estimator.newest is not before  # a node with P as it was
    assert estimator._phi[:n, :n] == pytest.approx(t)


def test_a_model_without_these_states_has_nothing_to_renew() -> None:
    plain = make_model("ins15", imu_noise(Imu()))
    assert transition(renewal(), plain) is None
    p = positive(plain.size, 5)
    same = p.copy()
    renew(renewal(), plain, (p,), ())
    assert np.array_equal(p, same)
