"""Stepwise factors on samples, looked up by the samples' instants."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NEVER_NS = 1 << 62
_KEPT = 3
"""Steps kept: the last valid one and two future ones."""


class FromInstants:
    """Stepwise factors; 1 before the first step."""

    def __init__(self) -> None:
        self._known: list[tuple[int, Array]] = []

    def add(self, since_ns: int, factors: Array) -> None:
        """Add factors for samples of `since_ns` and later; steps come in order."""
        self._known = [*self._known[1 - _KEPT :], (since_ns, factors)]

    def rows(self, times: Stamps) -> Iterator[tuple[slice, Array]]:
        """Factors as rows for times (m,) ns, m > 0; None before the first step."""
        for k, (since_ns, factors) in enumerate(self._known):
            ends_ns = self._known[k + 1][0] if k + 1 < len(self._known) else _NEVER_NS
            if times[-1] >= since_ns and times[0] < ends_ns:
                first, end = np.searchsorted(times, (since_ns, ends_ns)).tolist()
                yield slice(first, end), factors
