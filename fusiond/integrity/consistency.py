r"""Consistency tests of the innovations of one source against their covariance, online.

    eps(k)  = nu^T(k) S^-1(k) nu(k)                       chi-square, m degrees of freedom   (5)
    average = sum_k eps(k) / (K m)                        K m average: chi-square, K m  (6), (7)
    rho(l)  = sum_k nu(k)^T nu(k-l) / sqrt(sum_k |nu(k)|^2 sum_k |nu(k-l)|^2),  l = 1..8     (8)

nu (m,) innovation, S (m, m) its covariance, K epochs in the window. Every lag has K pairs, as (8)
is printed, so the eight innovations before the window are kept too. In (8) nu is whitened, L^-1 nu
with S = L L^T (any root of S gives the same eps, and the same rho while S is constant); the paper's
form with unwhitened nu is an option.

Verdict at an overall level alpha: two tests, each at 1 - sqrt(1 - alpha). rho does not change when
all innovations are scaled, so it is (but for the window's eight neighbours) independent of their
total and the levels multiply (Basu).

* average: equal-tailed. Innovations beyond the gate are missing from it, so its law is that of
  truncated chi-squares, matched by a gamma law in mean and variance; without gate it is (7).
* whiteness: Q = sum_l rho(l)^2 / var(l) with, to second order in 1/n,

      var(l) = 1 / (n + 2 (1 - l/K)),    n = K m

  (expand E[c^2 / (A B)]: E[c^2] = n, E[c^2 A] = n (n + 2 + 2 (1 - l/K)), E[A^2] = n^2 + 2n,
  E[A B] = n^2 + 2n (1 - l/K)). E[Q] = 8, but a large rho(1) raises its neighbours, and the tail is
  heavier than chi-square's: Q nu / (8 (nu - 2)) is taken as F(d, nu), d = 8 + 207/n - 1670/n^2, nu
  = 13.6 + 0.277 n, fitted to the upper 5 % of 200,000 windows or more for each of 14 pairs of K (20
  to 200) and m (1 to 3): true within 10 % at a level of 0.005, within 20 % at 0.001.

(5) to (8): Lin, Meng, He, "double-star/SINS, optimal prediction and consistency"; after Bar-Shalom
and Fortmann, Tracking and Data Association, 1988. Form of Q: Ljung and Box, Biometrika 65, 1978.
The paper uses N(0, 1/K) for rho with any m. That holds for m = 1; for m components of equal
variance it is 1/(K m), in between for others. Unwhitened, 1/K is kept: never too narrow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.navigation.compiled import compiled
from fusiond.navigation.distributions import (
    f_quantile,
    f_tail,
    gamma_quantile,
    gamma_tails,
    gaussian_quantile,
    noncentrality,
)

Array = NDArray[np.float64]
Verdict = Literal["consistent", "optimistic", "pessimistic", "cannot_tell", "coloured", "too_few"]
Interval = tuple[float, float]

WORDS: tuple[Verdict, ...] = ("consistent", "pessimistic", "optimistic", "coloured", "too_few")
LAGS = 8
"""Lags of the paper's test."""
FEWEST = 20
"""Fewest epochs for which the law of Q has been checked; below it the verdict is `too_few`."""
INTERVAL_LEVEL = 0.95
"""Confidence level of displayed intervals, as in the paper. The verdict does not use them."""
POWER = 0.9
"""Probability with which the `detectable` figures are detected."""
_LAG = np.arange(1, LAGS + 1)


@immutable()
class ConsistencyOptions:
    """Options of the tests of one source; docs/consistency.md has the figures behind the
    defaults."""

    window: int = 100
    """K, epochs. More see smaller faults, and later."""
    alpha: float = 0.01
    """Rate of false alarms of both tests together: windows of a matched filter that are not
    `consistent`."""
    gate: float = 1.0
    """Probability with which a consistent innovation passed the gate; 1: no gate."""
    whitened: bool = True
    """False: rho of the original innovations, as in the paper; `add` then needs S."""
    shared: bool = False
    """Successive measurements share an error that the filter follows. The solution takes it over,
    so that innovations show nothing of it: small ones are `cannot_tell`, not `pessimistic`."""

    def __post_init__(self) -> None:
        if self.window < FEWEST:
            raise ValueError(f"window {self.window}: at least {FEWEST} epochs")
        if not 0.0 < self.alpha < 1.0:
            raise ValueError(f"alpha {self.alpha}: between 0 and 1")
        if not 0.0 < self.gate <= 1.0:
            raise ValueError(f"gate {self.gate}: a probability above 0")


