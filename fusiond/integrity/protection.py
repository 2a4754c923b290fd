r"""Protection levels of a filter by solution separation, at a stated risk.

Modes: no fault (k = 0), and a fault of device k, of any size, shape and duration. The solution x_k
without that device is free of it (fusiond.estimators.separation). For each axis q

    T_k = K_fa sqrt([P_k - P_0]_qq),   K_fa = Q^-1(P_fa / (2 A N n)),   T_0 = 0

with A axes, N modes and n independent samples an hour. For any fault of the device,

    |error of x_0| <= |x_k - x_0| + |error of x_k|

so PL* of the first equation bounds the error if the separation is below T_k, and PL of the second
always:

    sum_k 2 p_k Q((PL* - T_k) / sigma_k) = (R - P_not_monitored) share_q / n,    p_0 = 1
    PL = max over k of  max(T_k, |x_k - x_0|_q) + PL* - T_k

R is the integrity risk of an hour, half of it for the vertical, a quarter for north and east each;
HPL^2 = PL_n^2 + PL_e^2. p_k is the probability that device k is at fault at some time of the hour.
The bound uses only the separation and does not depend on any decision, so it holds before the fault
is detected, when it is, and after its exclusion. Two devices at fault in the same hour are not
monitored: p_j p_k of each pair is subtracted from R; if that exceeds R there is no bound.

The terms are two-sided, while the Working Group C algorithm (fusiond.integrity.araim) has Q for
faults: a fault leaves x_k's error symmetric, and 2 Q needs no argument about the fault's sign.

Source: Brenner, NAVIGATION 43 (1996), 111; Blanch et al., IEEE Trans. AES 51 (2015), 713, eq. 20
to 27; independent samples in the risk of an hour: Milner, Pervan, Blanch, Joerger, Evaluating
integrity and continuity over time in advanced RAIM, PLANS 2020.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.integrity.araim import protection_level
from fusiond.navigation.distributions import gaussian_quantile

Array = NDArray[np.float64]

INDEPENDENT_PER_HOUR = 3600.0
"""Independent samples an hour: one a second. Errors of an aided filter last longer, 24 s in the
study `protection`, or 150 an hour; more samples raise the level, here by a tenth."""
AXIS_SHARE = (0.25, 0.25, 0.5)
"""Shares of the risk north, east, down: half to the horizontal, half to the vertical."""


@immutable()
class IntegrityRisk:
    """Allowed risk and fault priors: `risk` of an error beyond the level and `false_alarm` of a
    separation beyond its threshold, each an hour; `priors` (devices,)."""

    risk: float
    false_alarm: float
    priors: tuple[float, ...]

    @property
    def monitored(self) -> float:
        """Integrity risk minus the probability of simultaneous faults; may be negative."""
        return self.risk - sum(math.prod(pair) for pair in combinations(self.priors, 2))


class Level(NamedTuple):
    """Protection level (m) of one axis, and the devices (k,) beyond the separation threshold."""

    level_m: float
    apart: NDArray[np.bool_]


def axis_level(variance: Array, separation: Array, share: float, limits: IntegrityRisk) -> Level:
    """Protection level of an axis: `variance` (1 + k,) m^2 of all measurements and of the subsets,
    `separation` (k,) m of the subsets, `share` of the risk. Infinite if there is no bound."""
    sigma = np.sqrt(variance)
    k_fa = -gaussian_quantile(
        limits.false_alarm
        / (2.0 * len(AXIS_SHARE) * max(1, len(separation)) * INDEPENDENT_PER_HOUR)
    )
    # Gates differ: a subset may have taken more than the whole.
    threshold = k_fa * np.sqrt(np.maximum(0.0, variance[1:] - variance[0]))
    offset = np.concatenate([[0.0], threshold])
    weight = 2.0 * np.concatenate([[1.0], limits.priors])
    least = protection_level(weight, offset, sigma, limits.monitored * share / INDEPENDENT_PER_HOUR)
    beyond = np.maximum(0.0, np.abs(separation) - threshold)
    return Level(least + float(beyond.max(initial=0.0)), beyond > 0.0)


class FilterProtection(NamedTuple):
    """Horizontal and vertical protection level (m; vertical None if the model holds the height;
    infinite without a bound), and the devices (k,) whose separation is beyond the threshold."""

    hpl_m: float
    vpl_m: float | None
    apart: NDArray[np.bool_]


def filter_protection(
    covariances: Array, separations: Array, limits: IntegrityRisk, vertical: bool = True
) -> FilterProtection:
    """Protection levels from covariances (1 + k, 3, 3), m^2, and separations (k, 3), m, north,
    east, down."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    north, east, *down = (
        axis_level(variances[:, q], separations[:, q], AXIS_SHARE[q], limits)
        for q in range(3 if vertical else 2)
    )
    apart = np.logical_or.reduce([level.apart for level in (north, east, *down)])
    return FilterProtection(
        math.hypot(north.level_m, east.level_m), down[0].level_m if down else None, apart
    )
