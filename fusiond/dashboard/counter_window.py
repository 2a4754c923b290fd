"""Counts of the last minute, from counters since the daemon's start. With them an alarm ends with
its cause."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

WINDOW_S = 60.0
"""Length of the window (s): it has 6000 ticks at 100 Hz, so that six late ones in a thousand are no
accident."""


class CounterWindow:
    """Counts of `names`, counters of one topic, over the last minute. A decreasing counter shows a
    restart of the daemon."""

    def __init__(self, *names: str) -> None:
        self._names = names
        self._window: deque[tuple[float, dict[str, int]]] = deque()

    def of(self, said: Mapping[str, Any], at_s: float) -> dict[str, Any]:
        """Message with each counter less its value a minute ago, or at the first message since
        then."""
        now = {name: said[name] for name in self._names if isinstance(said.get(name), int)}
        if self._window and any(now.get(n, 0) < k for n, k in self._window[-1][1].items()):
            self._window.clear()
        self._window.append((at_s, now))
        while self._window[0][0] < at_s - WINDOW_S:
            self._window.popleft()
        first = self._window[0][1]
        return {**said, **{name: k - first.get(name, 0) for name, k in now.items()}}
