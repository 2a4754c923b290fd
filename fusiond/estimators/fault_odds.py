r"""Odds of a bank's hypotheses.

    log odds            log(rate T) + l / 2 - max(p log(N) / 2, log det(I + S L) / 2)
                        for a kind of known size
                        log(rate T) + (e - L m)^T M (e - L m) / 2 - log det(I + S L) / 2
                        + e^T m - m^T L m / 2
    weight              w_f = odds_f / (1 + sum of all odds): the posterior probability
    left unexplained    J - l against N - p by chi-square's mean and variance

A hypothesis that leaves more than chance does counts its evidence by 1 / c, c = (J - l) / (N - p):
L and e in odds, size and weight (over-dispersion; McCullagh and Nelder, Generalized linear models,
1989, section 4.5). It is never identified; but where none explains what has come, nothing wrong
does so least, and its sigma alone would be published.

The gain of p unknowns by chance is subtracted, by the number of rows (Schwarz) or by the expected
size of such a fault, whichever is more: a far smaller fault cannot be distinguished from unmodelled
errors of a working receiver. Between kinds that fit alike there is no decision (`judge`).

Source: as of fusiond.estimators.fault_bank; Schwarz, Estimating the dimension of a model, Annals of
Statistics 6 (1978), 461.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    ANY_FAULT,
    BOUNDED,
    CLASS,
    CONSTANTS,
    COUNTS_BY,
    DECIDED,
    DEVICE,
    E1,
    E2,
    E_AT,
    E_ROWS,
    EXPLAINED,
    FOLLOWED,
    GROUPS,
    J_AT,
    L10,
    L11,
    L20,
    L21,
    L22,
    L_AT,
    L_ROWS,
    LANES,
    LASTS_S,
    LENGTH,
    LIKELY,
    LOG_ODDS,
    LOG_PRIOR,
    MEAN,
    MEAN_AT,
    N_AT,
    ODDS_AT,
    OF_ONE,
    OF_THREE,
    ONSET,
    P_AT,
    PRIOR,
    RESTARTS,
    SIGNATURE,
    SIZE,
    SUSPECTS,
    THREES,
    TINY,
    TURNED,
    UNEXPLAINED,
    UNEXPLAINED_SIGMAS,
    UNJUDGED,
    WEIGHT,
    dispersion,
    explained_by_three,
    group_at,
)
from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MISSED, ALIKE_S = 0.1, 0.25
"""Loss of explained chi-square for an onset between two restarts: a drift whose onset is off by a
seventh of its age loses a twentieth. A matched onset is within half the youngest period."""
BY_CHANCE = 2.05
"""Sigmas of chi-square that chance exceeds once in fifty, as in `APART`: the tolerated unexplained
part."""
MOST_OFF = 3.0
"""Largest deviation of a size from the mean of its kind, in prior sigmas."""
LEAST_SQUARE, MOST_SQUARE = 0.115, 14.2
"""Least and largest squared size of three numbers, in prior sigmas, of a kind of known size.

