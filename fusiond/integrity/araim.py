r"""Advanced RAIM: fault modes, solution separation, protection levels and exclusion of one epoch.

    y = G x + e,   x = [position (3), a clock for each constellation]
    S(k) = (G^T W(k) G)^-1 G^T W(k)

Satellite i has e_i ~ N(b_i, C_int,i) with |b_i| <= b_nom,i for integrity and N(., C_acc,i) for
accuracy and false alarms; W(k) is C_int^-1 with the satellites of fault mode k taken out, k = 0 is
all in view. An event is a fault of a satellite (P_sat) or of a whole constellation (P_const); a
mode is a set of events that come together,

    p_k = prod(P_e, e in k) prod(1 - P_e, e not in k)

Monitored are the modes of at most r events, r the least for which P(more than r) <= P_thres; the
rest, and modes that leave too few satellites for a solution, are `not_monitored`. Modes that leave
the same satellites are one. For each axis q, with Q the tail of N(0, 1) and N the number of modes:

    sigma_k^2  = [(G^T W(k) G)^-1]_qq            b_k = sum_i |S(k)_qi| b_nom,i
    sigma_ss^2 = [(S(k) - S(0)) C_acc (S(k) - S(0))^T]_qq
    T_k = K_fa sigma_ss,   K_fa = Q^-1(P_fa,V / 2 N),   horizontal axes each Q^-1(P_fa,H / 4 N)
    test: |x(k) - x(0)|_q <= T_k for all k and q

    2 Q((VPL - b_0) / sigma_0) + sum_k p_k Q((VPL - T_k - b_k) / sigma_k)
        = P_HMI,V (1 - P_not_monitored / (P_HMI,V + P_HMI,H))

If the exposure holds n independent samples, as an hour does, fault probabilities remain those of
the exposure, and P_HMI - P_not_monitored and P_fa are divided by n.

HPL is the root of the sum of squares of two such levels with half of P_HMI,H each. The effective
monitor threshold is EMT = max T_k (vertical) over the modes of p_k >= P_EMT.

Exclusion: if a test fails, modes are tried by number of satellites, then by the residuals that
remain. The first mode whose remaining satellites pass their own tests is excluded. A wrong
exclusion may be hazardous, too, so the risk is divided: half of it to all in view, the rest evenly
to the modes that could be excluded. Each level bounds the error for any choice, so their sum holds.

Not implemented of the reference: consolidation of rare satellite faults into constellation faults,
which only saves modes, and optimisation of the weights.

Source: EU-US Cooperation on Satellite Navigation, Working Group C, ARAIM Technical Subgroup,
Reference Airborne Algorithm Description Document, v3.0 (2017) and v3.1 (2019); Blanch et al.,
Baseline advanced RAIM user algorithm and possible improvements, IEEE Trans. AES 51 (2015), 713.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.immutable import immutable
from fusiond.navigation.chi_square import quantile
from fusiond.navigation.distributions import gaussian_quantile

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

VERTICAL = 2
"""The third axis; the first two are horizontal."""
_ROOT_2 = math.sqrt(2.0)
MAX_CONDITION = 1e5
"""Largest condition number of G without a mode's satellites; beyond it 1 m of range is kilometres.
"""
ALL_IN_VIEW_SHARE = 0.5
"""Share of the integrity risk for the all-in-view solution where exclusion may follow: half, since
neither event is preferred."""


@immutable()
class Requirement:
    """Allowed risks, as probabilities over the same exposure as the priors: an approach, an hour.
    It holds so many independent `samples`. `tolerance_m` is that of a protection level."""

    vertical_risk: float
    horizontal_risk: float
    vertical_false_alarm: float
    horizontal_false_alarm: float
    residual_false_alarm: float
    unmonitored_risk: float
    effective_monitor_prior: float
    tolerance_m: float = 1e-3
    samples: float = 1.0


LPV_200 = Requirement(9.8e-8, 2e-9, 3.9e-6, 9e-8, 1e-8, 8e-8, 1e-5)
"""Approaches with vertical guidance down to 200 ft: the reference's table of constants."""