@immutable()
class Consistency:
    """Results of the tests. A figure is NaN if there are too few epochs for it."""

    verdict: Verdict
    """Verdict of the monitor, with hysteresis; of `judge`, equal to `window_verdict`."""
    window_verdict: Verdict
    """Verdict of this window alone."""
    k: int
    """K, epochs in the window."""
    dof: int
    """K m, degrees of freedom of the average."""
    nis_average: float
    """Normalised innovation squared per degree of freedom; 1 is expected."""
    nis_interval: Interval
    """Interval of the NIS average at INTERVAL_LEVEL."""
    nis_limits: Interval
    """Limits of the NIS average; outside them the verdict is `pessimistic` or `cannot_tell`, or
    `optimistic`."""
    nis_p: float
    """Two-sided p-value of the average."""
    rho: tuple[float, ...]
    """rho(1) .. rho(8)."""
    rho_interval: Interval
    """Interval of rho at one lag, at INTERVAL_LEVEL."""
    portmanteau: float
    """Portmanteau statistic Q; its expectation is 8."""
    portmanteau_limit: float
    """Limit of Q, above which the innovations are coloured."""
    portmanteau_p: float
    alpha: float
    """Overall level of the verdict."""
    detectable_ratio: Interval
    """True NIS averages outside which a share POWER of windows is detected (white innovations)."""
    detectable_rho: float
    """Autocorrelation at a single lag from which a share POWER of windows is detected."""

    @property
    def nis_inside(self) -> bool:
        """True if the average lies in its interval (not its limits)."""
        return self.nis_interval[0] <= self.nis_average <= self.nis_interval[1]

    @property
    def rho_inside(self) -> tuple[bool, ...]:
        """Membership of rho in its interval by lag; one in twenty is outside by chance."""
        return tuple(self.rho_interval[0] <= r <= self.rho_interval[1] for r in self.rho)


_UNKNOWN = (math.nan, math.nan)
TOO_FEW = Consistency(
    verdict="too_few",
    window_verdict="too_few",
    k=0,
    dof=0,
    nis_average=math.nan,
    nis_interval=_UNKNOWN,
    nis_limits=_UNKNOWN,
    nis_p=math.nan,
    rho=(math.nan,) * LAGS,
    rho_interval=_UNKNOWN,
    portmanteau=math.nan,
    portmanteau_limit=math.nan,
    portmanteau_p=math.nan,
    alpha=math.nan,
    detectable_ratio=_UNKNOWN,
    detectable_rho=math.nan,
)


class Limits(NamedTuple):
    """Constants that depend on K, m, alpha and gate only. `scale` of the average's gamma law."""

    shape: float
    scale: float
    nis_limits: Interval
    weights: Array
    freedom: Interval
    rho_interval: Interval
    portmanteau: float


NO_LIMITS = Limits(math.nan, math.nan, _UNKNOWN, np.zeros(LAGS), _UNKNOWN, _UNKNOWN, math.nan)


@lru_cache(maxsize=2048)
def limits_of(k: int, dof: int, alpha: float, gate: float, whitened: bool) -> Limits:
    shape, scale = _average_law(k, dof, gate)
    level = 1.0 - math.sqrt(1.0 - alpha)
    n = dof if whitened else k
    d, nu = 8.0 + 207.0 / n - 1670.0 / n**2, 13.6 + 0.277 * n
    r = -gaussian_quantile((1.0 - INTERVAL_LEVEL) / 2.0) / math.sqrt(n)
    return Limits(
        shape,
        scale,
        _between(shape, scale, level),
        n + 2.0 * (1.0 - _LAG / k),
        (d, nu),
        (-r, r),
        f_quantile(d, nu, level) * LAGS * (nu - 2.0) / nu,
    )


def _between(shape: float, scale: float, outside: float) -> Interval:
    """Bounds of a gamma law with probability `outside`, half of it at either end."""
    return (
        scale * gamma_quantile(shape, outside / 2.0),
        scale * gamma_quantile(shape, outside / 2.0, upper=True),
    )


def _average_law(k: int, dof: int, gate: float) -> tuple[float, float]:
    """Shape and scale of the gamma law of the average of K chi-squares, truncated at the gate."""
    mean, variance = _cut_off(dof / k, gate)
    return k * mean * mean / variance, variance / (mean * dof)


