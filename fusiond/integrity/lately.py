r"""The last two innovations of a velocity: what they leave open that no mean shows yet.

A mean looks back at eleven innovations and more (fusiond.integrity.means). At one fix a second an
inertial unit that has changed has taken the velocity away by then, and of a receiver that is not
known yet some of what the means show is put down to its errors. With y (d,) whitened, of variance
one, the last alone and the mean of the last two,

    y_k        (y_k + y_k-1) / 2

are each beyond what chance does once in a thousand if a component's square is beyond 10.83 and
10.83 / 2. What such a one has beyond chance is left open until the next is there, as it is of a
mean: horizontally whatever the direction, for a vehicle that turns takes the error along.

A filter follows a velocity that is off by little, and innovations do not show it any more: either
it was wrong, or the velocity is still. What some in a row have shown, or a mean of theirs, for T
from the first to the last is open by the largest of it as what parts from the filter is
(fusiond.integrity.moved),

    sigma^2 T / (T + t)

t after the last, for 19 T; if a mean was beyond what chance does once in ten thousand, or the sum
of n innovations, one that was refused among them, once in a million, by chi-square of three:

    m^2 > 15.14 s          |sum y|^2 > 30.66 n

So is a position that the filter follows, whose mean was: what a step has brought is there when the
mean shows it no more.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.means import LIKELY, open_by
from fusiond.integrity.moved import UNLIKELY
from fusiond.navigation.error_model import DV

Array = NDArray[np.float64]

# Of a chi-square of one, by chance once in a thousand.
SELDOM = 10.83
# Of one once in ten thousand, of three once in a million.
RARE, MILLIONTH = 15.14, 30.66
_NONE = (0.0, 0.0, 0.0)


class Lately(NamedTuple):
    """The last innovation of a velocity, whitened, and the one before it, 0 where there is none,
    with the sum of the squares of each."""

    last: tuple[float, ...] = _NONE
    square: float = 0.0
    before: tuple[float, ...] = _NONE
    square_before: float = 0.0

    def and_then(self, whitened: tuple[float, ...], square: float) -> Lately:
        """With one more."""
        return Lately(whitened, square, self.last, self.square)

    @property
    def seldom(self) -> bool:
        """Whether chance does so once in a thousand, of each component and either of the two."""
        if self.square + self.square_before <= SELDOM:  # (a + b)^2 <= 2 (a^2 + b^2)
            return False
        for a, b in zip(self.last, self.before, strict=False):
            if a * a > SELDOM or (a + b) * (a + b) > 2.0 * SELDOM:
                return True
        return False

    def leaves_open(self, covariance: Array, sd: Sequence[float], coarse: float) -> Array:
        """Variances (9,) of what is published, of a velocity with `sd` (d,) that counted with
        `coarse` times that; P (n, n) of the filter."""
        out = np.zeros(9)
        pairs = zip(self.last, self.before, strict=False)
        excess = [max(a * a - LIKELY, 0.25 * (a + b) ** 2 - 0.5 * LIKELY) for a, b in pairs]
        excess[:2] = [max(excess[:2])] * 2
        for axis, (beyond, one) in enumerate(zip(excess, sd, strict=False)):
            open_by(beyond, covariance, DV + axis, (coarse * one) ** 2, out)
        return out


NOT_YET = Lately()


class Apart(NamedTuple):
    """The largest that innovations from `since_ns` to `until_ns` have left open (9,); of the `n` of
    these that did by themselves the `sums` (3,), whitened; `mean`: one of theirs was no chance."""

    since_ns: int
    until_ns: int
    largest: tuple[float, ...]
    n: int
    sums: tuple[float, ...]
    mean: bool

    def leaves_open(self, t_ns: int) -> Array | None:
        """Variances (9,) of what is published; None where it is nothing any more."""
        if t_ns <= self.until_ns:
            return np.array(self.largest)
        share = (self.until_ns - self.since_ns) / (t_ns - self.since_ns)
        sure = self.mean or sum(y * y for y in self.sums) > MILLIONTH * self.n
        return share * np.array(self.largest) if sure and share >= UNLIKELY else None


class Shown(NamedTuple):
    """What an innovation leaves open (9,): by itself, where it is `whitened` (d,), or in a `mean`,
    where that was no chance."""

    wider: Array
    whitened: Sequence[float] = ()
    mean: bool = False


def goes_on(before: Apart | None, t_ns: int, every_ns: int, shown: Shown | None) -> Apart | None:
    """What is apart after an innovation at `t_ns`, `every_ns` after the last."""
    kept = None if before is None else before.leaves_open(t_ns)
    if shown is None:
        return None if kept is None else before
    sums, largest = (*shown.whitened, 0.0, 0.0, 0.0)[:3], shown.wider
    n, mean = int(any(sums)), shown.mean
    if before is not None and before.until_ns >= t_ns - every_ns:
        since_ns, n, mean = before.since_ns, before.n + n, before.mean or mean
        sums = tuple(map(operator.add, before.sums, sums))
        largest = np.maximum(before.largest, largest)
    elif before is not None and kept is not None and not (n or mean):  # chance, once in twenty
        return before
    elif before is not None and kept is not None:  # what is left of it goes on for as long
        since_ns = t_ns - (before.until_ns - before.since_ns)
        n, sums, mean = before.n, before.sums, before.mean
        largest = np.maximum(kept, largest)
    else:
        since_ns = t_ns
    return Apart(since_ns, t_ns, tuple(largest.tolist()), n, sums, mean)


def refused(by: tuple[float, float], nis: float) -> Shown:
    """A velocity that is refused and off `by` (m/s, north and east), to which all of its innovation
    is put down."""
    off, wider = math.hypot(*by), np.zeros(9)
    wider[3:5] = off * off
    share = -math.sqrt(nis) / off if off > 0.0 else 0.0
    return Shown(wider, (share * by[0], share * by[1]))
