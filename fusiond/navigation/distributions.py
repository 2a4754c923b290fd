r"""Tails and quantiles of distributions for gates, verdicts and protection levels.

Gamma law of shape a and scale 1, P(a, x) + Q(a, x) = 1, with delta = x/a - 1:

    D = x^a e^-x / Gamma(a + 1) = exp(a (ln(1 + delta) - delta)) / (sqrt(2 pi a) S(a))
    P = D (1 + x/(a+1) + x^2/((a+1)(a+2)) + ...)                                      x < a + 1
    Q = a D / (x+1-a - 1(1-a)/(x+3-a - 2(2-a)/(x+5-a - ...)))                         else

where S(a) = Gamma(a + 1) / (sqrt(2 pi a) a^a e^-a) is Stirling's series. So D loses no digits for
any a. F law of d and n degrees of freedom: the tail beyond x is I_y(n/2, d/2) at y = n / (n + d x),
I the incomplete beta function, here its continued fraction. Noncentral chi-square: chi-squares of m
+ 2j degrees, weighted by Poisson's law of mean lambda/2 for j.

A quantile is found by Newton's steps on the logarithm of the smaller tail; bisection replaces a
step that leaves the bracket.

scipy.special has all of these, but loading it takes an eighth of the processor time of a start.

Source: NIST Digital Library of Mathematical Functions, 8.11.4 (series), 8.9.2 (fraction of Q),
5.11.1 (Stirling), 8.17.22 (beta); Abramowitz and Stegun, 26.4.25 (noncentral). The Gaussian
quantile is the standard library's: Wichura, Algorithm AS241, Applied Statistics 37, 1988.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from itertools import count
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

_EPSILON = sys.float_info.epsilon
_TINY = 1e-300  # in place of a denominator of zero (Lentz)
# From here on four terms of Stirling's series leave less than a rounding: 1 / (1188 a^9).
_STIRLING_FROM = 20.0
# Newton's step is quadratic: one below this leaves an error below the rounding of x.
_STEP = 1e-9
# Bisection alone halves 1e-308 .. 1e308 in logarithms to a rounding within so many steps.
_STEPS = 200
_STANDARD = NormalDist()


def gaussian_quantile(p: float) -> float:
    """Quantile of a unit Gaussian variable for the probability `p`; infinite at 0 and 1, NaN
    outside."""
    if 0.0 < p < 1.0:
        return _STANDARD.inv_cdf(p)
    return {0.0: -math.inf, 1.0: math.inf}.get(p, math.nan)


def median(values: NDArray[np.float64]) -> float:
    """Median of values (n,), n > 0; nan if one is. numpy's own imports masked arrays to exclude
    them, which takes as long as linking twenty kernels at the start."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high, -1))
    return float(ordered[-1] if np.isnan(ordered[-1]) else 0.5 * (ordered[low] + ordered[high]))


def gamma_tails(shape: float, x: float) -> tuple[float, float]:
    """P and Q: the probability of less and of more than `x` under the gamma law."""
    if x <= 0.0:
        return 0.0, 1.0
    if math.isinf(x):
        return 1.0, 0.0
    ahead = _ahead(shape, x)
    if x < shape + 1.0:
        p = ahead * _series(shape, x)
        return p, 1.0 - p
    q = ahead * shape / _fraction(shape, x)
    return 1.0 - q, q


def gamma_quantile(shape: float, p: float, upper: bool = False) -> float:
    """Quantile with probability `p` below it, or above it if `upper`."""
    if not 0.0 < p < 1.0:
        return 0.0 if upper == (p >= 1.0) else math.inf

    def tails(x: float) -> tuple[float, float, float]:
        return *gamma_tails(shape, x), _ahead(shape, x) * shape / x

    # Wilson and Hilferty: the cube root of x / a is nearly Gaussian (26.4.17). Near zero only the
    # first term of the series is left.
    z = gaussian_quantile(p)
    root = 1.0 - 1.0 / (9.0 * shape) + (-z if upper else z) / (3.0 * math.sqrt(shape))
    begin = shape * root**3
    if root < 0.4:
        begin = math.exp((math.log(1.0 - p if upper else p) + math.lgamma(shape + 1.0)) / shape)
        if begin < _EPSILON:
            return begin
    return _quantile(tails, p, upper, begin)


def f_tail(d: float, n: float, x: float) -> float:
    """Probability of more than `x` under the F law of `d` and `n` degrees of freedom."""
    return _f_tails(d, n, x)[1]


def f_quantile(d: float, n: float, upper: float) -> float:
    """Quantile of the F law of `d` and `n` degrees of freedom, exceeded with probability
    `upper`."""
    return _quantile(lambda x: _f_tails(d, n, x), upper, True, 1.0)


