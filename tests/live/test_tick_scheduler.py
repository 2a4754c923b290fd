"""The fixed-rate tick on a simulated clock, and once on the real one."""

from __future__ import annotations

import asyncio
import gc
import itertools
from collections import deque
from collections.abc import Callable
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.live.tick_scheduler import Collector, LatencyHistogram, Scheduler

MS = 1_000_000
S = 1_000_000_000


class Simulation:
    """Monotonic time that moves only by sleeping and by what a tick costs."""

    def __init__(self, seconds: float) -> None:
        self.t_ns = 17 * S
        self.end_ns = self.t_ns + round(seconds * S)

    def now(self) -> int:
        return self.t_ns

    async def sleep(self, seconds: float) -> None:
        self.t_ns += round(seconds * S)
        if self.t_ns > self.end_ns:
            raise asyncio.CancelledError
        await asyncio.sleep(0)


async def run(
    simulation: Simulation,
    rate_hz: float,
    tick: Callable[[int], None],
    **hooks: Callable[[int], None],
) -> Scheduler:
    scheduler = Scheduler(rate_hz, tick, now=simulation.now, sleep=simulation.sleep, **hooks)
    with pytest.raises(asyncio.CancelledError):
        await scheduler.run()
    return scheduler


async def test_deadlines_are_absolute_and_every_tick_is_on_time() -> None:
    simulation = Simulation(1.0)
    ticks: list[int] = []
    fed: list[int] = []

    def tick(t_ns: int) -> None:
        ticks.append(t_ns)
        simulation.t_ns += 3 * MS

    scheduler = await run(simulation, 100.0, tick, on_time=fed.append)
    assert ticks == [17 * S + k * 10 * MS for k in range(1, 101)]
    status = scheduler.status()
    assert (status.ticks, status.overruns, len(fed)) == (100, 0, 100)
    assert status.lateness_max_ms == 0.0


