r"""Bank of fault hypotheses beside a filter: separate-bias estimators, propagated with it.

Hypothesis f: since t_f a constant fault b (p numbers) acts on the motion or the measurements by a
known signature,

    dx' = F dx + G w + B b          z = H dx + D b + v        dx computed less true

The mean of the filter's error under f is V b. With the filter's own gain K, innovation nu and the
variance W of each row, which `whiten` leaves as y = nu / sqrt(W) and g = K sqrt(W),

    between updates     V <- Phi V                       fusiond.estimators.fault_carried
    each row            s = (H V + D) / sqrt(W)          L += s^T s   e += s^T y   J += y^2   N += 1
                        J += 1 - min(c, 1) more of a row that shows c, not 1, in the mean
    if it was fused     V <- V - g s

    size of the fault   b = M (e + S^-1 m),  M = (L + S^-1)^-1      prior b ~ N(m, S)
    evidence            l = e^T L^-1 e                   chi-square of p if nothing is wrong
    left unexplained    J - l                            chi-square of N - p if it is f
    log odds            as of fusiond.estimators.fault_odds

Onsets are unknown: each kind is restarted with several periods T, in turns. Before a restart, a
likely onset replaces a less likely one of the next longer period. A fault of the inertial unit
starts as a step of states, V = 1 at its onset; a fault of a measurement is D of its rows. A delay
of tau uses the filter's own past, D = p(t) - p(t - tau), of a stored path by dead reckoning.
Feedback also corrects the stored velocities, so that a change of velocity over tau is the sensed
one, without noise of later measurements, which a filter with too much process noise follows.

The bank lies in the filter's memory: a snapshot copies it, a rewind restores it bit for bit. This
module has its layout; onsets are in fusiond.estimators.fault_onsets, signatures and evidence in
fusiond.estimators.fault_update, odds in fusiond.estimators.fault_odds.

Source: Friedland, Treatment of bias in recursive filtering, IEEE Trans. AC 14 (1969), 359; Willsky,
Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Trans. AC 21 (1976), 108.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PERIODS_S = (0.5, 2.0, 8.0, 32.0)
"""Time between two restarts of a level. The youngest is half a second: a fault whose onset is
missed by seconds does not fit any more, and another that does is accused in its place."""
SLOTS_OF = (4, 2, 2, 2)
"""Restarts of a level, in turns: one has always run for at least so many periods less one."""
RESTARTS = sum(SLOTS_OF)
LEVEL_OF = tuple(level for level, count in enumerate(SLOTS_OF) for _ in range(count))
BEGINS_AT = tuple(sum(SLOTS_OF[:level]) for level in range(len(SLOTS_OF)))
PERIODS_NS = tuple(round(period * 1e9) for period in PERIODS_S)
PROMOTED = 3.0
"""Log odds, twenty to one, by which an onset replaces one of the level above.

Asked when its own turn to restart has come."""

STATES, TURNED, SHIFTED, FOLLOWED = range(4)
"""Signatures that are a step of states: of one number in all of them or of as many numbers; of the
attitude, about body axes, and of the mounting; of all that moves, as if it were another instant,
from the start on; of what a source's faults, as they are weighed, have done to the filter."""
POSITION, POSITION_RAMP, VELOCITY, VELOCITY_RAMP, CARRIED, DELAY, SPEED, ROWS = range(4, 12)
"""Signatures in rows: an offset of a position, one that grows with time, the same of a velocity;
positions that grow as velocities say; a delay; a share of the speed; an offset of each of a
measurement's rows."""
PLACES, MOVES, ROLLS, OTHER, NOTHING = range(5)
"""Kinds of a measurement's rows: a position, a velocity, a speed, something of its own, nothing
that can be at fault."""

# Columns of the table of kinds: signature, device, size p, slots of a step, class,
# whether it is in its device's positions and in its velocities.
SIGNATURE, DEVICE, SIZE, SLOTS, CLASS, LOCATES, MOVES_TOO = 0, 1, 2, 3, 6, 7, 8
ANY = -3
"""Device index for all devices with positions or velocities."""
KIND_INTS = 9
# And of their numbers: prior sigmas (3), log of the rate (1/s), delay (s), the amount's prior mean,
# whether its size is known to be of that prior (1 or 0).
PRIOR, LOG_RATE, LAG, MEAN, BOUNDED = 0, 3, 4, 5, 6
KIND_NUMBERS = 7
LOG_PRIOR = 7
"""Offset of the logs of the prior sigmas (3) in a table."""