@immutable()
class Epoch:
    """Satellites of one epoch with their errors and fault probabilities.

    `line_of_sight` (n, 3): from receiver to satellite in level axes, the vertical one last;
    `constellation` (n,) indices from 0; `integrity_sigma_m` (URA, troposphere and receiver),
    `accuracy_sigma_m` (URE in place of URA) and `nominal_bias_m`, each (n,); `satellite_prior` (n,)
    and `constellation_prior` (constellations,) probabilities of a fault.
    """

    line_of_sight: Array
    constellation: NDArray[np.int64]
    integrity_sigma_m: Array
    accuracy_sigma_m: Array
    nominal_bias_m: Array
    satellite_prior: Array
    constellation_prior: Array

    def without(self, out: Mask) -> Epoch:
        """The epoch without the satellites marked in `out` (n,)."""
        keep = ~out
        return Epoch(
            self.line_of_sight[keep],
            self.constellation[keep],
            self.integrity_sigma_m[keep],
            self.accuracy_sigma_m[keep],
            self.nominal_bias_m[keep],
            self.satellite_prior[keep],
            self.constellation_prior,
        )

    @property
    def design(self) -> Array:
        """G (n, 3 + constellations)."""
        clocks = np.arange(len(self.constellation_prior)) == self.constellation[:, None]
        return np.hstack([-self.line_of_sight, clocks.astype(float)])


class FaultMode(NamedTuple):
    """Fault mode: the satellites (n,) that it removes, and its probability."""

    out: Mask
    prior: float


class Separation(NamedTuple):
    """Solutions by mode, all in view first, and axis: gain S (m, 3, n), sigma, bias, sigma of the
    separation and test threshold (m, 3)."""

    gain: Array
    sigma: Array
    bias: Array
    separation_sigma: Array
    threshold: Array


class Protection(NamedTuple):
    """Protection levels (m), infinite without a bound, with their intermediate results."""

    hpl_m: float
    vpl_m: float
    effective_monitor_threshold_m: float
    vertical_accuracy_m: float
    not_monitored: float
    modes: tuple[FaultMode, ...]
    separation: Separation


class Detection(NamedTuple):
    """Largest separation |x(k) - x(0)| over its threshold; the sum of squared residuals and its
    bound (infinite without redundancy)."""

    largest_ratio: float
    residual: float
    residual_bound: float

    @property
    def passed(self) -> bool:
        return self.largest_ratio <= 1.0 and self.residual <= self.residual_bound


class Exclusion(NamedTuple):
    """Satellites excluded (n,) from the epoch, and the protection of the rest."""

    out: Mask
    protection: Protection


def protection_level(
    weight: Array, offset: Array, sigma: Array, risk: float, tolerance_m: float = 1e-3
) -> float:
    """Smallest level, rounded up by at most `tolerance_m`, with sum weight Q((level - offset) /
    sigma) <= risk; weight, offset and sigma (m,).

    By bisection. Lower bound: the level that the largest single term needs. Upper bound: no term
    exceeds its equal part of the risk. Infinite if risk is not positive or a sigma not finite.
    """
    if not (risk > 0.0 and np.isfinite(sigma).all() and np.isfinite(offset).all()):
        return math.inf
    terms = [t for t in zip(weight.tolist(), offset.tolist(), sigma.tolist(), strict=True) if t[0]]
    each = risk / len(terms) if terms else risk
    low = max([0.0, *(_level_of(t, risk) for t in terms)])
    high = max([0.0, *(_level_of(t, each) for t in terms)])
    if _risk_of(terms, low) <= risk:
        return low
    while high - low > tolerance_m:
        middle = 0.5 * (low + high)
        if _risk_of(terms, middle) > risk:
            low = middle
        else:
            high = middle
    return high


