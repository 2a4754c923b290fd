"""Schedule of the cyclic garbage collector, which runs in the slack after a tick.

A collection takes about 0.1 us for each object of its generation. CPython starts one when far more
objects were made than freed. A daemon with full queues frees as many as it makes, so CPython's
count stays low while the youngest generation grows: 50,000 objects, 0.1 s when measured. So this
schedule goes by time: after each tick it examines the few objects that the tick made.
"""

from __future__ import annotations

import gc
from collections.abc import Callable

_MS = 1_000_000
_DUE_NS = (0, 100 * _MS, 10_000 * _MS)
"""Intervals of the generations: the youngest after every tick (0.02 ms), the middle one after ten,
as in CPython; the oldest, which holds some 10,000 live objects (3 ms), seldom."""
_FORCED_NS = (100 * _MS, 1_000 * _MS, 20_000 * _MS)
"""Cycles hold memory, and each collection takes longer: done now if no slack was long enough."""
_DEAR_NS = 4 * _MS
"""The oldest generation was full of garbage: then it is looked through more often, by as much."""
_LONGEST_WAIT = 32
"""Longest back-off, 320 s: the wait doubles where there was no garbage at all. Live objects cost 4
to 11 ms each time, a whole tick after a long one."""
_SLACK_MARGIN_NS = 500_000


class Collector:
    """Scheduled collector. `now` (ns) is the scheduler's clock; `forced` counts collections that
    did not fit the slack."""

    def __init__(self, now: Callable[[], int]) -> None:
        self._now = now
        self._cost_ns = [0, 0, 0]
        self._last_ns = [0, 0, 0]
        self._backoff = 1
        """Factor on the intervals of the oldest generation."""
        self._was_enabled = gc.isenabled()
        self.collections = 0
        self.forced = 0
        self.max_ns = 0

    def start(self) -> None:
        """Exempt the objects of the start-up from all later collections."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self._last_ns = [self._now()] * 3

    def stop(self) -> None:
        """Restore the collector's settings."""
        gc.unfreeze()
        if self._was_enabled:
            gc.enable()

    def use_slack(self, slack_ns: int) -> None:
        """Collect the oldest generation that is due, if one and a half times its last cost fits the
        slack."""
        start_ns = self._now()
        for generation in (2, 1, 0):
            cost_ns = self._cost_ns[generation]
            since_ns = start_ns - self._last_ns[generation]
            if generation == 2:
                dear = max(1, cost_ns // _DEAR_NS) if self._backoff == 1 else 1
                since_ns = since_ns * dear // self._backoff
            if since_ns < _DUE_NS[generation]:
                continue
            fits = 3 * cost_ns // 2 + _SLACK_MARGIN_NS < slack_ns
            if fits or since_ns >= _FORCED_NS[generation]:
                found = gc.collect(generation)
                cost_ns = self._now() - start_ns
                self._cost_ns[generation] = cost_ns
                self._last_ns[: generation + 1] = [start_ns] * (generation + 1)
                if generation == 2:
                    self._backoff = 1 if found else min(2 * self._backoff, _LONGEST_WAIT)
                self.max_ns = max(self.max_ns, cost_ns)
                self.collections += 1
                self.forced += not fits
                return
