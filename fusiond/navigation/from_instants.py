"""Factors on what samples show that change at instants: which ones count is the sample's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NEVER_NS = 1 << 62
_KEPT = 3
"""Those that samples may still come for: the last that counts and two that will."""


class FromInstants:
    """One until the first."""

    def __init__(self) -> None:
        self._known: list[tuple[int, Array]] = []

    def add(self, since_ns: int, factors: Array) -> None:
        """They count for samples of `since_ns`, later than those before, and after."""
        self._known = [*self._known[1 - _KEPT :], (since_ns, factors)]

    def rows(self, times: Stamps) -> Iterator[tuple[slice, Array]]:
        """Rows of times (m,) ns, m > 0, by the factors that count for them; none of before the
        first."""
        for k, (since_ns, factors) in enumerate(self._known):
            ends_ns = self._known[k + 1][0] if k + 1 < len(self._known) else _NEVER_NS
            if times[-1] >= since_ns and times[0] < ends_ns:
                first, end = np.searchsorted(times, (since_ns, ends_ns)).tolist()
                yield slice(first, end), factors
