"""Covariance analysis of suboptimal filters, held to simulated errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.studies.covariance_analysis import System, analyse, joseph, optimal_gain

Array = NDArray[np.float64]

N, KEPT = 5, np.array([0, 1, 3])
RUNS, STEPS = 4000, 25


def full(rng: np.random.Generator, invariant: bool) -> System:
    """A step of the truth; with `invariant`, states 2 and 4 are driven by nothing."""
    phi = np.eye(N) + 0.15 * rng.standard_normal((N, N))
    if invariant:
        phi[[2, 4], :] = np.eye(N)[[2, 4]]
    root = 0.1 * rng.standard_normal((N, N))
    q = root @ root.T
    h = rng.standard_normal((2, N))
    return System(phi, q, h, rng.uniform(0.5, 1.5, 2))


def reduced(truth: System, rng: np.random.Generator, wrong: float) -> System:
    """The filter's model: the states kept, and where `wrong`, off in every number."""
    phi = truth.phi[np.ix_(KEPT, KEPT)] + wrong * rng.standard_normal((3, 3))
    h = truth.h[:, KEPT] + 2.0 * wrong * rng.standard_normal((2, 3))
    return System(phi, truth.q[np.ix_(KEPT, KEPT)] * 1.5, h, truth.r * 0.8)


def steps(invariant: bool, wrong: float) -> list[tuple[System, System]]:
    rng = np.random.default_rng(11)
    found = []
    for _ in range(STEPS):
        truth = full(rng, invariant)
        found.append((truth, reduced(truth, rng, wrong)))
    return found


INITIAL = np.diag([4.0, 1.0, 2.0, 9.0, 1.0])
BELIEVED = np.diag([3.0, 2.0, 9.0])


def simulated(pairs: list[tuple[System, System]], fed_back: Array | None) -> Iterator[Array]:
    """The filter as a filter: x and its estimate for many runs at once, error (RUNS, N) a step."""
    rng = np.random.default_rng(5)
    up = np.zeros((N, 3))
    up[KEPT, np.arange(3)] = 1.0
    x = rng.standard_normal((RUNS, N)) @ np.linalg.cholesky(INITIAL).T
    estimate = np.zeros((RUNS, 3))
    p = BELIEVED
    for truth, model in pairs:
        x = x @ truth.phi.T + rng.standard_normal((RUNS, N)) @ np.linalg.cholesky(truth.q).T
        z = x @ truth.h.T + rng.standard_normal((RUNS, 2)) * np.sqrt(truth.r)
        estimate = estimate @ model.phi.T
        p = model.phi @ p @ model.phi.T + model.q
        k = optimal_gain(p, model.h, model.r)
        p = joseph(p, k, model.h, model.r)
        estimate = estimate + (z - estimate @ model.h.T) @ k.T
        if fed_back is not None:
            # Out of the navigation state, whose error x is from now on the smaller one.
            x[:, KEPT[fed_back]] -= estimate[:, fed_back]
            estimate[:, fed_back] = 0.0
        yield x - estimate @ up.T


@pytest.mark.parametrize("fed_back", [None, np.array([0, 1])], ids=["open", "closed"])
@pytest.mark.parametrize("wrong", [0.0, 0.1], ids=["selected", "mismatched"])
@pytest.mark.parametrize("invariant", [False, True], ids=["driven", "undriven"])
def test_true_error_is_that_of_simulated_filters(
    invariant: bool, wrong: float, fed_back: NDArray[np.int64] | None
) -> None:
    """Every variance within its chi-square interval; eight cases of 25 x 5 variances: 1e-6."""
    pairs = steps(invariant, wrong)
    low, high = chi2.ppf([0.5e-6, 1.0 - 0.5e-6], RUNS) / RUNS
    results = analyse(pairs, KEPT, INITIAL, BELIEVED, fed_back)
    for found, errors in zip(results, simulated(pairs, fed_back), strict=True):
        ratio = np.square(errors).mean(axis=0) / np.diag(found.true)
        assert low < ratio.min()
        assert ratio.max() < high
        # Of two correlated errors too: the sum of all in units of their sigma.
        unit = 1.0 / np.sqrt(np.diag(found.true))
        total = np.square(errors @ unit).mean() / (unit @ found.true @ unit)
        assert low < total < high


def test_feedback_matters_only_where_the_model_is_wrong() -> None:
    def last(invariant: bool, wrong: float, fed_back: NDArray[np.int64] | None) -> Array:
        return list(analyse(steps(invariant, wrong), KEPT, INITIAL, BELIEVED, fed_back))[-1].true

    every = np.arange(3)
    np.testing.assert_allclose(last(True, 0.0, every), last(True, 0.0, None), rtol=1e-9, atol=1e-12)
    off = last(False, 0.1, every), last(False, 0.1, None)
    assert np.abs(off[0] - off[1]).max() > 1e-2


def test_with_nothing_left_out_the_filter_is_right_about_itself() -> None:
    pairs = [(truth, truth) for truth, _ in steps(False, 0.0)]
    for found in analyse(pairs, np.arange(N), INITIAL, INITIAL):
        np.testing.assert_allclose(found.true, found.believed, rtol=1e-8, atol=1e-10)


def test_no_filter_beats_the_full_one_and_a_reduced_one_may_not_know() -> None:
    pairs = steps(True, 0.0)
    best = list(analyse([(t, t) for t, _ in pairs], np.arange(N), INITIAL, INITIAL))
    found = list(analyse(pairs, KEPT, INITIAL, INITIAL[np.ix_(KEPT, KEPT)]))
    for a, b in zip(best, found, strict=True):
        assert np.linalg.eigvalsh(b.true - a.true).min() > -1e-9
    believed = np.diag(found[-1].believed)
    true = np.diag(found[-1].true)[KEPT]
    assert (true > believed).any()


def test_an_epoch_without_rows_only_propagates() -> None:
    truth, model = steps(False, 0.0)[0]
    none = (truth._replace(h=np.zeros((0, N)), r=np.zeros(0)),)
    rows = model._replace(h=np.zeros((0, 3)), r=np.zeros(0))
    found = next(analyse([(*none, rows)], KEPT, INITIAL, BELIEVED))
    np.testing.assert_allclose(found.true, truth.phi @ INITIAL @ truth.phi.T + truth.q)
    np.testing.assert_allclose(found.believed, model.phi @ BELIEVED @ model.phi.T + model.q)
