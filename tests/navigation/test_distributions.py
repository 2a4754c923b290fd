"""Tails and quantiles against those of scipy, which a start does without."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special

from fusiond.navigation.distributions import (
    f_quantile,
    f_tail,
    gamma_quantile,
    gamma_tails,
    gaussian_quantile,
    median,
    noncentrality,
)

SHAPES = (0.5, 1.0, 1.5, 2.0, 3.7, 9.0, 19.9, 20.0, 50.0, 150.0, 1000.3, 15_000.0)
TAILS = (1e-300, 1e-100, 1e-15, 1e-9, 1e-4, 0.0025, 0.05, 0.3, 0.5, 0.7, 0.95, 0.999)


@pytest.mark.parametrize("p", [*TAILS, 0.0, 1.0, 1.0 - 1e-16])
def test_gaussian_quantile(p: float) -> None:
    assert gaussian_quantile(p) == pytest.approx(float(special.ndtri(p)), rel=1e-14, abs=1e-15)


def test_what_is_no_probability_has_no_gaussian_quantile() -> None:
    assert all(math.isnan(gaussian_quantile(p)) for p in (-1e-9, 1.1, math.inf, math.nan))


@pytest.mark.parametrize("shape", SHAPES)
def test_tails_of_the_gamma_law(shape: float) -> None:
    for x in shape * np.array([0.0, 1e-6, 0.01, 0.3, 0.7, 0.99, 1.0, 1.01, 1.5, 3.0, 10.0, np.inf]):
        tails = gamma_tails(shape, float(x))
        expected = special.gammainc(shape, x), special.gammaincc(shape, x)
        assert tails == pytest.approx(expected, rel=1e-12, abs=1e-300)


@pytest.mark.parametrize("shape", SHAPES)
def test_quantiles_of_the_gamma_law(shape: float) -> None:
    for p in TAILS:
        lower, upper = special.gammaincinv(shape, p), special.gammainccinv(shape, p)
        assert gamma_quantile(shape, p) == pytest.approx(float(lower), rel=1e-12, abs=1e-300)
        assert gamma_quantile(shape, p, upper=True) == pytest.approx(float(upper), rel=1e-12)
    assert gamma_quantile(shape, 0.0) == gamma_quantile(shape, 1.0, upper=True) == 0.0
    assert gamma_quantile(shape, 1.0) == gamma_quantile(shape, 0.0, upper=True) == math.inf


@pytest.mark.parametrize("epochs", [20, 55, 100, 300, 1000, 30_000])
def test_tail_and_quantile_of_the_f_law(epochs: int) -> None:
    """At the degrees of freedom of the test of whiteness (fusiond.integrity.consistency)."""
    d, n = 8.0 + 207.0 / epochs - 1670.0 / epochs**2, 13.6 + 0.277 * epochs
    for x in (0.0, 1e-3, 0.1, 0.9, 1.0, 2.5, 10.0, 100.0):
        expected = float(special.fdtrc(d, n, x))
        assert f_tail(d, n, x) == pytest.approx(expected, rel=1e-11, abs=1e-300)
    for p in (1e-9, 1e-4, 0.005, 0.05, 0.5, 0.9):
        assert special.fdtrc(d, n, f_quantile(d, n, p)) == pytest.approx(p, rel=1e-11)


@pytest.mark.parametrize("x", [14.0, 20.0, 25.0, 100.0])
def test_noncentrality_of_a_chi_square(x: float) -> None:
    for p in (0.001, 0.1, 0.2, 0.9):
        found = noncentrality(x, 8, p)
        assert special.chndtr(x, 8, found) == pytest.approx(p, rel=1e-11)


def test_what_is_rarer_without_any_noncentrality_has_none() -> None:
    assert noncentrality(2.0, 8, 0.1) == 0.0  # P(4, 1) = 0.019


def test_no_number_ends_no_sum() -> None:
    assert all(math.isnan(tail) for tail in gamma_tails(3.0, math.nan))
    assert math.isnan(f_tail(8.0, 30.0, math.nan))


def test_median_is_that_of_numpy() -> None:
    values = np.random.default_rng(1).normal(9.8, 1.0, 1001)
    for some in (values, values[:1000], values[:2], values[:1], np.append(values, math.nan)):
        np.testing.assert_array_equal(median(some), np.median(some))
