"""What an aid is to a kernel that knows its kind: slots of the model and numbers, made once.

`fusiond.aiding.rows` writes the innovation of such an aid; `Aid.packed` makes it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POSITION, VELOCITY, SPEED, AMOUNT, NO_SLIP = range(5)
"""Kinds; `AMOUNT` is a speed of which the sign is not measured."""
KIND, ROWS, COUNTS, LISTS = 0, 1, 2, 4
"""Where `Packed.slots` has the kind, the number of rows m, how many slots there are in each of the
`LISTS`, and from `SLOTS` on one list after another."""
SLOTS = COUNTS + LISTS


class Packed(NamedTuple):
    """`slots` (k,) as above, shared by the aids of one device; `numbers` (j,) as its kind has them,
    in SI units."""

    slots: Indices
    numbers: Array


def slots_of(kind: int, rows: int, *lists: Indices) -> Indices:
    """The slots of aids of a kind and so many rows."""
    counts = np.zeros(LISTS, dtype=np.int64)
    counts[: len(lists)] = [len(each) for each in lists]
    return np.concatenate([np.array([kind, rows]), counts, *lists])
