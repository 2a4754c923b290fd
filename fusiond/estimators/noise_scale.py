r"""Scale of a series' stated noise variance, estimated from its innovations.

Whitened innovations y (d,) of a series are N(0, I) and white while filter and series are as
modelled. If the series states too little, or if its errors are correlated, their long-run variance
exceeds one, component by component,

    s = gamma_0 + 2 sum_k (1 - k / (K + 1)) gamma_k,    gamma_k = E[u_i u_(i-k)],   u = y sqrt(s)

and white errors of s times the stated variance have the same sums, which matter for a filter with a
memory longer than the correlation. Only s above one is used: a receiver that states too little gets
less weight, one that states too much keeps its value. The estimate itself scatters, with white
innovations by

    var(s) = (2 + 4 sum_k (1 - k / (K + 1))^2) / N = 12.1 / N

so that max(1, s) would be too large by 0.4 of its sigma on average for a series that states its
true variance: 0.08 after 300 innovations. So the non-negative garrote is used,

    1 + (s - 1) (1 - (2 sigma_s / (s - 1))^2)    where s - 1 is more than 2 sigma_s, else 1

whose mean is then too large by 0.016 sigma_s, and which keeps large s.

Recent innovations may be the start of a fault: they count when they are `WAITS_NS` old, and not at
all if the series has left service meanwhile.

Source: Bartlett's estimate of a spectrum at zero, as Newey and West, Econometrica 55 (1987), 703;
Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Trans. AC 15 (1970);
Breiman, Better subset regression using the nonnegative garrote, Technometrics 37 (1995), 373.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]

LAGS = 8
COUNT = 600.0
"""Innovations that are averaged: two minutes of 5 Hz."""
PRIOR_COUNT = 60.0
"""Weight of the stated variance: the estimate scatters by half of itself then."""
WAITS_NS = 15_000_000_000
"""Delay of the estimate; a drift of 0.1 m/s is found within twice this, and a longer delay hides
nothing."""
MOST = 100.0
"""Largest scale of a variance: ten times the sigma. A larger one is not noise."""
SURE = 2.0
"""Sigmas of its scatter by which a scale must exceed one to be used."""
SCATTER = 2.0 + 4.0 * sum((1.0 - k / (LAGS + 1.0)) ** 2 for k in range(1, LAGS + 1))
"""Variance of s of one series of white innovations, times their number."""
_ROWS = 3
# The array of a series: scales (3); how many innovations are learned from, wait, and have come
# since (s), how many the ring holds; sums of the lags of those three, (3, K + 1) each; the ring.
_LEARNED, _WAITING, _NEW_COUNT, _SINCE, _HELD = 3, 4, 5, 6, 7
_SUMS = 8
_LAGS = _ROWS * (LAGS + 1)
_WAITS = _SUMS + _LAGS
_NEW = _WAITS + _LAGS
_RING = _NEW + _LAGS
SIZE = _RING + _ROWS * LAGS


def unlearned() -> Array:
    """Series without any estimate."""
    packed = np.zeros(SIZE)
    packed[:_ROWS] = 1.0
    return packed


@compiled("void(f8[::1])", forceinline=True)
def _settle(packed: Array) -> None:
    """Apply the waiting sums; the present ones wait next."""
    n = packed[_WAITING]
    learned = packed[_LEARNED]
    keep = 1.0 if learned == 0.0 or learned + n <= COUNT else max(0.0, COUNT - n) / learned
    for j in range(_LAGS):
        packed[_SUMS + j] = keep * packed[_SUMS + j] + packed[_WAITS + j]
        packed[_WAITS + j], packed[_NEW + j] = packed[_NEW + j], 0.0
    packed[_LEARNED] = keep * learned + n
    packed[_WAITING], packed[_NEW_COUNT] = packed[_NEW_COUNT], 0.0
    total = packed[_LEARNED] + PRIOR_COUNT
    chance = SURE * SURE * SCATTER * packed[_LEARNED] / (total * total)
    for i in range(_ROWS):
        at = _SUMS + i * (LAGS + 1)
        s = (packed[at] + PRIOR_COUNT) / total
        for k in range(1, LAGS + 1):
            s += 2.0 * (1.0 - k / (LAGS + 1.0)) * packed[at + k] / total
        beyond = s - 1.0
        packed[i] = 1.0
        if beyond > 0.0 and beyond * beyond > chance:
            packed[i] = min(1.0 + beyond - chance / beyond, MOST)


@compiled("void(f8[::1], f8, f8, f8, f8, i8)")
def learn(packed: Array, t_s: float, y0: float, y1: float, y2: float, rows: int) -> None:
    """Add an innovation of so many rows at `t_s`, whitened with the present scales."""
    if packed[_NEW_COUNT] == 0.0:
        packed[_SINCE] = t_s
    elif t_s - packed[_SINCE] >= WAITS_NS * 1e-9:
        _settle(packed)
        packed[_SINCE] = t_s
    y = (y0, y1, y2)
    held = int(packed[_HELD])
    for i in range(rows):
        u = y[i] * np.sqrt(packed[i])
        at = _NEW + i * (LAGS + 1)
        packed[at] += u * u
        for k in range(1, min(held, LAGS) + 1):
            packed[at + k] += u * packed[_RING + _ROWS * ((held - k) % LAGS) + i]
    for i in range(rows):
        packed[_RING + _ROWS * (held % LAGS) + i] = y[i] * np.sqrt(packed[i])
    packed[_HELD] = held + 1.0
    packed[_NEW_COUNT] += 1.0


@compiled("void(f8[::1])")
def forget_lately(packed: Array) -> None:
    """Discard the waiting rows, which belong to a fault."""
    for j in range(_LAGS):
        packed[_WAITS + j] = packed[_NEW + j] = 0.0
    packed[_WAITING] = packed[_NEW_COUNT] = packed[_HELD] = 0.0