# The bank's array: head, ring of the path, groups, a transition, sensitivities V (n, columns) in
# single precision: what a fault of 64 s has done is known to 1e-6 of it, its prior to a digit. The
# head holds which restart each level is at (4), the instant (s), place (m) and number of entries of
# the path, where V begins, how many groups there are and how many of them have three numbers, LANES
# (loops whose length is read from an array become vector code), where the transition since the last
# measurement lies, 1 if it is not the identity, the probability of any fault as it was judged last,
# 1 if one was likely then, the epoch (s) of rows that are taken in and not judged, or infinity, the
# row width of the transition, by how much the unit has been found to have turned on the vehicle in
# pitch and yaw (rad), the epoch (s) whose odds nobody has read yet, or infinity, what has been fed
# back of the velocity in all (m/s), when (s) something measured was in service last, and the mean
# of y^2 that rows of neither positions nor velocities nor speeds have shown; then the mounting's
# pitch and yaw (rad) as the last decision left them, and what chance may make of the squares of
# their changes since.
RESTARTED, PATH_S, PATH, ENTRIES, SENSITIVITIES = 0, 4, 5, 8, 9
ALL, THREES, LENGTH, PHI, WAITS, ANY_FAULT, SUSPECTS, UNJUDGED, WIDTH, TURNED_BY = range(10, 20)
UNWEIGHED, FED_BACK, LAST_MEASURED, SHOWN, HEAD = 21, 22, 25, 26, 32
SAT_AT, BY_CHANCE = 27, 29
RING, POINT, RING_S = 64, 7, 0.1
GROUPS = HEAD + RING * POINT
LANES = 8
# Groups (a restart of a kind, in the order of kinds) lie eight side by side, a row of eight of each
# of their numbers: J, N, onset (s), log odds, weight, what is left unexplained beyond chance, since
# which epoch (s) it has been likely and explained all, or never, what it explains, l, and log of
# what its rate counts by, then L and e: of one number eleven rows, of three nineteen. Of V and of
# a measurement's rows the columns of a component of eight lie so, too.
J_AT, N_AT, ONSET, LOG_ODDS, WEIGHT, UNEXPLAINED, LIKELY = (LANES * row for row in range(7))
EXPLAINED, COUNTS_BY, L_AT, E_AT, OF_ONE = (LANES * row for row in range(7, 12))
L10, L11, L20, L21, L22, E1, E2, OF_THREE = (LANES * row for row in range(11, 19))
L_ROWS = np.array([[L_AT, L10, L20], [L10, L11, L21], [L20, L21, L22]])
E_ROWS = np.array([E_AT, E1, E2])
# What never changes of eight groups: the prior's precisions, its mean, and what of the log odds
# does not depend on what has come, with the prior's density and without.
P_AT, MEAN_AT, ODDS_AT, RATE_AT, CONSTANTS = 0, LANES * 3, LANES * 4, LANES * 5, LANES * 6
TINY = 1e-9
"""Weight of the prior in L, so that directions without evidence stay regular."""
UNEXPLAINED_SIGMAS = 4.0
"""Sigmas of chi-square, by its mean and variance (2 N), beyond which a hypothesis does not fit: one
in 30,000."""
DECIDED = 7.0
"""Log odds beyond which a hypothesis is likely: a thousand to one."""
LEAST_WEIGHT = 1e-7
"""Probability below which a hypothesis is ignored: a third of a metre of a kilometre."""
LASTS_S = 1.0
"""Least duration (s) of a likely hypothesis; a receiver's errors of a second are correlated."""
SHOWN_KEPT = 1000.0
"""Rows of the mean of what constraints show: a minute of no slip. They are known to a sigma that is
a bound, and quiet for hours: a source's fault that ended long ago would fit by their silence."""
ALONE_S = 2.0 * LASTS_S
"""Time without any measurement after which constraints are judged by: beside a receiver of one fix
a second they never are."""


