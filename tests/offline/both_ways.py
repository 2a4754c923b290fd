"""Recorded files through `process` and through the daemon's chain, and what came of both."""

from __future__ import annotations

from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriverStatus
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.events import Events
from fusiond.live.sources import Source
from fusiond.navigator.navigator import Navigator
from fusiond.offline.process import process
from fusiond.offline.run_input import read_recorded
from tests.clock.host_time import Host
from tests.offline.options_drive import measurements

Array = NDArray[np.float64]


class Told(NamedTuple):
    """Where it is, how sure, how each measurement ended."""

    state: Array
    bounds: Array
    words: tuple[Any, ...]
    t_ns: int

    def same(self, other: Told, rounding: float = 1e-9) -> bool:
        """To the rounding of as many steps; tables hold times of today to 0.2 us."""
        close = partial(np.allclose, rtol=rounding, atol=1e-3 * rounding, equal_nan=True)
        if self.words != other.words or self.state.shape != other.state.shape:
            return False
        if abs(self.t_ns - other.t_ns) > 1000:
            return False
        return close(self.state, other.state) and close(self.bounds, other.bounds)


def told(navigator: Navigator) -> Told:
    e = navigator.estimator
    outcomes = navigator.timeline.counters.outcomes
    ended = {source: dict(+counts) for source, counts in outcomes.items() if +counts}
    refused = {source: dict(counts) for source, counts in navigator.outcome_watch.refused.items()}
    reports = navigator.verdicts.reports()
    verdicts = {name: (r.verdict, r.window_verdict, r.k, r.alpha) for name, r in reports.items()}
    solution = navigator.solution(navigator.imu.latest_ns)
    state = np.concatenate([np.ravel(a) for a in (e.nav, e.xi, e.covariance)])
    bounds = [x for x in astuple(solution.bound) if isinstance(x, float)]
    words = ended, refused, verdicts, solution.mode, solution.reason
    return Told(state, np.array(bounds), words, solution.t_ns)


def by_process(config: Config, files: Path) -> Told:
    seen: list[Navigator] = []
    process(config, files / "imu.csv", measurements(config, files), watch=seen.append)
    return told(seen[-1])


def by_daemon(config: Config, files: Path) -> Told:
    """The same arrivals through the daemon's chain, a tick a sample."""
    read = read_recorded(config, files / "imu.csv", measurements(config, files), (), None, None)
    times = np.rint(read.imu.t_s * 1e9).astype(np.int64)
    host = Host(mono=int(times[0]), true_utc_at_zero=0)
    clock = Clock(config.clock, host)
    chain = Chain(config, clock, Events(clock))
    tick_ns = round(1e9 / config.scheduler.rate_hz)
    begin, end = (int(times[k]) // tick_ns for k in (0, -1))
    given = taken = 0
    for k in range(begin, end + 2):
        while given < len(read.arrivals) and read.arrivals[given].t_arrival_ns <= k * tick_ns:
            item: Any = read.arrivals[given].measurement
            host.mono = read.arrivals[given].t_arrival_ns
            chain.sources.all.setdefault(item.source, Source(item.source, _Device()))
            chain.sources._emit(item)
            given += 1
        while taken < len(times) and times[taken] <= k * tick_ns:
            row = int(times[taken]), tuple(read.imu.samples[taken].tolist())
            chain.sources.imu.waiting.append(row)
            taken += 1
        host.mono = k * tick_ns
        chain.tick(k * tick_ns)
    return told(chain.navigator)


class _Device:
    status = DriverStatus()
