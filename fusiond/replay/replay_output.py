"""`fusiond replay`: solution of a replayed log as files or over MQTT."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fusiond.configuration.schema import Config
from fusiond.files.solution_csv import STATUS, SolutionWriter
from fusiond.live.publishing import Publishing
from fusiond.live.tick_scheduler import SECOND_NS, LatencyHistogram
from fusiond.navigation.solution import Solution
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.health import SchedulerStatus
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import EVENT
from fusiond.recording.reader import Log
from fusiond.replay.replay import Replay, ReplayedTick
from fusiond.replay.replay_config import replay_config

SOLUTION, EVENTS = "solution.csv", "events.csv"
ROWS = 4096
"""Most solutions that wait to be written together."""
FAREWELL_S = 1.0
"""Time (s) for the last messages of a published replay."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Options of a replay: configuration, single settings, output files, and the speed at which it
    is published (None: not published, at full speed)."""

    config: Path | None = None
    settings: tuple[str, ...] = ()
    out: Path | None = None
    speed: float | None = None


def replay(paths: Sequence[Path], wish: ReplayOptions) -> dict[str, Any]:
    """Replay a recording and return its summary. `times_real_time` is by CPU time.

    `identical` is None without digests to compare. Raises `LogError`, `ConfigError`, OSError.
    """
    recording = Log(paths)
    with TemporaryDirectory(prefix="fusiond-replay-") as folder, contextlib.ExitStack() as stack:
        same = wish.config is None and not wish.settings
        config = replay_config(recording.about, Path(folder), wish.config, wish.settings)
        out = None if wish.out is None else stack.enter_context(_Files(wish.out, recording))
        run = _Run(recording, config, same, out)
        began = time.process_time()
        if wish.speed is None:
            for tick in run.replay.ticks():
                run.add(tick)
        else:
            asyncio.run(_publish(run, config, wish.speed))
        return run.summary(time.process_time() - began)


class _Files:
    """Output files in a folder: `solution.csv` with a row a tick, and `events.csv`; t_s is POSIX
    time by the log."""

    def __init__(self, folder: Path, recording: Log) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._epoch_ns = recording.about.epoch_ns
        self._solution = SolutionWriter(folder / SOLUTION)
        self._events = (folder / EVENTS).open("w", encoding="utf-8")
        self._events.write("t_utc,level,source,code,text\n")
        self._rows: list[Solution] = []

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *_: object) -> None:
        self._write()
        self._solution.close()
        self._events.close()

    def solution(self, solution: Solution) -> None:
        self._rows.append(solution)
        if len(self._rows) >= ROWS:
            self._write()

    def event(self, e: EventMessage) -> None:
        text = e.text.replace('"', '""')
        self._events.write(f'{e.t_utc or ""},{e.level},{e.source},{e.code},"{text}"\n')

    def _write(self) -> None:
        rows, self._rows = self._rows, []
        if not rows:
            return
        self._solution.rows(
            np.array([(s.t_ns + self._epoch_ns) * 1e-9 for s in rows]),
            np.array([s.lat_rad for s in rows]),
            np.array([s.lon_rad for s in rows]),
            np.array([s.height_m for s in rows]),
            np.array([s.v_ned_m_s for s in rows]),
            np.array([s.rpy_rad for s in rows]),
            np.array([(*s.sd_ned_m, *s.sd_v_ned_m_s, *s.sd_rpy_rad) for s in rows]),
            np.array([STATUS.index(s.mode) for s in rows], dtype=np.int64),
        )


class _Run:
    """Replay with its counters."""

    def __init__(self, recording: Log, config: Config, same: bool, out: _Files | None) -> None:
        self._recording = recording
        self._out = out
        self.listeners: list[Callable[[EventMessage], None]] = []
        self.replay = Replay(recording, config, same, on_event=self._event)
        self._modes: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._latency = LatencyHistogram()
        self._overruns = 0

    def add(self, tick: ReplayedTick) -> None:
        solution = tick.solution
        self._modes[solution.mode] += 1
        self._first_ns = solution.t_ns if self._first_ns is None else self._first_ns
        self._last_ns = solution.t_ns
        self._latency.add(max(0, tick.recorded.latency_ns))
        self._overruns = tick.recorded.overruns
        if self._out is not None:
            self._out.solution(solution)

    def _event(self, message: EventMessage) -> None:
        if self._out is not None:
            self._out.event(message)
        for listener in self.listeners:
            listener(message)

    def scheduler(self) -> SchedulerStatus:
        """State of the recorded daemon's scheduler."""
        return SchedulerStatus(
            ticks=self.replay.comparison.ticks,
            overruns=self._overruns,
            lateness_p50_ms=self._latency.quantile_ms(0.5),
            lateness_p99_ms=self._latency.quantile_ms(0.99),
            lateness_max_ms=self._latency.max_ns / 1e6,
            lateness_sum_s=self._latency.sum_ns / SECOND_NS,
            lateness_at_most=self._latency.at_most(),
            gc_collections=0,
            gc_forced=0,
            gc_max_ms=0.0,
        )

    def summary(self, cpu_s: float) -> dict[str, Any]:
        c, about = self.replay.comparison, self._recording.about
        first = None
        if c.first is not None:
            t_utc = stamp(c.first.t_ns + about.epoch_ns)[0]
            first = {"tick": c.first.tick, "t_utc": t_utc, "what": c.first.what}
        duration_s = (self._last_ns - (self._first_ns or self._last_ns)) * 1e-9
        chain = self.replay.chain
        outcomes = {} if chain is None else chain.navigator.outcomes()
        return {
            "vehicle": about.metadata["vehicle"],
            "recorded_by": about.metadata["version"],
            "started_from": self.replay.began,
            "duration_s": round(duration_s, 3),
            "times_real_time": round(duration_s / cpu_s, 1) if cpu_s > 0 else None,
            "ticks": c.ticks,
            "compared": c.compared,
            "identical": c.first is None if c.compared else None,
            "first_difference": first,
            "differing_ticks": c.differing,
            "modes": {m: round(n / c.ticks, 4) for m, n in self._modes.items()},
            "outcomes": {source: dict(counts) for source, counts in outcomes.items()},
            "driver_faults": c.faults,
            "problems": self._recording.problems,
        }


async def _publish(run: _Run, config: Config, speed: float) -> None:
    """Publish the daemon's messages at `speed` times real time."""
    mqtt = MqttPublisher(config.mqtt, config.vehicle, on_event=lambda code, text: None)
    run.listeners.append(partial(mqtt.publish, EVENT))
    sending = asyncio.create_task(mqtt.run())
    loop = asyncio.get_running_loop()
    publishing: Publishing | None = None
    try:
        for tick in run.replay.ticks():
            t_ns = tick.solution.t_ns
            if publishing is None:
                assert run.replay.chain is not None
                publishing = Publishing(config, run.replay.chain, run.scheduler, {"mqtt": mqtt})
                start_s, start_ns = loop.time(), t_ns
            run.add(tick)
            publishing.tick(t_ns, tick.solution)
            await asyncio.sleep(start_s + (t_ns - start_ns) * 1e-9 / speed - loop.time())
        await asyncio.sleep(FAREWELL_S)
    finally:
        sending.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await sending
