r"""Sizes of a bank's hypotheses, and the covariance that they add to the published one.

The mixture of fusiond.estimators.fault_mixture adds to nine published variances and three products
of attitude errors. With L + S^-1 = C D C^T of a group, C of unit diagonal,

    v M v^T = (v C^-T) D^-1 (v C^-T)^T      v a row of V

for eight groups side by side. The published state is by the receiver's clock, whose offset tau a
fault changes, too (fusiond.estimators.published_state): v is V of p - v tau, of v - a tau, of phi +
u tau.

The attitude is that of the configured axes, and of the vehicle if the mounting is right: sigma of
pitch and yaw includes mounting angles beyond chance, and all turns of the unit that were found. In
a bank or on a slope a turn d about the vertical axis adds d tan(pitch) to roll and d sin(roll) to
pitch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.estimators.fault_bank import (
    ALL,
    ANY_FAULT,
    CONSTANTS,
    E1,
    E2,
    E_AT,
    GROUPS,
    L10,
    L11,
    L20,
    L21,
    L22,
    L_AT,
    LANES,
    LEAST_WEIGHT,
    LENGTH,
    MEAN_AT,
    OF_ONE,
    OF_THREE,
    P_AT,
    SENSITIVITIES,
    THREES,
    WEIGHT,
    dispersion,
    turned_by,
)
from fusiond.estimators.fault_odds import identified, judge
from fusiond.estimators.published_state import MOVING, moving, opened_variances
from fusiond.navigation.compiled import compiled
from fusiond.navigation.error_model import CORE_SIZE
from fusiond.navigation.strapdown import STEP_DCM

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Indices = NDArray[np.int64]

COUNTS = 1e-3
"""Probability of any fault below which the added covariance is not computed between measurements.
"""
RARE = 10.83
"""Chi-square of one that chance exceeds in one vehicle of a thousand."""

# What the kernel needs to work: sums, lane by lane, of nine variances and three products; of eight
# groups C below its diagonal (3), D^-1 (3), b (3) and weight; v C^-T (3) and v b of the attitude;
# and v.
_FACTORS = (CORE_SIZE + 3) * LANES
_ROWS = _FACTORS + 10 * LANES
_V = _ROWS + 3 * 4 * LANES
OPENED_WORK = _V + CORE_SIZE * 3 * LANES


@compiled("void(f8[::1], f8[::1], i8, i8, i8, f8[::1])")
def _factors(bank: Array, lanes: Array, row: int, threes: int, at: int, factors: Array) -> None:
    """Write C, D^-1, b and weight of eight groups, whose numbers begin at `at`, to `factors`."""
    length, own, of = int(bank[LENGTH]), np.uint64(at), np.uint64(row * CONSTANTS)
    unsigned = np.uint64
    for k in range(length):
        lane = unsigned(k)
        weight = bank[own + unsigned(WEIGHT) + lane]
        factors[unsigned(9 * LANES) + lane] = weight if weight >= LEAST_WEIGHT else 0.0
    if row < threes:
        for k in range(length):
            lane = unsigned(k)
            j, c = own + lane, of + lane
            share = dispersion(bank, j, 3.0)
            d_0 = bank[j + unsigned(L_AT)] + share * lanes[c + unsigned(P_AT)]
            a_1, a_2 = bank[j + unsigned(L10)], bank[j + unsigned(L20)]
            l_1, l_2 = a_1 / d_0, a_2 / d_0
            d_1 = bank[j + unsigned(L11)] + share * lanes[c + unsigned(P_AT + LANES)] - l_1 * a_1
            a_3 = bank[j + unsigned(L21)] - l_2 * a_1
            l_3 = a_3 / d_1
            d_2 = bank[j + unsigned(L22)] + share * lanes[c + unsigned(P_AT + 2 * LANES)]
            d_2 -= l_2 * a_2 + l_3 * a_3
            e_0 = bank[j + unsigned(E_AT)]
            e_1 = bank[j + unsigned(E1)] - l_1 * e_0
            e_2 = bank[j + unsigned(E2)] - l_2 * e_0 - l_3 * e_1
            b_2 = e_2 / d_2
            b_1 = e_1 / d_1 - l_3 * b_2
            factors[lane] = l_1
            factors[unsigned(LANES) + lane] = l_2
            factors[unsigned(2 * LANES) + lane] = l_3
            factors[unsigned(3 * LANES) + lane] = share / d_0
            factors[unsigned(4 * LANES) + lane] = share / d_1
            factors[unsigned(5 * LANES) + lane] = share / d_2
            factors[unsigned(6 * LANES) + lane] = e_0 / d_0 - l_1 * b_1 - l_2 * b_2
            factors[unsigned(7 * LANES) + lane] = b_1
            factors[unsigned(8 * LANES) + lane] = b_2
    else:
        for k in range(length):
            lane = unsigned(k)
            j, c = own + lane, of + lane
            information, mean = bank[j + unsigned(L_AT)], lanes[c + unsigned(MEAN_AT)]
            share = dispersion(bank, j, 1.0)
            over = 1.0 / (information + share * lanes[c + unsigned(P_AT)])
            beyond = bank[j + unsigned(E_AT)] - information * mean
            factors[unsigned(3 * LANES) + lane] = share * over
            factors[unsigned(6 * LANES) + lane] = mean + over * beyond


@compiled("void(f4[::1], i8, i8, i8, f8[::1], i8, f8[::1])")
def _published_rows(
    kept: Single, columns: int, first: int, count: int, motion: Array, time_slot: int, out: Array
) -> None:
    """Write v (9, count) of `count` columns of V, for the motion `moving` (12,)."""
    for i in range(CORE_SIZE):
        row, to = kept[i * columns + first :], out[i * count : (i + 1) * count]
        for j in range(to.shape[0]):
            to[j] = row[j]
        if time_slot >= 0:
            c = motion[6 + i] if i < 3 else -motion[i] if i < 6 else -motion[i - 6]
            of_time = kept[time_slot * columns + first :]
            for j in range(to.shape[0]):
                to[j] += c * of_time[j]


@compiled(
    "void(f8[::1], f8[::1], i8, f8[::1], f8[::1], i8, f8[::1], f8[::1])",
    allocates=True,
)
def widen_by_faults(
    bank: Array,
    lanes: Array,
    n: int,
    nav: Array,
    step: Array,
    time_slot: int,
    work: Array,
    wider: Array,
) -> None:
    """Write `wider` (9,): variances that the weighted hypotheses add to position, velocity, roll,
    pitch and yaw of nav (10,) with the attitude of `step` (28,), published by the clock whose
    offset is parameter `time_slot` (-1: none); `work` (OPENED_WORK,)."""
    kept, motion = bank[int(bank[SENSITIVITIES]) :].view(np.float32), np.empty(MOVING)
    moving(nav, step, motion)
    columns, length, v = kept.shape[0] // n, int(bank[LENGTH]), work[_V:OPENED_WORK]
    threes = (int(bank[THREES]) + LANES - 1) // LANES
    ones = (int(bank[ALL]) - int(bank[THREES]) + LANES - 1) // LANES
    sums, factors, rows = work[:_FACTORS], work[_FACTORS:_ROWS], work[_ROWS:_V]
    unsigned = np.uint64
    for j in range(sums.shape[0]):
        sums[j] = 0.0
    for row in range(threes + ones):
        at = GROUPS + min(row, threes) * OF_THREE + max(row - threes, 0) * OF_ONE
        most = 0.0
        for k in range(LANES):
            most = max(most, bank[at + WEIGHT + k])
        if most < LEAST_WEIGHT:
            continue
        _factors(bank, lanes, row, threes, at, factors)
        first = LANES * (3 * row if row < threes else 2 * threes + row)
        count = 3 * LANES if row < threes else LANES
        _published_rows(kept, columns, first, count, motion, time_slot, v)
        if row < threes:
            for i in range(CORE_SIZE):
                in_0 = unsigned(i * count)
                in_1, in_2 = in_0 + unsigned(LANES), in_0 + unsigned(2 * LANES)
                out, to = unsigned(i * LANES), unsigned(min(i, 2) * 4 * LANES)
                for k in range(length):
                    lane = unsigned(k)
                    v_0, v_1, v_2 = v[in_0 + lane], v[in_1 + lane], v[in_2 + lane]
                    along = v_0 * factors[unsigned(6 * LANES) + lane]
                    along += v_1 * factors[unsigned(7 * LANES) + lane]
                    along += v_2 * factors[unsigned(8 * LANES) + lane]
                    u_1 = v_1 - factors[lane] * v_0
                    u_2 = v_2 - factors[unsigned(LANES) + lane] * v_0
                    u_2 -= factors[unsigned(2 * LANES) + lane] * u_1
                    open_ = along * along
                    open_ += v_0 * v_0 * factors[unsigned(3 * LANES) + lane]
                    open_ += u_1 * u_1 * factors[unsigned(4 * LANES) + lane]
                    open_ += u_2 * u_2 * factors[unsigned(5 * LANES) + lane]
                    sums[out + lane] += open_ * factors[unsigned(9 * LANES) + lane]
                    if i < 3:
                        rows[to + lane] = v_0
                        rows[to + unsigned(LANES) + lane] = u_1
                        rows[to + unsigned(2 * LANES) + lane] = u_2
                        rows[to + unsigned(3 * LANES) + lane] = along
        else:
            for i in range(CORE_SIZE):
                in_0, out = unsigned(i * count), unsigned(i * LANES)
                for k in range(length):
                    lane = unsigned(k)
                    v_0, b = v[in_0 + lane], factors[unsigned(6 * LANES) + lane]
                    open_ = v_0 * v_0 * (factors[unsigned(3 * LANES) + lane] + b * b)
                    sums[out + lane] += open_ * factors[unsigned(9 * LANES) + lane]
        for pair in range(3):
            one, other = (0, 0, 1)[pair], (1, 2, 2)[pair]
            out = unsigned((CORE_SIZE + pair) * LANES)
            if row < threes:
                left, right = unsigned(4 * LANES * one), unsigned(4 * LANES * other)
                for k in range(length):
                    lane = unsigned(k)
                    a, b = left + lane, right + lane
                    open_ = rows[a + unsigned(3 * LANES)] * rows[b + unsigned(3 * LANES)]
                    open_ += rows[a] * rows[b] * factors[unsigned(3 * LANES) + lane]
                    u_1, w_1 = rows[a + unsigned(LANES)], rows[b + unsigned(LANES)]
                    open_ += u_1 * w_1 * factors[unsigned(4 * LANES) + lane]
                    u_2, w_2 = rows[a + unsigned(2 * LANES)], rows[b + unsigned(2 * LANES)]
                    open_ += u_2 * w_2 * factors[unsigned(5 * LANES) + lane]
                    sums[out + lane] += open_ * factors[unsigned(9 * LANES) + lane]
            else:
                left, right = unsigned(one * count), unsigned(other * count)
                for k in range(length):
                    lane = unsigned(k)
                    b = factors[unsigned(6 * LANES) + lane]
                    open_ = v[left + lane] * v[right + lane]
                    open_ *= factors[unsigned(3 * LANES) + lane] + b * b
                    sums[out + lane] += open_ * factors[unsigned(9 * LANES) + lane]
    opened = np.zeros((CORE_SIZE, CORE_SIZE))
    for i in range(CORE_SIZE):
        for k in range(LANES):
            opened[i, i] += sums[i * LANES + k]
    for pair in range(3):
        for k in range(LANES):
            opened[(0, 0, 1)[pair], (1, 2, 2)[pair]] += sums[(CORE_SIZE + pair) * LANES + k]
    opened_variances(opened, step, wider)


@compiled(
    "void(f8[::1], i8[:, ::1], f8[:, ::1], f8[::1], i8, f8, b1, b1, f8[::1], f8[::1], f8[::1],"
    " f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1])"
)
def judge_and_widen(
    bank: Array,
    ints: Indices,
    numbers: Array,
    lanes: Array,
    n: int,
    epoch_s: float,
    measured: bool,
    used: bool,
    nav: Array,
    xi: Array,
    step: Array,
    published: Array,
    mounting: Array,
    work: Array,
    wider: Array,
    found: Array,
) -> None:
    """Judge (`judge`) if the measurement was `measured` and is `used`, and write `wider` (9,),
    unless a hypothesis is identified: at each measurement, and between two while a fault is likely
    enough.

    `published` (3,) as of fusiond.estimators.published_state. `mounting` (2, 2): slots of the
    mounting's pitch and yaw in xi (n,), or -1, and the part of their squares due to chance.
    """
    if measured and used:
        judge(bank, ints, numbers, lanes, epoch_s, found)
        if identified(found):
            return
    elif not measured and not bank[ANY_FAULT] > COUNTS:
        return
    widen_by_faults(bank, lanes, n, nav, step, int(published[0]), work, wider)
    sp = step[STEP_DCM + 6]
    for k in range(2):
        slot = int(mounting[k, 0])
        if slot < 0:
            continue
        open_ = turned_by(bank, k, xi[slot]) ** 2
        wider[7 + k] += open_
        if k == 1:
            wider[6] += open_ * sp * sp / max(1e-12, 1.0 - sp * sp)
            wider[7] += open_ * step[STEP_DCM + 7] * step[STEP_DCM + 7]
