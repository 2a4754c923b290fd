r"""The last two innovations of a velocity: what they leave open that no mean shows yet.

A mean looks back at eleven innovations and more (fusiond.integrity.means). At one fix a second an
inertial unit that has changed has taken the velocity away by then, and of a receiver that is not
known yet some of what the means show is put down to its errors. With y (d,) whitened, of variance
one, the last alone and the mean of the last two,

    y_k        (y_k + y_k-1) / 2

are each beyond what chance does once in a thousand if a component's square is beyond 10.83 and
10.83 / 2. What such a one has beyond chance is left open until the next is there, as it is of a
mean: horizontally whatever the direction, for a vehicle that turns takes the error along.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.integrity.means import LIKELY, open_by
from fusiond.navigation.error_model import DV

Array = NDArray[np.float64]

# Of a chi-square of one, by chance once in a thousand.
SELDOM = 10.83
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