def noncentrality(x: float, degrees: int, lower: float) -> float:
    """Noncentrality lambda for which a noncentral chi-square variable stays below `x` with
    probability `lower`; 0 if the central one does so more seldom."""

    def tails(shift: float) -> tuple[float, float, float]:
        # In the shift what lies below becomes less: its complement has the places of P and Q.
        below, slope = _noncentral(x, degrees, shift)
        return 1.0 - below, below, slope

    if gamma_tails(0.5 * degrees, 0.5 * x)[0] <= lower:
        return 0.0
    return _quantile(tails, lower, True, max(1.0, x - degrees))


def _ahead(shape: float, x: float) -> float:
    """Factor D."""
    if shape < _STIRLING_FROM:
        return math.exp(shape * math.log(x) - x - math.lgamma(shape + 1.0))
    delta = (x - shape) / shape
    square = shape * shape
    series = (1 / 12 - (1 / 360 - (1 / 1260 - 1 / (1680 * square)) / square) / square) / shape
    log = math.log1p(delta) if abs(delta) < 0.5 else math.log(x / shape)
    power = shape * (log - delta) - series
    return math.exp(power) / math.sqrt(2.0 * math.pi * shape)


def _series(shape: float, x: float) -> float:
    term = total = 1.0
    while term > _EPSILON * total:
        shape += 1.0
        term *= x / shape
        total += term
    return total


def _fraction(shape: float, x: float) -> float:
    def terms() -> Iterator[tuple[float, float]]:
        for k in count(1):
            yield k * (shape - k), x + 2.0 * k + 1.0 - shape

    return _lentz(x + 1.0 - shape, terms())


def _f_tails(d: float, n: float, x: float) -> tuple[float, float, float]:
    """Probabilities below and above `x`, and the density there."""
    if x <= 0.0:
        return 0.0, 1.0, 0.0
    a, b = 0.5 * d, 0.5 * n
    y, rest = d * x / (d * x + n), n / (d * x + n)
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    ahead = math.exp(a * math.log(y) + b * math.log(rest) - log_beta)
    density = ahead / x
    if y < (a + 1.0) / (a + b + 2.0):
        p = ahead / (a * _beta_fraction(a, b, y))
        return p, 1.0 - p, density
    q = ahead / (b * _beta_fraction(b, a, rest))
    return 1.0 - q, q, density


def _beta_fraction(a: float, b: float, y: float) -> float:
    def terms() -> Iterator[tuple[float, float]]:
        for m in count(0):
            yield -(a + m) * (a + b + m) * y / ((a + 2 * m) * (a + 2 * m + 1)), 1.0
            k = m + 1
            yield k * (b - k) * y / ((a + 2 * k - 1) * (a + 2 * k)), 1.0

    return _lentz(1.0, terms())


def _lentz(first: float, terms: Iterator[tuple[float, float]]) -> float:
    """Continued fraction first + a1/(b1 + a2/(b2 + ...)) of `terms` (a, b), by Lentz's method as
    modified by Thompson and Barnett."""
    value = above = first or _TINY
    below = 0.0
    for a, b in terms:
        below = 1.0 / (b + a * below or _TINY)
        above = b + a / above or _TINY
        value *= above * below
        if not abs(above * below - 1.0) > _EPSILON:  # or it is no number
            break
    return value


def _noncentral(x: float, degrees: int, shift: float) -> tuple[float, float]:
    """Probability of less than `x`, and its decrease with `shift`."""
    a, h = 0.5 * degrees, 0.5 * x
    weight = math.exp(-0.5 * shift)
    p = gamma_tails(a, h)[0]
    term = _ahead(a, h)  # P(a, h) - P(a + 1, h)
    below = slope = 0.0
    j = 0
    while True:
        j += 1
        below += weight * p
        slope += weight * term
        if j > 0.5 * shift and not weight * p > _EPSILON * below:
            return below, 0.5 * slope
        weight *= 0.5 * shift / j
        p, a = p - term, a + 1.0
        term *= h / a


def _quantile(
    tails: Callable[[float], tuple[float, float, float]], p: float, upper: bool, x: float
) -> float:
    """Quantile at which `tails` (below, above, density) has `p` below, or above if `upper`;
    iteration from `x`."""
    # The smaller one of the two tails is known to its last digit.
    which = int(upper != (p > 0.5))
    sign, tail = (-1.0 if which else 1.0), (1.0 - p if p > 0.5 else p)
    least, most = 0.0, math.inf
    for _ in range(_STEPS):
        found = tails(x)
        if sign * (found[which] - tail) > 0.0:
            most = x
        else:
            least = x
        step = math.nan
        if found[which] > 0.0 and found[2] > 0.0:
            step = -sign * found[which] * math.log(found[which] / tail) / found[2]
        near = x + step
        if abs(step) <= _STEP * x:
            return near
        if not least < near < most:
            near = 2.0 * x if math.isinf(most) else 0.5 * (least + most)
            if near in (least, most):
                return x
        x = near
    return x
