r"""Odds of the hypotheses of a bank, and what they leave open of what the filter publishes.

    log odds            log(rate T) + l / 2 - p log(N) / 2
                        of a kind that is known to be of a size
                        log(rate T) + (e - L m)^T M (e - L m) / 2 - log det(I + S L) / 2
                        + e^T m - m^T L m / 2
    weight              w_f = odds_f / (1 + sum of all odds): the posterior probability; none where
                        a hypothesis does not explain what has come
    left unexplained    J - l against N - p by chi-square's mean and variance
    left open           sum of w_f V_f (M_f + b_f b_f^T) V_f^T: the mixture's second moment about
                        the estimate of the filter, which is that of nothing wrong

Sizes of faults have no one scale, and of kinds that fit alike none is to be accused for the size
that it was expected to have: what p unknowns gain by chance is taken off by the number of rows
alone (Schwarz). The prior of a size bounds its estimate.

Source: as of fusiond.estimators.fault_bank; Schwarz, Estimating the dimension of a model, Annals of
Statistics 6 (1978), 461; Blom, Bar-Shalom, IEEE Trans. AC 33 (1988), 780, for the moments of a
mixture.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    BOUNDED,
    CLASS,
    COUNTS_BY,
    DECIDED,
    DEVICE,
    E_AT,
    EXPLAINED,
    FIRST,
    FOLLOWED,
    GROUP,
    GROUPS,
    J_AT,
    L_AT,
    LASTS_S,
    LEVEL_OF,
    LIKELY,
    LOG_ODDS,
    LOG_RATE,
    MEAN,
    N_AT,
    ONSET,
    PERIODS_S,
    PRIOR,
    RESTARTS,
    SENSITIVITIES,
    SIGNATURE,
    SIZE,
    UNEXPLAINED,
    UNEXPLAINED_SIGMAS,
    WEIGHT,
)
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_TINY = 1e-9
"""A direction that nothing has shown has no evidence: L counts with this much of the prior's."""
MISSED, ALIKE_S = 0.1, 0.25
"""Of what a hypothesis explains so much may be lost by an onset that lies between two restarts: a
drift that began a seventh of its age before or after it loses a twentieth. An onset that is not
missed is as near as half the youngest period."""
SOLVED = 13
"""What `solve` writes."""
MOST_OFF = 3.0
"""Sigmas of its prior by which the size of a kind that is known to be of it may differ."""
LEAST_WEIGHT = 1e-7
"""What is as unlikely opens nothing: of a kilometre a third of a metre."""
# What `judge` writes: the group with the largest odds of those that explain, its log odds, by how
# much it is ahead of any of another class or device, the largest of any that explains, and the
# weight of all.
BEST, BEST_ODDS, AHEAD, EXPLAINS, FAULTY, FOUND = 0, 1, 2, 3, 4, 5


@compiled("f8(f8[::1], i8, f8[::1], f8, f8, f8[::1])", allocates=True)
def solve(group: Array, size: int, numbers: Array, mean: float, share: float, m: Array) -> float:
    """M = (L + share S^-1)^-1 of a group into m (9,), behind it b (3,) for a prior about `mean`,
    and log det(I + S L / share); `numbers` (7,) of its kind. Returns by how much b explains the
    evidence better than nothing wrong does, as log likelihood; by Gauss and Jordan with a positive
    matrix."""
    a = np.empty((3, 6))
    for i in range(size):
        for j in range(size):
            a[i, j] = group[L_AT + 3 * i + j]
            a[i, size + j] = 1.0 if i == j else 0.0
        a[i, i] += share / (numbers[PRIOR + i] * numbers[PRIOR + i])
    logarithm = 0.0
    for k in range(size):
        pivot = a[k, k]
        logarithm += math.log(pivot * numbers[PRIOR + k] * numbers[PRIOR + k] / share)
        for j in range(2 * size):
            a[k, j] /= pivot
        for i in range(size):
            if i != k:
                c = a[i, k]
                for j in range(2 * size):
                    a[i, j] -= c * a[k, j]
    gained = 0.0
    for i in range(size):
        m[9 + i] = mean
        for j in range(size):
            m[3 * i + j] = a[i, size + j]
            beyond = group[E_AT + j]  # e - L m
            for k in range(size):
                beyond -= group[L_AT + 3 * j + k] * mean
            m[9 + i] += a[i, size + j] * beyond
    for i in range(size):
        beyond = group[E_AT + i]
        along = group[E_AT + i] * mean
        for k in range(size):
            beyond -= group[L_AT + 3 * i + k] * mean
            along -= 0.5 * mean * group[L_AT + 3 * i + k] * mean
        gained += 0.5 * beyond * (m[9 + i] - mean) + along
    m[12] = logarithm
    return gained


