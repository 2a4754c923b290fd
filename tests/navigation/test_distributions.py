"""Tails and quantiles against scipy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special

from fusiond.navigation.distributions import (
    chi_square_bound,
    f_quantile,
    f_tail,
    gamma_quantile,
    gamma_tail,
    noncentral_chi_square,
    noncentrality,
    normal_quantile,
)

PROBABILITIES = (1e-15, 1e-9, 1e-7, 1e-4, 0.005, 0.05, 0.3, 0.5, 0.7, 0.95, 0.9999, 1.0 - 1e-7)
SHAPES = (0.5, 1.0, 1.5, 3.0, 7.3, 20.0, 40.5, 150.0, 500.0)


def test_normal() -> None:
    p = np.concatenate([10.0 ** -np.arange(1.0, 300.0, 3.0), np.linspace(0.01, 0.99, 99)])
    for q in (*p.tolist(), *PROBABILITIES):
        assert normal_quantile(q) == pytest.approx(float(special.ndtri(q)), rel=2e-15, abs=1e-16)
    assert (normal_quantile(0.0), normal_quantile(1.0)) == (-math.inf, math.inf)
    assert math.isnan(normal_quantile(-0.1))


@pytest.mark.parametrize("a", SHAPES)
def test_gamma(a: float) -> None:
    for x in (a * np.array([0.0, 0.01, 0.1, 0.5, 0.95, 1.0, 1.05, 1.5, 4.0, math.inf])).tolist():
        for upper, tail in ((False, special.gammainc), (True, special.gammaincc)):
            assert gamma_tail(a, x, upper) == pytest.approx(float(tail(a, x)), rel=2e-12)
    for p in PROBABILITIES:
        for upper, inverse in ((False, special.gammaincinv), (True, special.gammainccinv)):
            assert gamma_quantile(a, p, upper) == pytest.approx(float(inverse(a, p)), rel=1e-12)
    assert [gamma_quantile(a, p, False) for p in (0.0, 1.0)] == [0.0, math.inf]
    assert [gamma_quantile(a, p, True) for p in (0.0, 1.0)] == [math.inf, 0.0]
    assert math.isnan(gamma_quantile(a, 1.1, True))


def test_chi_square_of_the_tables() -> None:
    """NIST/SEMATECH e-handbook, section 1.3.6.7.4: upper critical values."""
    for degrees, probability, bound in ((1, 0.05, 3.841), (3, 0.01, 11.345), (10, 0.001, 29.588)):
        assert chi_square_bound(degrees, probability) == pytest.approx(bound, abs=5e-4)


def test_f() -> None:
    for d, n in ((8.2, 20.0), (9.0, 41.3), (8.0, 300.0), (1.0, 2.0)):
        for x in (0.0, 0.01, 0.5, 1.0, 2.0, 9.0):
            assert f_tail(d, n, x) == pytest.approx(float(special.fdtrc(d, n, x)), rel=1e-12)
        for tail in (1e-6, 0.005, 0.05, 0.5, 0.99):
            # scipy takes the other tail, which has lost digits where this one is small.
            expected = float(special.fdtri(d, n, 1.0 - tail))
            assert f_quantile(d, n, tail) == pytest.approx(expected, rel=1e-10)
        assert (f_quantile(d, n, 0.0), f_quantile(d, n, 1.0)) == (math.inf, 0.0)


def test_noncentral_chi_square() -> None:
    for x in (9.0, 21.955, 60.0):
        for shift in (0.0, 1.0, 30.0, 150.0):
            found = noncentral_chi_square(8.0, shift, x)
            assert found == pytest.approx(float(special.chndtr(x, 8.0, shift)), rel=1e-9)
        for p in (0.01, 0.1, 0.5):
            expected = float(special.chndtrinc(x, 8.0, p))
            assert noncentrality(x, 8.0, p) == pytest.approx(expected, rel=1e-8)
    assert noncentrality(1.0, 8.0, 0.5) == 0.0