class FaultTable(NamedTuple):
    """Kinds of faults for the kernels, those of three numbers first: `ints` (k, 9) and `numbers`
    (k, 10), `lanes` with the constants of their groups, and the devices that they index."""

    ints: Indices
    numbers: Array
    lanes: Array
    devices: tuple[str, ...] = ()

    @property
    def threes(self) -> int:
        """Number of groups with three numbers."""
        return RESTARTS * int(np.count_nonzero(self.ints[:, SIZE] == 3))

    @property
    def groups(self) -> int:
        """Number of groups."""
        return RESTARTS * len(self.ints)


def fault_table(ints: Indices, numbers: Array, devices: tuple[str, ...]) -> FaultTable:
    """Table of these kinds, `numbers` (k, 7). ValueError if a kind has neither three numbers nor
    one, a mean of three or of an unknown size, or if kinds of three do not come first."""
    sizes = ints[:, SIZE]
    if not np.isin(sizes, (1, 3)).all() or (np.diff(sizes) > 0).any():
        raise ValueError("kinds have three numbers or one, those of three first")
    if numbers[(sizes == 3) | (numbers[:, BOUNDED] == 0.0), MEAN].any():
        raise ValueError("only a kind of one number that is known to be of a size has a mean")
    threes = RESTARTS * int(np.count_nonzero(sizes == 3))
    parts = [threes, RESTARTS * len(sizes) - threes]
    lanes = np.zeros((sum(-(-part // LANES) for part in parts), CONSTANTS))
    lanes[:, P_AT:MEAN_AT], lanes[:, ODDS_AT:] = 1.0, -np.inf
    for number in range(sum(parts)):
        kind, level = number // RESTARTS, LEVEL_OF[number % RESTARTS]
        first = number if number < threes else number + -threes % LANES
        row, lane = divmod(first, LANES)
        prior = numbers[kind, PRIOR : PRIOR + sizes[kind]]
        for c, sd in enumerate(prior.tolist()):
            lanes[row, P_AT + LANES * c + lane] = 1.0 / (sd * sd)
        lanes[row, MEAN_AT + lane] = numbers[kind, MEAN]
        odds = numbers[kind, LOG_RATE] + math.log(PERIODS_S[level])
        lanes[row, ODDS_AT + lane], lanes[row, RATE_AT + lane] = odds - np.log(prior).sum(), odds
    logs = [[math.log(sd) for sd in row] for row in numbers[:, PRIOR : PRIOR + 3].tolist()]
    known = np.hstack((numbers, np.array(logs).reshape(-1, 3)))
    return FaultTable(ints, known, lanes.ravel(), devices)


NO_FAULTS = fault_table(
    np.zeros((0, KIND_INTS), dtype=np.int64), np.zeros((0, KIND_NUMBERS)), devices=()
)


def bank_size(table: FaultTable, n: int, width: int) -> int:
    """Doubles of a bank beside a filter of n states in rows of `width`."""
    threes, groups = table.threes, table.groups
    if not groups:
        return 0
    tiles, ones = -(-threes // LANES), -(-(groups - threes) // LANES)
    size = GROUPS + tiles * OF_THREE + ones * OF_ONE
    return size + width * width + n * columns_of(table) // 2


def columns_of(table: FaultTable) -> int:
    """Columns of V and of a measurement's rows, padded to whole vector steps."""
    tiles, ones = -(-table.threes // LANES), -(-(table.groups - table.threes) // LANES)
    return -(-(3 * tiles + ones) // 4) * 4 * LANES


def begin_bank(bank: Array, table: FaultTable, n: int, width: int) -> None:
    """Write the constant part of a new bank."""
    if bank.size:
        bank[SENSITIVITIES] = bank.size - n * columns_of(table) // 2
        bank[PHI] = bank[SENSITIVITIES] - width * width
        bank[ALL], bank[THREES], bank[LENGTH] = table.groups, table.threes, LANES
        bank[WIDTH] = width
        bank[UNJUDGED] = bank[UNWEIGHED] = np.inf
        bank[SHOWN] = 1.0


@compiled("i8(f8[::1], i8)", forceinline=True)
def group_at(bank: Array, number: int) -> int:
    """Offset of a group's numbers."""
    threes = int(bank[THREES])
    tile, lane = number // LANES, number % LANES
    at: int = GROUPS + tile * OF_THREE + lane
    if number >= threes:
        tile, lane = (number - threes) // LANES, (number - threes) % LANES
        at = GROUPS + (threes + LANES - 1) // LANES * OF_THREE + tile * OF_ONE + lane
    return at


@compiled("i8(f8[::1], i8, i8)", forceinline=True)
def column_of(bank: Array, number: int, component: int) -> int:
    """Column of a group's component, of V and of a measurement's rows."""
    threes = int(bank[THREES])
    column: int = (3 * (number // LANES) + component) * LANES + number % LANES
    if number >= threes:
        ones = 3 * ((threes + LANES - 1) // LANES) + (number - threes) // LANES
        column = ones * LANES + (number - threes) % LANES
    return column


@compiled("f8(f8[::1], i8, f8)")
def turned_by(bank: Array, k: int, sits: float) -> float:
    """Turn (rad) of the unit in pitch (k = 0) or yaw (1).

    It is what decisions have found, and the filter after them; the mounting is now at `sits`."""
    change = sits - bank[SAT_AT + k]
    beyond = math.sqrt(max(0.0, change * change - bank[BY_CHANCE + k]))
    found: float = bank[TURNED_BY + k] + math.copysign(beyond, change)
    return found


@compiled("b1(f8[::1], i8, f8, b1)", forceinline=True)
def is_evidence(bank: Array, measures: int, t_s: float, measured: bool) -> bool:
    """True if hypotheses are judged at such rows: they are `measured`, or a constraint while
    nothing else is, as it is then the only evidence."""
    if measured:
        bank[LAST_MEASURED] = t_s
    alone: bool = measured or (measures != NOTHING and t_s - bank[LAST_MEASURED] > ALONE_S)
    return alone


@compiled("f8(f8[::1], u8, f8)", forceinline=True)
def dispersion(bank: Array, j: np.uint64, size: float) -> float:
    """Chi-square that the group at `j` leaves over that of chance, where it is beyond chance; else
    1."""
    unsigned = np.uint64
    if not bank[j + unsigned(UNEXPLAINED)] > 0.0:
        return 1.0
    degrees = max(bank[j + unsigned(N_AT)] - size, 1.0)
    left = bank[j + unsigned(J_AT)] - bank[j + unsigned(EXPLAINED)]
    ratio: float = max(left / degrees, 1.0)
    return ratio


@compiled("f8(f8[::1], f8[::1], u8, u8)", forceinline=True)
def explained_by_three(bank: Array, lanes: Array, j: np.uint64, c: np.uint64) -> float:
    """Explained chi-square e^T L^-1 e of the group of three numbers at `j`, with constants at
    `c`."""
    unsigned = np.uint64
    d_0 = bank[j + unsigned(L_AT)] + TINY * lanes[c + unsigned(P_AT)]
    a_1, a_2 = bank[j + unsigned(L10)], bank[j + unsigned(L20)]
    l_1, l_2 = a_1 / d_0, a_2 / d_0
    d_1 = bank[j + unsigned(L11)] + TINY * lanes[c + unsigned(P_AT + LANES)]
    d_1 -= l_1 * a_1
    a_3 = bank[j + unsigned(L21)] - l_2 * a_1
    l_3 = a_3 / d_1
    d_2 = bank[j + unsigned(L22)] + TINY * lanes[c + unsigned(P_AT + 2 * LANES)]
    d_2 -= l_2 * a_2 + l_3 * a_3
    e_0 = bank[j + unsigned(E_AT)]
    e_1 = bank[j + unsigned(E1)] - l_1 * e_0
    e_2 = bank[j + unsigned(E2)] - l_2 * e_0 - l_3 * e_1
    explained: float = e_0 * e_0 / d_0 + e_1 * e_1 / d_1 + e_2 * e_2 / d_2
    return explained
