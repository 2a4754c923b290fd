r"""Bank of fault hypotheses beside a filter: each a separate-bias estimator that is carried along.

Hypothesis f: since t_f something is wrong by a constant b (p numbers) that enters the motion or the
measurements by a known signature,

    dx' = F dx + G w + B b          z = H dx + D b + v        dx computed less true

The mean of the filter's error under f is V b. With the filter's own gain K, innovation nu and the
variance W of each row, which `whiten` leaves as y = nu / sqrt(W) and g = K sqrt(W),

    between updates     V <- Phi V                       the kernels of the transition matrix
    each row            s = (H V + D) / sqrt(W)          L += s^T s   e += s^T y   J += y^2   N += 1
    if it was fused     V <- V - g s

    size of the fault   b = M (e + S^-1 m),  M = (L + S^-1)^-1      prior b ~ N(m, S)
    evidence            l = e^T L^-1 e                   chi-square of p if nothing is wrong
    left unexplained    J - l                            chi-square of N - p if it is f
    log odds            log(rate T) + (e - L m)^T M (e - L m) / 2 - log det(I + S L) / 2
                        + e^T m - m^T L m / 2

An onset is not known: each kind runs from restarts of several periods T, in turns. What has turned
out to be a likely onset takes the place of a less likely one of the next longer period before it
begins anew. A fault of the inertial unit begins as a step of
states, V = 1 at its onset; one of a measurement is its rows' D. A delay of tau is the filter's own
past, D = p(t) - p(t - tau), of a path by dead reckoning that is kept here.

All of it lies in the filter's memory: a snapshot copies it, a rewind restores it to the bit.

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
from fusiond.navigation.earth import gravity
from fusiond.navigation.strapdown import (
    HEIGHT,
    LAT,
    STEP_DCM,
    STEP_SMOOTH_N,
    VN,
)

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
"""Log odds by which an onset must be likelier than one of the level above to take its place when
its own turn to begin anew has come: twenty to one."""

STATES, TURNED, SHIFTED = range(3)
"""Signatures that are a step of states: of one number in all of them or of as many numbers; of the
attitude, about body axes, and of the mounting; of all that moves, as if it were another instant,
from the start on."""
POSITION, POSITION_RAMP, VELOCITY, VELOCITY_RAMP, CARRIED, DELAY, SPEED, ROWS = range(3, 11)
"""Signatures in rows: an offset of a position, one that grows with time, the same of a velocity;
positions that grow as velocities say; a delay; a share of the speed; an offset of each of an aid's
rows."""
PLACES, MOVES, ROLLS, OTHER, NOTHING = range(5)
"""What an aid's rows are: a position, a velocity, a speed, something of its own, nothing that can
be at fault."""

# Columns of the table of kinds: signature, device, size p, first column, slots of a step, class,
# whether it is in its device's positions and in its velocities.
SIGNATURE, DEVICE, SIZE, FIRST, SLOTS, CLASS, LOCATES, MOVES_TOO = 0, 1, 2, 3, 4, 7, 8, 9
ANY = -3
"""In the place of a device: all that send positions or velocities."""
KIND_INTS = 10
# And of their numbers: prior sigmas (3), log of the rate (1/s), delay (s), the amount's prior mean.
PRIOR, LOG_RATE, LAG, MEAN = 0, 3, 4, 5
KIND_NUMBERS = 6

# The bank's array: head, ring of the path, groups, sensitivities. The head holds which restart each
# age is at (4), the instant (s), place (m) and number of entries of the path, where V begins.
_RESTARTED, _PATH_S, _PATH, _ENTRIES, SENSITIVITIES, HEAD = 0, 4, 5, 8, 9, 16
RING, POINT, RING_S = 64, 7, 0.1
GROUPS = HEAD + RING * POINT
# A group: L (9), e (3), J, N, onset (s), log odds, weight, what is left unexplained beyond chance,
# since which epoch (s) it has been likely and explained all, or never.
L_AT, E_AT, J_AT, N_AT, ONSET, LOG_ODDS, WEIGHT, UNEXPLAINED, LIKELY, GROUP = (
    *(0, 9, 12, 13, 14, 15, 16, 17, 18),
    20,
)
UNEXPLAINED_SIGMAS = 4.0
"""One in 30,000, of chi-square by its mean and variance (2 N): who leaves more does not fit."""
DECIDED = 7.0
"""Log odds beyond which a hypothesis is likely: a thousand to one."""
LASTS_S = 1.0
"""For so long it must have been: a receiver's errors of a second are one error."""


