"""The noise scale of a series: white innovations leave it at one, others make it what it is."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.estimators.noise_scale import MOST, forget_lately, learn, unlearned

STEP_S = 0.2
MANY = 6_000


def scale_of(y: np.ndarray) -> float:
    """After all of a series, which is whitened by the scale as it goes."""
    packed = unlearned()
    for k, value in enumerate(y):
        now = value / np.sqrt(packed[0])
        learn(packed, k * STEP_S, now, 0.0, 0.0, 1)
    return float(packed[0])


@pytest.mark.parametrize("seed", range(4))
def test_white_innovations_leave_it_at_one(seed: int) -> None:
    assert scale_of(np.random.default_rng(seed).standard_normal(MANY)) < 1.5


@pytest.mark.parametrize("count", [300, 1_000])
def test_what_chance_shows_does_not_add_up(count: int) -> None:
    """A floor of one under an estimate that scatters is more than one on the average: 1.08 and
    1.04 of these."""
    found = []
    for seed in range(60):
        packed = unlearned()
        y = np.random.default_rng(seed).standard_normal((count, 3))
        for k in range(count):
            learn(packed, k * STEP_S, *(y[k] / np.sqrt(packed[:3])).tolist(), 3)
        found.extend(packed[:3].tolist())
    assert 1.0 <= np.mean(found) < 1.02


def test_one_that_states_half_its_sigma_counts_four_times_its_variance() -> None:
    found = [scale_of(2.0 * np.random.default_rng(k).standard_normal(MANY)) for k in range(8)]
    assert 3.2 < np.mean(found) < 4.8


def test_one_that_states_twice_its_sigma_counts_as_it_states() -> None:
    assert scale_of(0.5 * np.random.default_rng(3).standard_normal(MANY)) == 1.0


def test_errors_that_last_count_by_their_long_run_variance() -> None:
    """Of first order with rho = 0.5 it is three times the variance."""
    found = []
    for seed in range(8):
        rng = np.random.default_rng(50 + seed)
        y = np.empty(MANY)
        y[0] = rng.standard_normal()
        for k in range(1, MANY):
            y[k] = 0.5 * y[k - 1] + np.sqrt(0.75) * rng.standard_normal()
        found.append(scale_of(y))
    assert 2.2 < np.mean(found) < 3.4  # Bartlett's window of eight lags has 2.6


def test_what_a_fault_shows_does_not_count() -> None:
    packed = unlearned()
    rng = np.random.default_rng(9)
    for k in range(100):
        learn(packed, k * STEP_S, *rng.standard_normal(3).tolist(), 3)
    before = packed[:3].copy()
    for k in range(100, 170):  # 14 s
        learn(packed, k * STEP_S, 30.0, 30.0, 30.0, 3)
    forget_lately(packed)
    learn(packed, 171 * STEP_S, 0.0, 0.0, 0.0, 3)
    assert (packed[:3] <= np.maximum(before, 1.5)).all()


def test_it_has_an_end() -> None:
    assert scale_of(np.full(MANY, 1e6)) <= MOST