@lru_cache(maxsize=256)
def _cut_off(m: float, gate: float) -> tuple[float, float]:
    """Mean and variance of a chi-square with m degrees, truncated at the gate.

    E[x^j; x < g] = m (m + 2) .. (m + 2j - 2) F_{m+2j}(g).
    """
    g = 2.0 * gamma_quantile(m / 2.0, gate)
    mean = m * gamma_tails(m / 2.0 + 1.0, g / 2.0)[0] / gate
    variance = m * (m + 2.0) * gamma_tails(m / 2.0 + 2.0, g / 2.0)[0] / gate - mean * mean
    return mean, variance


@lru_cache(maxsize=256)
def _told(
    k: int, dof: int, alpha: float, gate: float, whitened: bool
) -> tuple[Interval, Interval, float]:
    """Interval of the average; the NIS ratios and the single lag's rho that are detected with
    POWER."""
    limits = limits_of(k, dof, alpha, gate, whitened)
    low, high = limits.nis_limits
    ratio = (
        low / (limits.scale * gamma_quantile(limits.shape, POWER)),
        high / (limits.scale * gamma_quantile(limits.shape, POWER, upper=True)),
    )
    shift = noncentrality(limits.portmanteau, LAGS, 1.0 - POWER)
    interval = _between(limits.shape, limits.scale, 1.0 - INTERVAL_LEVEL)
    return interval, ratio, min(1.0, math.sqrt(shift / (dof if whitened else k)))


def judge(
    k: int,
    dof: int,
    average: float,
    rho: Sequence[float],
    *,
    alpha: float = 0.01,
    gate: float = 1.0,
    whitened: bool = True,
    shared: bool = False,
) -> Consistency:
    """Judge given figures: K, K m, the average per degree of freedom and rho(1..8) by (8).

    Raises ValueError for figures that no window can have: not 8 lags, K below 1 or above K m. With
    fewer than FEWEST epochs the verdict is `too_few` and no figure is given.
    """
    if len(rho) != LAGS or not 1 <= k <= dof:
        raise ValueError(f"K = {k}, {dof} degrees of freedom, {len(rho)} lags; needs {LAGS} lags")
    if k < FEWEST:
        return replace(TOO_FEW, k=k, dof=dof, alpha=alpha)
    limits = limits_of(k, dof, alpha, gate, whitened)
    interval, ratio, single = _told(k, dof, alpha, gate, whitened)
    values = np.asarray(rho, dtype=float)
    q = float(limits.weights @ (values * values))
    tails = gamma_tails(limits.shape, average / limits.scale)
    d, nu = limits.freedom
    verdict = verdict_of(average, q, limits, shared)
    return Consistency(
        verdict=verdict,
        window_verdict=verdict,
        k=k,
        dof=dof,
        nis_average=average,
        nis_interval=interval,
        nis_limits=limits.nis_limits,
        nis_p=min(1.0, 2.0 * min(tails)),
        rho=tuple(float(r) for r in values),
        rho_interval=limits.rho_interval,
        portmanteau=q,
        portmanteau_limit=limits.portmanteau,
        portmanteau_p=f_tail(d, nu, q * nu / (LAGS * (nu - 2.0))),
        alpha=alpha,
        detectable_ratio=ratio,
        detectable_rho=single,
    )


@compiled("i8(f8, f8, f8, f8, f8)")
def verdict_index(average: float, q: float, low: float, high: float, most_q: float) -> int:
    """Index of the verdict in `WORDS`. The average takes precedence: a covariance that is too small
    is worse than correlation."""
    if average > high:
        return 2
    if average < low:
        return 1
    return 3 if q > most_q else 0


def verdict_of(average: float, q: float, limits: Limits, shared: bool = False) -> Verdict:
    """Verdict of a window; with a `shared` error small innovations are no evidence."""
    return word(verdict_index(average, q, *limits.nis_limits, limits.portmanteau), shared)


def word(index: int, shared: bool) -> Verdict:
    """Verdict, one of `WORDS`."""
    return "cannot_tell" if shared and WORDS[index] == "pessimistic" else WORDS[index]


def whiten(nu: Array, s: Array) -> Array:
    """L^-1 nu (m,) with S = L L^T (m, m). Raises LinAlgError when S is not positive definite."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(s), nu), dtype=float)
