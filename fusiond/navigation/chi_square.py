r"""Quantiles of the chi-square law, for gates.

For n degrees of freedom and h = x / 2 the tail has a closed form,

    Q(x) = sum_{k=0}^{n/2-1} h^k e^-h / k!                                           n even
    Q(x) = erfc(sqrt h) + sum_{k=0}^{(n-3)/2} h^{k+1/2} e^-h / Gamma(k + 3/2)        n odd

and its slope is -h^{n/2-1} e^-h / (2 Gamma(n/2)). Newton's steps on ln Q, which is concave from
n = 2 on and nearly a line far out, begin at the approximation of Wilson and Hilferty.

Where gates seldom are, beyond `_MOST_DEGREES` and below `_LEAST_TAIL`, the sums above lose their
digits or their range: there it is twice the quantile of a gamma law of shape n / 2.

Source: Abramowitz and Stegun, 26.4.4, 26.4.5 (tail) and 26.4.17 (beginning).
"""

from __future__ import annotations

import math
import sys
from functools import lru_cache

from fusiond.navigation.distributions import gamma_quantile

# Newton's step is quadratic: one below this leaves an error below the rounding of x.
_STEP = 1e-9
# So near to one a tail is told from its neighbours no better.
_ROUNDING = 4.0 * sys.float_info.epsilon
# Tails from 1e-15 to 0.99 need eight steps at most up to 300 degrees of freedom; nearer to one the
# last digits of the tail decide, and more of them change nothing.
_MOST_DEGREES, _LEAST_TAIL = 300, 1e-15
_STEPS = 40


@lru_cache(maxsize=1024)
def quantile(degrees: int, tail: float) -> float:
    """Quantile of a chi-square variable of `degrees` degrees of freedom, exceeded with probability
    `tail`.

    Infinite for a tail of 0, to which 1 - (1 - 1e-17) rounds. Raises ValueError for degrees below
    one or a tail that is no probability below 1.
    """
    if degrees < 1 or not 0.0 <= tail < 1.0:
        raise ValueError(f"{degrees} degrees of freedom, tail {tail}")
    if tail == 0.0:
        return math.inf
    if degrees > _MOST_DEGREES or tail < _LEAST_TAIL:
        return 2.0 * gamma_quantile(0.5 * degrees, tail, upper=True)
    x = _near(degrees, tail)
    for _ in range(_STEPS):
        q, slope = _tail(degrees, x)
        step = q * math.log(q / tail) / slope
        x = min(max(0.1 * x, x + step), 3.0 * x)  # where the tail is flat a step leads anywhere
        if abs(step) <= _STEP * x or abs(q - tail) <= _ROUNDING * tail:
            break
    return x


def _tail(degrees: int, x: float) -> tuple[float, float]:
    """Tail probability Q(x) and the magnitude of its derivative."""
    h = 0.5 * x
    half = 0.5 * degrees
    if degrees % 2:
        term, q = math.exp(-h) * math.sqrt(h) / math.gamma(1.5), math.erfc(math.sqrt(h))
        for k in range((degrees - 1) // 2):
            q += term
            term *= h / (k + 1.5)
    else:
        term, q = math.exp(-h), 0.0
        for k in range(degrees // 2):
            q += term
            term *= h / (k + 1.0)
    return q, 0.5 * math.exp((half - 1.0) * math.log(h) - h - math.lgamma(half))


def _near(degrees: int, tail: float) -> float:
    """The quantile to some per cent: the cube root of x / n is nearly Gaussian."""
    z = _gaussian(min(tail, 1.0 - tail))
    z = z if tail < 0.5 else -z
    spread = 2.0 / (9.0 * degrees)
    return float(degrees * max(0.05, 1.0 - spread + z * math.sqrt(spread)) ** 3)


def _gaussian(tail: float) -> float:
    """The Gaussian quantile to 4.5e-4 (Abramowitz and Stegun, 26.2.23); `tail` up to a half."""
    t = math.sqrt(-2.0 * math.log(tail))
    above = 2.515517 + t * (0.802853 + t * 0.010328)
    return t - above / (1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308)))