async def test_overrun_skips_what_was_missed_keeps_phase_and_starves_the_watchdog() -> None:
    simulation = Simulation(0.2)
    ticks: list[int] = []
    fed: list[int] = []

    def tick(t_ns: int) -> None:
        ticks.append((t_ns - 17 * S) // MS)
        simulation.t_ns += 35 * MS if ticks[-1] == 50 else MS

    scheduler = await run(simulation, 100.0, tick, on_time=lambda t: fed.append((t - 17 * S) // MS))
    # The tick at 50 ends at 85: 60 and 70 are lost, 80 starts 5 ms late, 90 is on time again.
    assert ticks == [10, 20, 30, 40, 50, 80, 90, 100, *range(110, 201, 10)]
    assert scheduler.overruns == 2
    assert 51 not in fed
    assert 86 not in fed
    assert 91 in fed
    assert scheduler.status().lateness_max_ms == 25.0


async def test_a_tick_that_is_always_too_long_never_feeds_the_watchdog_but_lets_others_run() -> (
    None
):
    simulation = Simulation(1.0)
    fed: list[int] = []
    others = 0

    def tick(_: int) -> None:
        simulation.t_ns += 25 * MS

    async def other() -> None:
        nonlocal others
        while True:
            others += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(other())
    scheduler = await run(simulation, 100.0, tick, on_time=fed.append)
    task.cancel()
    assert fed == []
    assert others >= scheduler.ticks >= 30
    assert scheduler.overruns + scheduler.ticks == pytest.approx(100, abs=3)


@given(st.lists(st.integers(0, 60 * MS), min_size=1, max_size=50), st.sampled_from([50.0, 100.0]))
@settings(max_examples=30, deadline=None)
def test_any_load_keeps_the_grid_and_loses_nothing_uncounted(costs: list[int], rate: float) -> None:
    simulation = Simulation(1.0)
    left = list(costs)
    ticks: list[int] = []

    def tick(t_ns: int) -> None:
        ticks.append(t_ns)
        assert t_ns <= simulation.t_ns < t_ns + S // int(rate)
        simulation.t_ns += left.pop() if left else 0

    # What is left to the collector is another test's; here each schedule would begin with looking
    # through all that the tests have imported.
    with patch.object(gc, "collect"):
        scheduler = asyncio.run(run(simulation, rate, tick))
    period = scheduler.period_ns
    assert all((t - 17 * S) % period == 0 for t in ticks)
    assert all(b > a for a, b in itertools.pairwise(ticks))
    assert scheduler.ticks + scheduler.overruns == (ticks[-1] - 17 * S) // period


async def test_exception_of_a_tick_leaves_run_and_garbage_collection_is_restored() -> None:
    simulation = Simulation(1.0)

    def tick(_: int) -> None:
        assert not gc.isenabled()
        raise RuntimeError("broken navigator")

    scheduler = Scheduler(100.0, tick, now=simulation.now, sleep=simulation.sleep)
    assert gc.isenabled()
    with pytest.raises(RuntimeError, match="broken navigator"):
        await scheduler.run()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


async def test_garbage_is_collected_between_ticks() -> None:
    simulation = Simulation(2.0)
    alive = 0

    class Knot:
        def __init__(self) -> None:
            nonlocal alive
            alive += 1
            self.me = self

        def __del__(self) -> None:
            nonlocal alive
            assert not ticking
            alive -= 1

    ticking = False

    def tick(_: int) -> None:
        nonlocal ticking
        ticking = True
        for _ in range(200):
            Knot()
        ticking = False

    scheduler = await run(simulation, 100.0, tick)
    status = scheduler.status()
    assert status.gc_collections > 10
    assert status.gc_forced == 0
    assert alive < 5000  # of 40000 made


async def test_what_a_collection_looks_through_stays_little_where_as_much_goes_as_comes() -> None:
    """A full queue: CPython's count of what is new stands still, and what is young would grow."""
    simulation, queue = Simulation(2.0), deque[list[object]](maxlen=2000)
    young: list[int] = []

    def tick(_: int) -> None:
        young.append(len(gc.get_objects(0)))
        for _ in range(20):
            queue.append([[]])

    await run(simulation, 100.0, tick)
    assert len(queue) == 2000
    assert max(young[100:]) < 1000, "some ticks' worth, of 4000 that came while it was full"


@pytest.mark.parametrize(("cost_ms", "seconds"), [(1, (10.0,)), (12, (3.3, 6.7)), (40, (1.0, 2.0))])
def test_the_oldest_generation_is_looked_through_by_its_cost(
    cost_ms: int, seconds: tuple[float, ...]
) -> None:
    """Full of garbage it is dear, and is emptied more often; never later than twice as long."""
    now_ns, old = 0, list[int]()

    def collect(generation: int) -> int:
        nonlocal now_ns
        if generation == 2:
            old.append(now_ns)
            now_ns += cost_ms * MS
        return 1

    collector = Collector(lambda: now_ns)
    with patch.object(gc, "collect", collect):
        for _ in range(10_000):
            now_ns += 10 * MS
            collector.use_slack(8 * MS)
    between_s = [(b - a) / S for a, b in itertools.pairwise(old)][1:]
    assert min(seconds) - 0.1 <= min(between_s)
    assert max(between_s) <= max(seconds) + 0.2
    assert collector.max_ns == cost_ms * MS


def test_where_there_is_no_garbage_it_is_looked_for_seldom() -> None:
    """What lives costs as much to look through; with the first garbage it is as it was."""
    now_ns, old = 0, list[int]()

    def collect(generation: int) -> int:
        nonlocal now_ns
        if generation == 2:
            old.append(now_ns)
            now_ns += 5 * MS
        return 3 if len(old) == 10 else 0

    collector = Collector(lambda: now_ns)
    with patch.object(gc, "collect", collect):
        for _ in range(200_000):
            now_ns += 10 * MS
            collector.use_slack(9 * MS)
    between_s = [round((b - a) / S) for a, b in itertools.pairwise(old)]
    assert between_s[:10] == [20, 40, 80, 160, 320, 320, 320, 320, 320, 10]
    assert collector.forced == 0


async def test_collection_is_forced_when_there_is_never_slack() -> None:
    simulation = Simulation(15.0)

    def tick(_: int) -> None:
        for _ in range(200):
            knot: list[object] = []
            knot.append(knot)
        simulation.t_ns += 10 * MS

    scheduler = await run(simulation, 100.0, tick)
    assert scheduler.status().gc_forced > 0


def test_histogram_quantiles() -> None:
    histogram = LatencyHistogram()
    assert histogram.quantile_ms(0.5) == 0.0
    for ns in [50_000] * 980 + [3 * MS] * 19 + [10**12]:
        histogram.add(ns)
    assert 0.05 <= histogram.quantile_ms(0.5) <= 0.05 * 1.26
    assert 3.0 <= histogram.quantile_ms(0.99) <= 3.0 * 1.26
    assert histogram.max_ns == 10**12
    assert sum(histogram.bins) == histogram.count == 1000


async def test_on_the_real_clock() -> None:
    ticks: list[int] = []
    done = asyncio.Event()

    def tick(t_ns: int) -> None:
        ticks.append(t_ns)
        if len(ticks) == 20:
            done.set()

    scheduler = Scheduler(200.0, tick)
    task = asyncio.create_task(scheduler.run())
    await done.wait()
    task.cancel()
    assert all((b - a) % scheduler.period_ns == 0 for a, b in itertools.pairwise(ticks))
    assert scheduler.lateness.count >= 20
