"""Fixed-rate tick: absolute deadlines on the monotonic clock, no backlog; garbage is collected
between ticks.

    deadline_k = t_0 + k * period

A tick that cannot start within its own period is skipped and counted as an overrun; later ticks
keep the phase of t_0. asyncio sleeps in whole milliseconds of epoll, so a tick starts up to 1 ms
after its deadline on an idle machine; it receives the deadline, not the time of waking.

Garbage is collected in the slack after a tick. A collection takes about 0.1 us for each object of
its generation. CPython starts one when far more objects were made than freed. A daemon with full
queues frees as many as it makes, so CPython's count stays low while the youngest generation grows:
50,000 objects, 0.1 s when measured. So this schedule goes by time: after each tick it examines the
few objects that the tick made.
"""

from __future__ import annotations

import asyncio
import gc
import time
from collections.abc import Awaitable, Callable
from math import ceil, log10

from fusiond.outputs.messages.health import SchedulerStatus

SECOND_NS = 1_000_000_000

_FIRST_BIN_NS = 10_000
_BINS_PER_DECADE = 10
_BINS = 6 * _BINS_PER_DECADE + 1

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


class Every:
    """Timer that is due once a period, by the ticks' time."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._next_ns = 0

    def waits(self, t_ns: int) -> bool:
        """True if `due` would be False."""
        return t_ns < self._next_ns

    def due(self, t_ns: int) -> bool:
        """True if a period has passed; missed periods are not made up for."""
        behind_ns = t_ns - self._next_ns
        if behind_ns < 0:
            return False
        start_ns = t_ns if behind_ns > self._period_ns else self._next_ns
        self._next_ns = start_ns + self._period_ns
        return True


class LatencyHistogram:
    """Histogram of latency in fixed log-spaced bins, ten a decade from 10 us to 10 s."""

    def __init__(self) -> None:
        self.bins = [0] * _BINS
        self.count = 0
        self.max_ns = 0
        self.sum_ns = 0

    def add(self, lateness_ns: int) -> None:
        index = 0
        if lateness_ns > _FIRST_BIN_NS:
            index = min(_BINS - 1, ceil(_BINS_PER_DECADE * log10(lateness_ns / _FIRST_BIN_NS)))
        self.bins[index] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, lateness_ns)
        self.sum_ns += lateness_ns

    def quantile_ms(self, p: float) -> float:
        """Upper edge (ms) of the bin with the quantile, at most 26 % high; 0 if empty."""
        wanted = p * self.count
        seen = 0
        for index, n in enumerate(self.bins):
            seen += n
            if n and seen >= wanted:
                edge_ns = _FIRST_BIN_NS * pow(10.0, index / _BINS_PER_DECADE)
                return min(float(edge_ns), self.max_ns) / 1e6
        return 0.0

    def at_most(self) -> tuple[tuple[float, int], ...]:
        """Ticks that were no later than each edge (s): two edges a decade, 0.1 ms to 1 s."""
        half = _BINS_PER_DECADE // 2
        edges = range(2 * half, 5 * _BINS_PER_DECADE + 1, half)
        return tuple(
            (_FIRST_BIN_NS * 1e-9 * pow(10.0, k / _BINS_PER_DECADE), sum(self.bins[: k + 1]))
            for k in edges
        )


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


class Scheduler:
    """Scheduler that calls `tick(deadline_ns)` at `rate_hz` until cancelled.

    It calls `on_time(now_ns)` after every tick that started within its own period and ended before
    the next; this feeds the watchdog. `now` and `sleep` (seconds) are the clock, which tests
    replace. An exception of `tick` ends `run`.
    """

    def __init__(
        self,
        rate_hz: float,
        tick: Callable[[int], None],
        *,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        on_time: Callable[[int], None] | None = None,
    ) -> None:
        self.period_ns = round(SECOND_NS / rate_hz)
        self._tick = tick
        self._now = now
        self._sleep = sleep
        self._on_time = on_time
        self._collector = Collector(now)
        self.lateness = LatencyHistogram()
        self.ticks = 0
        self.overruns = 0

    async def run(self) -> None:
        """Tick until cancelled; the first deadline is one period from now."""
        self._collector.start()
        try:
            await self._run()
        finally:
            self._collector.stop()

    async def _run(self) -> None:
        deadline = self._now() + self.period_ns
        while True:
            # Sleep even after a deadline: other tasks must run between two ticks.
            await self._sleep(max(0, deadline - self._now()) / SECOND_NS)
            behind_ns = self._now() - deadline
            if behind_ns < 0:
                continue
            self.lateness.add(behind_ns)
            missed = behind_ns // self.period_ns
            self.overruns += missed
            deadline += missed * self.period_ns
            self._tick(deadline)
            self.ticks += 1
            deadline += self.period_ns
            now = self._now()
            if self._on_time is not None and not missed and now < deadline:
                self._on_time(now)
            self._collector.use_slack(deadline - now)

    def status(self) -> SchedulerStatus:
        """A snapshot for `health`."""
        return SchedulerStatus(
            ticks=self.ticks,
            overruns=self.overruns,
            lateness_p50_ms=self.lateness.quantile_ms(0.5),
            lateness_p99_ms=self.lateness.quantile_ms(0.99),
            lateness_max_ms=self.lateness.max_ns / 1e6,
            lateness_sum_s=self.lateness.sum_ns / SECOND_NS,
            lateness_at_most=self.lateness.at_most(),
            gc_collections=self._collector.collections,
            gc_forced=self._collector.forced,
            gc_max_ms=self._collector.max_ns / 1e6,
        )