def _risk_of(terms: list[tuple[float, float, float]], level: float) -> float:
    """sum weight Q((level - offset) / sigma)."""
    return 0.5 * sum(w * math.erfc((level - o) / (s * _ROOT_2)) for w, o, s in terms)


def _level_of(term: tuple[float, float, float], risk: float) -> float:
    """Level at which one term alone has `risk`; minus infinity where its risk is always smaller."""
    weight, offset, sigma = term
    return offset - gaussian_quantile(min(1.0, risk / weight)) * sigma


def fault_modes(epoch: Epoch, unmonitored_risk: float) -> tuple[tuple[FaultMode, ...], float]:
    """Modes to be monitored, and the probability of all others."""
    present = np.unique(epoch.constellation).tolist()
    members = [epoch.constellation == c for c in present]
    outs = [*np.eye(len(epoch.constellation), dtype=bool), *members]
    priors = [*epoch.satellite_prior.tolist(), *epoch.constellation_prior[present].tolist()]
    events = [(out, p) for out, p in zip(outs, priors, strict=True) if p > 0.0]
    found: dict[bytes, FaultMode] = {}
    healthy = math.prod(1.0 - p for _, p in events)
    left = 1.0 - healthy
    for count in range(1, _most_events([p for _, p in events], unmonitored_risk) + 1):
        for chosen in combinations(events, count):
            out = np.logical_or.reduce([o for o, _ in chosen])
            prior = healthy * math.prod(p / (1.0 - p) for _, p in chosen)
            key = out.tobytes()
            found[key] = FaultMode(out, prior + (found[key].prior if key in found else 0.0))
            left -= prior
    return tuple(found.values()), max(0.0, left)


def _most_events(priors: Sequence[float], risk: float) -> int:
    """Smallest number of independent events that is exceeded with probability `risk` at most."""
    # Probabilities of 0, 1, ... events, one event after another.
    count = np.array([1.0])
    for p in priors:
        count = np.append(count, 0.0) * (1.0 - p) + np.insert(count, 0, 0.0) * p
    beyond = np.append(np.cumsum(count[::-1])[::-1][1:], 0.0)
    return int(np.argmax(beyond <= risk))


def protect(epoch: Epoch, requirement: Requirement) -> Protection | None:
    """Protection levels of the epoch, before any measurement; None without a solution."""
    design, everything = epoch.design, np.zeros(len(epoch.constellation), dtype=bool)
    variance = epoch.integrity_sigma_m**2
    first = _solve(design, variance, everything)
    if first is None:
        return None
    modes, not_monitored = fault_modes(epoch, requirement.unmonitored_risk)
    kept, solutions = [], [first]
    for mode in modes:
        solution = _solve(design, variance, mode.out)
        if solution is None:
            not_monitored += mode.prior
        else:
            kept.append(mode)
            solutions.append(solution)
    gain = np.array([s for s, _ in solutions])
    accuracy = epoch.accuracy_sigma_m**2
    separation_sigma = np.sqrt(((gain - gain[0]) ** 2) @ accuracy)
    number = max(1, len(kept))
    tests = number * requirement.samples
    k_horizontal = -gaussian_quantile(requirement.horizontal_false_alarm / (4.0 * tests))
    k_vertical = -gaussian_quantile(requirement.vertical_false_alarm / (2.0 * tests))
    threshold = separation_sigma * np.array([k_horizontal, k_horizontal, k_vertical])
    separation = Separation(
        gain,
        np.array([s for _, s in solutions]),
        np.abs(gain) @ epoch.nominal_bias_m,
        separation_sigma,
        threshold,
    )
    prior = np.array([mode.prior for mode in kept])
    horizontal, vertical = requirement.horizontal_risk, requirement.vertical_risk
    share = (1.0 - not_monitored / (horizontal + vertical)) / requirement.samples
    weight = np.concatenate([[2.0], prior])
    north, east, down = (
        protection_level(
            weight,
            threshold[:, q] + separation.bias[:, q],
            separation.sigma[:, q],
            risk * share,
            requirement.tolerance_m,
        )
        for q, risk in enumerate((horizontal / 2.0, horizontal / 2.0, vertical))
    )
    likely = np.concatenate([[False], prior >= requirement.effective_monitor_prior])
    return Protection(
        math.hypot(north, east),
        down,
        float(threshold[likely, VERTICAL].max(initial=0.0)),
        math.sqrt(float(gain[0, VERTICAL] ** 2 @ accuracy)),
        not_monitored,
        tuple(kept),
        separation,
    )


