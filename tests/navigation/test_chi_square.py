"""Quantiles against those of scipy, which gates do without."""

from __future__ import annotations

import math

import pytest
from scipy.special import chdtri

from fusiond.navigation.chi_square import quantile

TAILS = (
    *(1e-300, 1e-60, 1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9),
    0.99,
)


@pytest.mark.parametrize("degrees", [*range(1, 33), 59, 60, 99, 150, 299, 300, 301, 2000])
def test_quantiles_are_those_of_scipy(degrees: int) -> None:
    for tail in TAILS:
        assert quantile(degrees, tail) == pytest.approx(float(chdtri(degrees, tail)), rel=1e-12)


@pytest.mark.parametrize("degrees", [1, 2, 3, 9, 40])
def test_what_nearly_everything_exceeds_is_found_to_the_digits_that_the_tail_has(
    degrees: int,
) -> None:
    for tail in (1.0 - 1e-6, 1.0 - 1e-9):
        assert quantile(degrees, tail) == pytest.approx(float(chdtri(degrees, tail)), rel=1e-6)


@pytest.mark.parametrize(("degrees", "tail"), [(0, 0.1), (3, -0.1), (3, 1.0), (3, float("nan"))])
def test_what_is_no_question_is_refused(degrees: int, tail: float) -> None:
    with pytest.raises(ValueError, match="degrees of freedom"):
        quantile(degrees, tail)


def test_no_tail_is_exceeded_by_nothing() -> None:
    assert quantile(3, 0.0) == math.inf
