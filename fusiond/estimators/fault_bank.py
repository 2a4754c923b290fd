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

All of it lies in the filter's memory: a snapshot copies it, a rewind restores it to the bit. How is
said here; onsets are in fusiond.estimators.fault_onsets, signatures and evidence in
fusiond.estimators.fault_rows, odds in fusiond.estimators.fault_odds.

Source: Friedland, Treatment of bias in recursive filtering, IEEE Trans. AC 14 (1969), 359; Willsky,
Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Trans. AC 21 (1976), 108.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

STATES, TURNED, SHIFTED, FOLLOWED = range(4)
"""Signatures that are a step of states: of one number in all of them or of as many numbers; of the
attitude, about body axes, and of the mounting; of all that moves, as if it were another instant,
from the start on; of what a source's faults, as they are weighed, have done to the filter."""
POSITION, POSITION_RAMP, VELOCITY, VELOCITY_RAMP, CARRIED, DELAY, SPEED, ROWS = range(4, 12)
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
# And of their numbers: prior sigmas (3), log of the rate (1/s), delay (s), the amount's prior mean,
# whether its size is known to be of that prior (1 or 0).
PRIOR, LOG_RATE, LAG, MEAN, BOUNDED = 0, 3, 4, 5, 6
KIND_NUMBERS = 7

# The bank's array: head, ring of the path, groups, sensitivities. The head holds which restart each
# age is at (4), the instant (s), place (m) and number of entries of the path, where V begins.
RESTARTED, PATH_S, PATH, ENTRIES, SENSITIVITIES, HEAD = 0, 4, 5, 8, 9, 16
RING, POINT, RING_S = 64, 7, 0.1
GROUPS = HEAD + RING * POINT
# A group: L (9), e (3), J, N, onset (s), log odds, weight, what is left unexplained beyond chance,
# since which epoch (s) it has been likely and explained all, or never; log of what its rate counts
# by; what it explains, l.
L_AT, E_AT, J_AT, N_AT, ONSET, LOG_ODDS, WEIGHT, UNEXPLAINED, LIKELY = 0, 9, *range(12, 19)
COUNTS_BY, EXPLAINED, GROUP = 19, 20, 21
UNEXPLAINED_SIGMAS = 4.0
"""One in 30,000, of chi-square by its mean and variance (2 N): who leaves more does not fit."""
DECIDED = 7.0
"""Log odds beyond which a hypothesis is likely: a thousand to one."""
LASTS_S = 1.0
"""For so long it must have been: a receiver's errors of a second are one error."""


class FaultTable(NamedTuple):
    """Kinds of faults as the kernels read them, `ints` (k, 10) and `numbers` (k, 7), how many
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