def _solve(design: Array, variance: Array, out: Mask) -> tuple[Array, Array] | None:
    """Gain S (3, n) without the satellites in `out` (n,), and one sigma (3,); None without
    solution."""
    keep = ~out
    used = np.append([True, True, True], design[keep, 3:].any(axis=0))
    g = design[np.ix_(keep, used)]
    if len(g) < g.shape[1] or np.linalg.cond(g) > MAX_CONDITION:
        return None
    weighted = g.T / variance[keep]
    covariance = np.linalg.inv(weighted @ g)
    gain = np.zeros((3, len(out)))
    gain[:, keep] = (covariance @ weighted)[:3]
    return gain, np.sqrt(np.diag(covariance)[:3])


def detect(epoch: Epoch, protection: Protection, y: Array, requirement: Requirement) -> Detection:
    """Test the measurements y (n,), relative to a linearisation point, for mutual consistency.

    The sum of squared residuals is a sanity check: a fault outside the modes shows there.
    """
    gain, threshold = protection.separation.gain, protection.separation.threshold
    separations = np.abs((gain[1:] - gain[0]) @ y)
    ratio = np.divide(
        separations, threshold[1:], out=np.zeros_like(separations), where=threshold[1:] > 0.0
    )
    residual, degrees = _residual(epoch, y)
    false_alarm = requirement.residual_false_alarm / requirement.samples
    bound = quantile(degrees, false_alarm) if degrees else math.inf
    return Detection(float(ratio.max(initial=0.0)), residual, bound)


def _residual(epoch: Epoch, y: Array) -> tuple[float, int]:
    """Sum of squared residuals over C_acc, and its degrees of freedom."""
    design = epoch.design
    used = np.append([True, True, True], design[:, 3:].any(axis=0))
    root = 1.0 / epoch.accuracy_sigma_m
    g, z = design[:, used] * root[:, None], y * root
    left = z - g @ np.linalg.lstsq(g, z, rcond=None)[0]
    return float(left @ left), max(0, g.shape[0] - g.shape[1])


def exclude(epoch: Epoch, requirement: Requirement, y: Array) -> Exclusion | None:
    """Exclude satellites that contradict the measurements y (n,), relative to a linearisation
    point; no satellite if all agree. None where no fault mode explains y, or without a solution."""
    whole = protect(epoch, shared(requirement, ALL_IN_VIEW_SHARE))
    if whole is None:
        return None
    nothing = np.zeros(len(y), dtype=bool)
    if detect(epoch, whole, y, requirement).passed:
        return Exclusion(nothing, whole)
    candidates = []
    for mode in whole.modes:
        residual, degrees = _residual(epoch.without(mode.out), y[~mode.out])
        if degrees:
            candidates.append((int(mode.out.sum()), residual / degrees, mode.out))
    part = shared(requirement, (1.0 - ALL_IN_VIEW_SHARE) / max(1, len(whole.modes)))
    for _, _, out in sorted(candidates, key=lambda c: c[:2]):
        rest = epoch.without(out)
        found = protect(rest, part)
        if found is not None and detect(rest, found, y[~out], requirement).passed:
            return Exclusion(out, found)
    return None


def shared(requirement: Requirement, share: float) -> Requirement:
    """Requirement with a part of the integrity risk and unchanged false alarms."""
    return replace(
        requirement,
        vertical_risk=requirement.vertical_risk * share,
        horizontal_risk=requirement.horizontal_risk * share,
        unmonitored_risk=requirement.unmonitored_risk * share,
    )