One in a hundred of chi-square of three is smaller; 0.27 % are larger, as of one number are beyond
`MOST_OFF`. A receiver that is good to a centimetre has many jumps of five, and none of metres."""
MOST_OF_UNIT = 10.0
"""Largest size of a unit's fault in prior sigmas: 10 deg/s, half a g, more than a right angle. A
reversed velocity is no force of four g."""
MOST_TURNED = 0.25 * math.pi
"""Largest turn (rad) whose linear estimate is a first step of its correction: another of a quarter
of that is left."""
_NOTHING = -40.0
"""Log of a negligible weight, which a sum of doubles cannot show."""
APART = 4.0
"""Log odds between two classes: fifty to one."""
# What `judge` writes: the group with the largest odds of those that explain, its log odds, by how
# much it is ahead of any of another class or device, and the largest of any that explains.
BEST, BEST_ODDS, AHEAD, EXPLAINS, FOUND = 0, 1, 2, 3, 4


@compiled("f8(f8[::1], i8, i8, f8[::1], f8, f8[::1])", allocates=True)
def solve(bank: Array, at: int, size: int, numbers: Array, share: float, m: Array) -> float:
    """Write M = (L + share S^-1)^-1 of the group at `at` into m (9,) and behind it b (3,).

    With a `share` of 1 or more the mean of its kind's `numbers` (7,) is used. Gauss-Jordan
    elimination of a positive definite matrix. Returns e^T b: without a mean the explained
    chi-square l.
    """
    a = np.empty((3, 6))
    mean = numbers[MEAN] if share >= 1.0 else 0.0
    for i in range(size):
        for j in range(size):
            a[i, j] = bank[at + L_ROWS[i, j]]
            a[i, size + j] = 1.0 if i == j else 0.0
        a[i, i] += share / (numbers[PRIOR + i] * numbers[PRIOR + i])
    for k in range(size):
        pivot = a[k, k]
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
            beyond = bank[at + E_ROWS[j]]  # e - L m
            for k in range(size):
                beyond -= bank[at + L_ROWS[j, k]] * mean
            m[9 + i] += a[i, size + j] * beyond
        gained += bank[at + E_ROWS[i]] * m[9 + i]
    return gained


@compiled("void(f8[::1], f8[::1])")
def _gains(bank: Array, lanes: Array) -> None:
    """Write each group's explained and unexplained chi-square, the determinant of L + S^-1 for its
    weight, and the gain of log odds by the prior."""
    length = int(bank[LENGTH])
    threes = (int(bank[THREES]) + LANES - 1) // LANES
    ones = (int(bank[ALL]) - int(bank[THREES]) + LANES - 1) // LANES
    unsigned = np.uint64
    for row in range(threes + ones):
        at = unsigned(GROUPS + min(row, threes) * OF_THREE + max(row - threes, 0) * OF_ONE)
        constants = unsigned(row * CONSTANTS)
        size = 3.0 if row < threes else 1.0
        if row < threes:
            for k in range(length):
                j, c = at + unsigned(k), constants + unsigned(k)
                bank[j + unsigned(EXPLAINED)] = explained_by_three(bank, lanes, j, c)
                a_1, a_2 = bank[j + unsigned(L10)], bank[j + unsigned(L20)]
                # det (L + S^-1)
                b_0 = bank[j + unsigned(L_AT)] + lanes[c + unsigned(P_AT)]
                m_1, m_2 = a_1 / b_0, a_2 / b_0
                b_1 = bank[j + unsigned(L11)] + lanes[c + unsigned(P_AT + LANES)] - m_1 * a_1
                m_3 = bank[j + unsigned(L21)] - m_2 * a_1
                b_2 = bank[j + unsigned(L22)] + lanes[c + unsigned(P_AT + 2 * LANES)]
                b_2 -= m_2 * a_2 + m_3 * m_3 / b_1
                bank[j + unsigned(WEIGHT)] = b_0 * b_1 * b_2
                # e^T M e / 2
                e_0 = bank[j + unsigned(E_AT)]
                e_1 = bank[j + unsigned(E1)] - m_1 * e_0
                e_2 = bank[j + unsigned(E2)] - m_2 * e_0 - m_3 / b_1 * e_1
                gained = e_0 * e_0 / b_0 + e_1 * e_1 / b_1 + e_2 * e_2 / b_2
                bank[j + unsigned(LOG_ODDS)] = 0.5 * gained
        else:
            for k in range(length):
                j, c = at + unsigned(k), constants + unsigned(k)
                information, mean = bank[j + unsigned(L_AT)], lanes[c + unsigned(MEAN_AT)]
                e, prior = bank[j + unsigned(E_AT)], lanes[c + unsigned(P_AT)]
                bank[j + unsigned(EXPLAINED)] = e * e / (information + TINY * prior)
                a = information + prior
                beyond = e - information * mean
                along = mean * (e - 0.5 * mean * information)
                bank[j + unsigned(LOG_ODDS)] = 0.5 * beyond * beyond / a + along
                bank[j + unsigned(WEIGHT)] = a
        for k in range(length):
            j = at + unsigned(k)
            degrees = max(bank[j + unsigned(N_AT)] - size, 1.0)
            most = degrees + UNEXPLAINED_SIGMAS * math.sqrt(2.0 * degrees)
            left = bank[j + unsigned(J_AT)] - bank[j + unsigned(EXPLAINED)] - most
            bank[j + unsigned(UNEXPLAINED)] = left


@compiled("f8(f8[::1], f8[::1], i8, i8, b1, f8[::1])", forceinline=True)
def _larger(bank: Array, numbers: Array, at: int, size: int, unit: bool, m: Array) -> float:
    """Log of the ratio of a fault's size to its expectation; an impossible size explains
    nothing."""
    share = MOST_OF_UNIT**-2 if unit else TINY
    gained = solve(bank, at, size, numbers, share, m)
    bank[at + UNEXPLAINED] += bank[at + EXPLAINED] - gained
    bank[at + EXPLAINED], square = gained, 0.0
    for c in range(size):
        sigmas = m[9 + c] / numbers[PRIOR + c]
        square += sigmas * sigmas
        if unit and abs(sigmas) > MOST_OF_UNIT:
            bank[at + UNEXPLAINED] = np.inf
    return 0.5 * math.log(max(square / size, 1.0))


@compiled("f8(f8[::1], f8[::1], i8, f8[::1])", forceinline=True)
def _second_order(bank: Array, numbers: Array, at: int, m: Array) -> float:
    """Chi-square that a turn of the unit leaves, as its rows are linear.

    A turn b changes a force f by b x f + b x (b x f) / 2 + ..., of which V has the first: a share
    of |b| / 2 of what it does is not explained."""
    solve(bank, at, 3, numbers, MOST_OF_UNIT**-2, m)
    square: float = m[9] * m[9] + m[10] * m[10] + m[11] * m[11]
    return 0.25 * square * bank[at + EXPLAINED] if square <= MOST_TURNED**2 else 0.0


@compiled("b1(f8[::1], f8[::1], i8, f8[::1])", forceinline=True)
def _of_its_size(bank: Array, numbers: Array, at: int, m: Array) -> bool:
    """True if a fault of three numbers is neither too small nor too large for its kind."""
    solve(bank, at, 3, numbers, 1.0, m)
    square = 0.0
    for c in range(3):
        square += (m[9 + c] / numbers[PRIOR + c]) ** 2
    return bool(LEAST_SQUARE <= square <= MOST_SQUARE)


@compiled(
    "void(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, f8[::1], f8[:, ::1])", forceinline=True
)
def _odds(
    bank: Array, ints: Indices, numbers: Array, lanes: Array, number: int, m: Array, counts: Array
) -> None:
    """Write the log odds of a group; m (12,) is work space, `counts` (restarts, 2) caches the
    number of rows, mostly equal for all kinds, and its log."""
    threes, at, kind = int(bank[THREES]), group_at(bank, number), number // RESTARTS
    size = 3.0 if number < threes else 1.0
    a, bank[at + WEIGHT] = bank[at + WEIGHT], 0.0
    if bank[at + N_AT] == 0.0:
        bank[at + LOG_ODDS], bank[at + UNEXPLAINED] = -np.inf, 0.0
        return
    place = number if number < threes else number + -threes % LANES
    rate = lanes[place // LANES * CONSTANTS + place % LANES + ODDS_AT] + bank[at + COUNTS_BY]
    by_size = 0.5 * math.log(a)
    if numbers[kind, BOUNDED] == 0.0:
        restart = number % RESTARTS
        if counts[restart, 0] != bank[at + N_AT]:
            counts[restart, 0], counts[restart, 1] = bank[at + N_AT], math.log(bank[at + N_AT])
        by_rows = 0.5 * size * counts[restart, 1]
        for c in range(int(size)):
            by_rows -= numbers[kind, LOG_PRIOR + c]
        unit, by = ints[kind, CLASS] == 0, np.uint64(at)
        if ints[kind, SIGNATURE] == TURNED and bank[at + UNEXPLAINED] > 0.0:
            bank[at + UNEXPLAINED] -= _second_order(bank, numbers[kind], at, m)
        gained = 0.5 * bank[at + EXPLAINED] / dispersion(bank, by, size) - max(by_rows, by_size)
        if rate + gained > 0.0:
            by_size += size * _larger(bank, numbers[kind], at, int(size), unit, m)
            gained = 0.5 * bank[at + EXPLAINED] / dispersion(bank, by, size)
            gained -= max(by_rows, by_size)
    else:
        gained = bank[at + LOG_ODDS] / dispersion(bank, np.uint64(at), size) - by_size
        if number >= threes:
            off = (bank[at + E_AT] - bank[at + L_AT] * numbers[kind, MEAN]) / a
            other = abs(off) > MOST_OFF * numbers[kind, PRIOR]
        else:
            other = rate + gained > _NOTHING and not _of_its_size(bank, numbers[kind], at, m)
        if other:
            bank[at + UNEXPLAINED] = np.inf  # it is of another size than this kind has
    bank[at + LOG_ODDS] = rate + gained


@compiled("f8(f8[::1], i8[:, ::1], i8, i8)")
def _ahead(bank: Array, ints: Indices, best: int, kind: int) -> float:
    """Lead of a group over those of other kinds; infinite if no decision is needed."""
    own, group = best // RESTARTS, group_at(bank, best)
    if ints[kind, CLASS] == ints[own, CLASS] and ints[kind, DEVICE] == ints[own, DEVICE]:
        return np.inf
    step = ints[kind, SIGNATURE] <= FOLLOWED
    alike = step == (ints[own, SIGNATURE] <= FOLLOWED)
    fit, left, ahead, same = 0.0, 0.0, np.inf, False
    for restart in range(RESTARTS):
        other = group_at(bank, RESTARTS * kind + restart)
        if bank[other + UNEXPLAINED] > 0.0:
            continue
        ahead = min(ahead, bank[group + LOG_ODDS] - bank[other + LOG_ODDS])
        if bank[other + LOG_ODDS] > 0.0:
            if bank[other + EXPLAINED] > fit:
                fit = bank[other + EXPLAINED]
                degrees = max(bank[other + N_AT] - ints[kind, SIZE], 1.0)
                chance = UNEXPLAINED_SIGMAS + BY_CHANCE
                left = bank[other + UNEXPLAINED] + chance * math.sqrt(2.0 * degrees)
            same = same or abs(bank[other + ONSET] - bank[group + ONSET]) < ALIKE_S
    if fit > 0.0 and not alike:
        missed = 0.0 if same else min(MISSED * bank[group + EXPLAINED], max(left, 0.0))
        ahead = min(ahead, 0.5 * (bank[group + EXPLAINED] - fit - missed))
    return ahead


@compiled("void(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], f8, f8[::1])", allocates=True)
def judge(
    bank: Array, ints: Indices, numbers: Array, lanes: Array, epoch_s: float, found: Array
) -> None:
    """Write log odds, weight and unexplained chi-square of each group, and `found` (4,), at an
    epoch of a measurement. A single measurement favours the nearest hypothesis; so one is
    identified after it has been likely and has explained all for `LASTS_S`. Kinds of three numbers
    of a known size only widen the published covariance.

    The lead over another is the difference of log odds. Between a step of states, which changes the
    published state, and a source's fault that is likelier than no fault, the difference of the fits
    counts if it is less: rates alone must not decide. Only hypotheses of one onset are compared, as
    a later restart of the source's may have lost evidence.
    """
    groups, m, counts = int(bank[ALL]), np.empty(12), np.zeros((RESTARTS, 2))
    _gains(bank, lanes)
    largest = 0.0
    for number in range(groups):
        _odds(bank, ints, numbers, lanes, number, m, counts)
        at = group_at(bank, number)
        if bank[at + UNEXPLAINED] < np.inf:
            largest = max(largest, bank[at + LOG_ODDS])
    nothing = math.exp(-largest)
    total = nothing
    for number in range(groups):
        at = group_at(bank, number)
        if bank[at + UNEXPLAINED] < np.inf:
            less = bank[at + LOG_ODDS] - largest
            if less > _NOTHING:
                bank[at + WEIGHT] = math.exp(less)
                total += bank[at + WEIGHT]
    found[BEST], bank[ANY_FAULT] = -1.0, 1.0 - nothing / total
    found[BEST_ODDS] = found[EXPLAINS] = -np.inf
    found[AHEAD] = np.inf
    bank[SUSPECTS], bank[UNJUDGED] = 0.0, np.inf
    for number in range(groups):
        at = group_at(bank, number)
        bank[at + WEIGHT] /= total
        if bank[at + UNEXPLAINED] > 0.0:
            bank[at + LIKELY] = np.inf
            continue
        odds = bank[at + LOG_ODDS]
        if not odds > DECIDED:
            bank[at + LIKELY] = np.inf
        elif not bank[at + LIKELY] <= epoch_s:
            bank[at + LIKELY] = epoch_s
        if bank[at + LIKELY] < np.inf:
            bank[SUSPECTS] = 1.0
        lasted = epoch_s - bank[at + LIKELY] > LASTS_S - 1e-3
        opens = number < int(bank[THREES]) and numbers[number // RESTARTS, BOUNDED] != 0.0
        if lasted and not opens and odds > found[BEST_ODDS]:
            found[BEST], found[BEST_ODDS] = number, odds
        found[EXPLAINS] = max(found[EXPLAINS], odds)
    if found[BEST] >= 0.0:
        for kind in range(ints.shape[0]):
            found[AHEAD] = min(found[AHEAD], _ahead(bank, ints, int(found[BEST]), kind))


@compiled("b1(f8[::1])", forceinline=True)
def identified(found: Array) -> bool:
    """True if a group is sufficiently likelier than all of other classes, as `judge` has
    `found`."""
    apart = found[BEST] >= 0.0 and found[AHEAD] > APART
    return bool(apart)