@compiled("f8(f8[::1], i8[:, ::1], i8, i8)")
def _ahead(bank: Array, ints: Indices, best: int, kind: int) -> float:
    """By how much a group is ahead of those of a kind; infinite where nobody need choose."""
    own, group = best // RESTARTS, bank[GROUPS + best * GROUP :]
    if ints[kind, CLASS] == ints[own, CLASS] and ints[kind, DEVICE] == ints[own, DEVICE]:
        return np.inf
    step = ints[kind, SIGNATURE] <= FOLLOWED
    alike = step == (ints[own, SIGNATURE] <= FOLLOWED)
    fit, ahead, same = 0.0, np.inf, False
    for restart in range(RESTARTS):
        other = bank[GROUPS + (RESTARTS * kind + restart) * GROUP :]
        if other[UNEXPLAINED] > 0.0:
            continue
        ahead = min(ahead, group[LOG_ODDS] - other[LOG_ODDS])
        if other[LOG_ODDS] > 0.0:
            fit = max(fit, other[EXPLAINED])
            same = same or abs(other[ONSET] - group[ONSET]) < ALIKE_S
    if fit > 0.0 and not alike:
        missed = 0.0 if same else MISSED * group[EXPLAINED]
        ahead = min(ahead, 0.5 * (group[EXPLAINED] - fit - missed))
    return ahead


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], f8, f8[::1])", allocates=True)
def judge(bank: Array, ints: Indices, numbers: Array, epoch_s: float, found: Array) -> None:
    """Write log odds, weight and what is left unexplained of each group, and `found` (5,), at an
    epoch of a measurement. A single one accuses whoever is nearest: a hypothesis is found that has
    been likely, and has explained all, for `LASTS_S`.

    It is ahead of another by odds. Between a step of states, which changes what is published, and a
    fault of a source that is likelier than nothing wrong it counts how well each fits, if that is
    less: what fits as well is not told apart by rates alone. Compared are those of one onset; else
    the source's may have lost something.
    """
    kinds = ints.shape[0]
    m = np.empty(SOLVED)
    largest = 0.0
    for kind in range(kinds):
        size = ints[kind, SIZE]
        for restart in range(RESTARTS):
            group = bank[GROUPS + (RESTARTS * kind + restart) * GROUP :]
            group[LOG_ODDS], group[WEIGHT], group[UNEXPLAINED] = -np.inf, 0.0, 0.0
            if group[N_AT] == 0.0:
                continue
            explained = 2.0 * solve(group, size, numbers[kind], 0.0, _TINY, m)
            degrees = max(group[N_AT] - size, 1.0)
            most = degrees + UNEXPLAINED_SIGMAS * math.sqrt(2.0 * degrees)
            group[EXPLAINED] = explained
            group[UNEXPLAINED] = group[J_AT] - explained - most
            gained = 0.5 * explained - 0.5 * size * math.log(group[N_AT])
            mean = numbers[kind, MEAN]
            if numbers[kind, BOUNDED] != 0.0:
                gained = solve(group, size, numbers[kind], mean, 1.0, m) - 0.5 * m[12]
                if abs(m[9] - mean) > MOST_OFF * numbers[kind, PRIOR]:
                    group[UNEXPLAINED] = np.inf  # it is of another size than this kind has
            rate = numbers[kind, LOG_RATE] + math.log(PERIODS_S[LEVEL_OF[restart]])
            group[LOG_ODDS] = rate + group[COUNTS_BY] + gained
            if group[UNEXPLAINED] <= 0.0:
                largest = max(largest, group[LOG_ODDS])
    total = math.exp(-largest)
    for kind in range(kinds):
        for restart in range(RESTARTS):
            at = GROUPS + (RESTARTS * kind + restart) * GROUP
            if bank[at + UNEXPLAINED] <= 0.0:
                total += math.exp(bank[at + LOG_ODDS] - largest)
    found[BEST], found[FAULTY] = -1.0, 1.0 - math.exp(-largest) / total
    found[BEST_ODDS] = found[EXPLAINS] = -np.inf
    for kind in range(kinds):
        for restart in range(RESTARTS):
            number = RESTARTS * kind + restart
            group = bank[GROUPS + number * GROUP :]
            if group[UNEXPLAINED] > 0.0:
                group[LIKELY] = np.inf
                continue
            group[WEIGHT] = math.exp(group[LOG_ODDS] - largest) / total
            if not group[LOG_ODDS] > DECIDED:
                group[LIKELY] = np.inf
            elif not group[LIKELY] <= epoch_s:
                group[LIKELY] = epoch_s
            lasted = epoch_s - group[LIKELY] > LASTS_S - 1e-3
            if lasted and group[LOG_ODDS] > found[BEST_ODDS]:
                found[BEST], found[BEST_ODDS] = number, group[LOG_ODDS]
            found[EXPLAINS] = max(found[EXPLAINS], group[LOG_ODDS])
    found[AHEAD] = np.inf
    if found[BEST] >= 0.0:
        for kind in range(kinds):
            found[AHEAD] = min(found[AHEAD], _ahead(bank, ints, int(found[BEST]), kind))


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, f8[:, ::1])", allocates=True)
def mixture(bank: Array, ints: Indices, numbers: Array, n: int, width: int, opened: Array) -> None:
    """Write what the weighed hypotheses leave open of the first rows of the error state (q, q)."""
    kinds, q = ints.shape[0], opened.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    opened[:] = 0.0
    m, x, rows = np.empty(SOLVED), np.empty((3, 3)), np.empty((3, q))
    for kind in range(kinds):
        size = ints[kind, SIZE]
        for restart in range(RESTARTS):
            group = bank[GROUPS + (RESTARTS * kind + restart) * GROUP :]
            weight = group[WEIGHT]
            if weight < LEAST_WEIGHT:
                continue
            solve(group, size, numbers[kind], numbers[kind, MEAN], 1.0, m)
            for c in range(size):
                for d in range(size):
                    x[c, d] = weight * (m[3 * c + d] + m[9 + c] * m[9 + d])
                column = ints[kind, FIRST] + restart * size + c
                first = column // width * n * width + column % width
                for i in range(q):
                    rows[c, i] = v[first + i * width]
            for i in range(q):
                for c in range(size):
                    along = 0.0
                    for d in range(size):
                        along += x[c, d] * rows[d, i]
                    for j in range(q):
                        opened[i, j] += rows[c, j] * along


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, f8[::1], f8[:, ::1])", allocates=True)
def estimate(
    bank: Array,
    ints: Indices,
    numbers: Array,
    n: int,
    width: int,
    number: int,
    size_and_variance: Array,
    effect: Array,
) -> None:
    """Write b (3,) and M (9,) of a group, and what V b and V M V^T are: `effect` (1 + n, n)."""
    kind, restart = number // RESTARTS, number % RESTARTS
    size = ints[kind, SIZE]
    group = bank[GROUPS + number * GROUP :]
    v = bank[int(bank[SENSITIVITIES]) :]
    m = np.empty(SOLVED)
    solve(group, size, numbers[kind], numbers[kind, MEAN], 1.0, m)
    size_and_variance[:] = 0.0
    effect[:] = 0.0
    rows = np.empty((3, n))
    for c in range(size):
        size_and_variance[c] = m[9 + c]
        column = ints[kind, FIRST] + restart * size + c
        first = column // width * n * width + column % width
        for i in range(n):
            rows[c, i] = v[first + i * width]
            effect[0, i] += rows[c, i] * m[9 + c]
        for d in range(size):
            size_and_variance[3 + 3 * c + d] = m[3 * c + d]
    for i in range(n):
        for c in range(size):
            along = 0.0
            for d in range(size):
                along += m[3 * c + d] * rows[d, i]
            for j in range(n):
                effect[1 + i, j] += rows[c, j] * along