class FaultTable(NamedTuple):
    """Kinds of faults as the kernels read them, `ints` (k, 10) and `numbers` (k, 6), how many
    columns they have in all, and the devices whose numbers they name."""

    ints: Indices
    numbers: Array
    columns: int
    devices: tuple[str, ...] = ()


NO_FAULTS = FaultTable(
    np.zeros((0, KIND_INTS), dtype=np.int64), np.zeros((0, KIND_NUMBERS)), columns=0
)


def bank_size(table: FaultTable, n: int, width: int) -> int:
    """Doubles of a bank beside a filter of n states in rows of `width`."""
    if not table.columns:
        return 0
    groups: int = RESTARTS * table.ints.shape[0]
    return GROUPS + groups * GROUP + chunks_of(table.columns, width) * n * width


def chunks_of(columns: int, width: int) -> int:
    """Blocks of `width` columns that hold all."""
    return -(-columns // width)


def begin_bank(bank: Array, table: FaultTable) -> None:
    """Write what of a new bank never changes."""
    if bank.size:
        bank[SENSITIVITIES] = GROUPS + RESTARTS * table.ints.shape[0] * GROUP


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, i8, f8, f8[::1], f8[::1])")
def _begin_group(
    bank: Array,
    ints: Indices,
    n: int,
    width: int,
    kind: int,
    restart: int,
    t_s: float,
    nav: Array,
    step: Array,
) -> None:
    """Begin one kind's restart anew, with its onset now, at a state nav (10,) after `step`."""
    at = GROUPS + (RESTARTS * kind + restart) * GROUP
    for j in range(GROUP):
        bank[at + j] = 0.0
    bank[at + ONSET] = t_s
    bank[at + LOG_ODDS], bank[at + LIKELY] = -np.inf, np.inf
    v = bank[int(bank[SENSITIVITIES]) :]
    size = ints[kind, SIZE]
    for c in range(size):
        column = ints[kind, FIRST] + restart * size + c
        first = column // width * n * width + column % width
        for i in range(n):
            v[first + i * width] = 0.0
        of, slots = ints[kind, SIGNATURE], ints[kind, SLOTS : SLOTS + 3]
        if of == STATES:
            for j in range(3):
                if (j == c or size == 1) and slots[j] >= 0:
                    v[first + slots[j] * width] = 1.0
        elif of == TURNED:
            for i in range(3):
                v[first + i * width] = step[STEP_DCM + 3 * i + c]
            if slots[c] >= 0:
                v[first + slots[c] * width] = 1.0
        elif of == SHIFTED:
            # It began at fixes that were stamped by tau too late: p - v tau, v - a tau.
            for i in range(3):
                force = step[STEP_SMOOTH_N + i]
                if i == 2:
                    force += gravity(nav[LAT], nav[HEIGHT])
                v[first + (3 + i) * width] = -force
                v[first + (6 + i) * width] = -nav[VN + i]
            for j in range(3):
                if slots[j] >= 0:
                    v[first + slots[j] * width] = -1.0


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8[::1], f8[::1])")
def begin_all(
    bank: Array, ints: Indices, n: int, width: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Begin all hypotheses anew; what the path was remains."""
    for kind in range(ints.shape[0]):
        for restart in range(RESTARTS):
            _begin_group(bank, ints, n, width, kind, restart, t_ns * 1e-9, nav, step)
    for level in range(len(PERIODS_NS)):
        bank[_RESTARTED + level] = t_ns // PERIODS_NS[level]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, i8)")
def _promote(bank: Array, ints: Indices, n: int, width: int, kind: int, restart: int) -> None:
    """A restart that is about to begin anew takes the place of the less likely one of the level
    above, if that is much less likely."""
    level = LEVEL_OF[restart] + 1
    if level >= len(SLOTS_OF):
        return
    at = GROUPS + RESTARTS * kind * GROUP
    odds, least, found = bank[at + restart * GROUP + LOG_ODDS], np.inf, -1
    for slot in range(BEGINS_AT[level], BEGINS_AT[level] + SLOTS_OF[level]):
        if bank[at + slot * GROUP + LOG_ODDS] < least:
            least, found = bank[at + slot * GROUP + LOG_ODDS], slot
    if found < 0 or not odds > least + PROMOTED:
        return
    for j in range(GROUP):
        bank[at + found * GROUP + j] = bank[at + restart * GROUP + j]
    v = bank[int(bank[SENSITIVITIES]) :]
    size = ints[kind, SIZE]
    for c in range(size):
        own = ints[kind, FIRST] + restart * size + c
        other = ints[kind, FIRST] + found * size + c
        first = own // width * n * width + own % width
        second = other // width * n * width + other % width
        for i in range(n):
            v[second + i * width] = v[first + i * width]


@compiled("void(f8[::1], i8[:, ::1], i8, i8, i8, f8[::1], f8[::1])")
def restart_due(
    bank: Array, ints: Indices, n: int, width: int, t_ns: int, nav: Array, step: Array
) -> None:
    """Begin anew those restarts whose turn has come at `t_ns`; of the longest period first, so that
    one that has just been handed on is not the next to begin."""
    for back in range(len(PERIODS_NS)):
        level = len(PERIODS_NS) - 1 - back
        turn = t_ns // PERIODS_NS[level]
        if bank[_RESTARTED + level] != turn:
            bank[_RESTARTED + level] = turn
            slot = BEGINS_AT[level] + turn % SLOTS_OF[level]
            for kind in range(ints.shape[0]):
                if ints[kind, SIGNATURE] == SHIFTED:  # it is so from the start on
                    continue
                _promote(bank, ints, n, width, kind, slot)
                _begin_group(bank, ints, n, width, kind, slot, t_ns * 1e-9, nav, step)


@compiled("void(f8[::1], f8[::1], f8, f8)")
def walk_path(bank: Array, nav: Array, now_s: float, step_s: float) -> None:
    """Carry the path on by `step_s` at the velocity of `nav` (10,), and keep where it is."""
    for i in range(3):
        bank[_PATH + i] += step_s * nav[VN + i]
    bank[_PATH_S] = now_s
    entries = int(bank[_ENTRIES])
    if entries > 0:
        last = HEAD + (entries - 1) % RING * POINT
        if now_s - bank[last] < RING_S - 1e-6:
            return
    at = HEAD + entries % RING * POINT
    bank[at] = now_s
    for i in range(3):
        bank[at + 1 + i], bank[at + 4 + i] = bank[_PATH + i], nav[VN + i]
    bank[_ENTRIES] = entries + 1.0


@compiled("f8(f8[::1], f8, i8)")
def _past(bank: Array, t_s: float, component: int) -> float:
    """Component (place 0 to 2, velocity 3 to 5) of the path at `t_s`, linear between two points;
    not a number where it is not kept."""
    entries = int(bank[_ENTRIES])
    for back in range(min(entries, RING) - 1):
        at = HEAD + (entries - 1 - back) % RING * POINT
        before = HEAD + (entries - 2 - back) % RING * POINT
        if bank[before] <= t_s:
            share = (t_s - bank[before]) / (bank[at] - bank[before])
            a, b = bank[before + 1 + component], bank[at + 1 + component]
            found: float = a + share * (b - a)
            return found
    return math.nan


@compiled("b1(i8[:, ::1], i8, i8, i8)", forceinline=True)
def concerns(ints: Indices, kind: int, measures: int, device: int) -> bool:
    """Whether a kind is of a device, or of any and this one locates or moves."""
    if ints[kind, DEVICE] == ANY:
        return bool(measures <= MOVES)
    of_this: bool = ints[kind, DEVICE] == device
    return of_this


@compiled("f8(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, f8, f8, f8[::1], i8, i8)")
def _signature(
    bank: Array,
    ints: Indices,
    numbers: Array,
    kind: int,
    measures: int,
    device: int,
    t_s: float,
    age_s: float,
    nav: Array,
    row: int,
    component: int,
) -> float:
    """D of a row for a component of a kind that has run for `age_s`."""
    of, d = ints[kind, SIGNATURE], 0.0
    if of <= SHIFTED or not concerns(ints, kind, measures, device):
        return 0.0
    if measures == PLACES and not ints[kind, LOCATES]:
        return 0.0
    if measures == MOVES and not ints[kind, MOVES_TOO]:
        return 0.0
    if of == DELAY:
        lag = numbers[kind, LAG]
        if measures == PLACES:
            d = bank[_PATH + row] + (t_s - bank[_PATH_S]) * nav[VN + row]
            d -= _past(bank, t_s - lag, row)
        elif measures == MOVES:
            d = nav[VN + row] - _past(bank, t_s - lag, 3 + row)
        return d if math.isfinite(d) else 0.0
    if of == SPEED:
        return -math.hypot(nav[VN], nav[VN + 1]) if measures == ROLLS else 0.0
    if row != component:
        return 0.0
    if measures == PLACES:
        if of == POSITION:
            d = -1.0
        elif of in (POSITION_RAMP, CARRIED):
            d = -age_s
    elif measures == MOVES:
        if of in (VELOCITY, CARRIED):
            d = -1.0
        elif of == VELOCITY_RAMP:
            d = -age_s
    elif measures == OTHER and of == ROWS:
        d = -1.0
    return d


@compiled(
    "i8(f8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8, i8, i8, f8[::1], f8[:, ::1], f8[::1],"
    "f8[:, ::1], f8[::1])"
)
def sensitivity_rows(
    bank: Array,
    ints: Indices,
    numbers: Array,
    n: int,
    width: int,
    t_ns: int,
    measures: int,
    device: int,
    nav: Array,
    h: Array,
    r: Array,
    g: Array,
    work: Array,
) -> int:
    """Write L^-1 (H V + D) of an aid's rows at `t_ns` to `work`, a row of columns each; how many
    columns. H (m, n), variances r (m,), g (m, w) = L^-1 H P as `whiten` leaves it; nav (10,)."""
    m, kinds = h.shape[0], ints.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    blocks = v.shape[0] // (n * width)
    columns: int = blocks * width
    t_s = t_ns * 1e-9
    for a in range(m):
        s = work[a * columns : (a + 1) * columns]
        along = 0.0
        for i in range(n):
            along += h[a, i] * g[a, i]
        # Of S = (h g) root + r, which is root^2.
        root = 0.5 * (along + math.sqrt(along * along + 4.0 * r[a]))
        for b in range(blocks):
            part = s[b * width : (b + 1) * width]
            for j in range(width):
                part[j] = 0.0
            for i in range(n):
                c = h[a, i]
                if c != 0.0:
                    first = (b * n + i) * width
                    rows = v[first : first + width]
                    for j in range(width):
                        part[j] += c * rows[j]
        for kind in range(kinds):
            if ints[kind, SIGNATURE] <= SHIFTED or not concerns(ints, kind, measures, device):
                continue
            size = ints[kind, SIZE]
            for restart in range(RESTARTS):
                age_s = t_s - bank[GROUPS + (RESTARTS * kind + restart) * GROUP + ONSET]
                for c in range(size):
                    s[ints[kind, FIRST] + restart * size + c] += _signature(
                        bank, ints, numbers, kind, measures, device, t_s, age_s, nav, a, c
                    )
        for b in range(a):
            common, before = 0.0, work[b * columns : (b + 1) * columns]
            for i in range(n):
                common += h[a, i] * g[b, i]
            for j in range(columns):
                s[j] -= common * before[j]
        for j in range(columns):
            s[j] /= root
    return columns


@compiled("void(f8[::1], i8[:, ::1], i8, i8, f8[::1], f8[:, ::1], b1, f8[::1])")
def account(
    bank: Array,
    ints: Indices,
    n: int,
    width: int,
    y: Array,
    g: Array,
    fused: bool,
    work: Array,
) -> None:
    """Take in what `sensitivity_rows` has left in `work` with the whitened innovation y (m,);
    `fused` where the filter folds the rows in, with g (m, w) as `whiten` leaves it."""
    m, kinds = y.shape[0], ints.shape[0]
    v = bank[int(bank[SENSITIVITIES]) :]
    blocks = v.shape[0] // (n * width)
    columns = blocks * width
    square = 0.0
    for a in range(m):
        square += y[a] * y[a]
    for kind in range(kinds):
        size = ints[kind, SIZE]
        for restart in range(RESTARTS):
            group = bank[GROUPS + (RESTARTS * kind + restart) * GROUP :]
            first = ints[kind, FIRST] + restart * size
            for a in range(m):
                s = work[a * columns + first :]
                for c in range(size):
                    group[E_AT + c] += s[c] * y[a]
                    for d in range(size):
                        group[L_AT + 3 * c + d] += s[c] * s[d]
            group[J_AT] += square
            group[N_AT] += m
    if fused:
        for b in range(blocks):
            for i in range(n):
                first = (b * n + i) * width
                rows = v[first : first + width]
                for a in range(m):
                    c = g[a, i]
                    if c != 0.0:
                        s = work[a * columns + b * width :]
                        for j in range(width):
                            rows[j] -= c * s[j]
