"""The daemon: drivers, clock, navigator, scheduler and outputs put together.

Everything runs in one event loop. Drivers hand measurements over as they come; the tick alone runs
the filter and reads the solution, and outputs take the latest of it.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fusiond.clock.clock import Clock
from fusiond.configuration.load import EXIT_CONFIG, ConfigError, config_digest
from fusiond.configuration.schema import Config
from fusiond.live.calibration_keeper import CalibrationKeeper
from fusiond.live.events import Events
from fusiond.live.operator import Operator
from fusiond.live.process_usage import release_compiler_pages
from fusiond.live.publishing import Publishing
from fusiond.live.scheduler import SECOND_NS, Every, Scheduler
from fusiond.live.service_manager import ServiceManager
from fusiond.live.sources import Sources
from fusiond.live.state_keeper import StateKeeper
from fusiond.live.supervision import supervise
from fusiond.live.warm_keeper import WarmKeeper
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.navigator import Navigator
from fusiond.outputs.catalogue import make_outputs
from fusiond.outputs.topics import EVENT

log = logging.getLogger("fusiond")

# Readiness is told when every device sends, or after this long with what there is: an absent
# receiver must not keep the vehicle's other services waiting.
READY_AFTER_S = 10.0


class Daemon:
    """One vehicle. `on_solution` hears every tick's solution (the demo, tests)."""

    def __init__(
        self,
        config: Config,
        clock: Clock | None = None,
        on_solution: Callable[[Solution], None] | None = None,
    ) -> None:
        self.config = config
        self.clock = clock or Clock(config.clock)
        self._events = Events(self.clock)
        navigator_event = partial(self._events.report, "navigator")
        self._state = StateKeeper(config, self.clock, navigator_event)
        self._warm = WarmKeeper(config, self.clock, navigator_event)
        self._calibration = CalibrationKeeper(config, navigator_event)
        saved = self._state.load()
        self.navigator = Navigator(config, saved, on_event=navigator_event)
        self._calibration.offer(self.navigator)
        if saved is None or "saved" not in config.alignment.heading:
            # A vehicle that stood knows more by what it kept then.
            self._warm.offer(self.navigator)
        self.sources = Sources(config, self.clock, self.navigator, self._events.report)
        self.service = ServiceManager()
        self.scheduler = Scheduler(
            config.scheduler.rate_hz,
            self._tick,
            now=self.clock.now_ns,
            on_time=self.service.feed_watchdog,
        )
        self.outputs = make_outputs(
            config,
            on_event=self._events.report,
            on_command=Operator(self.navigator, self.sources).carry_out,
            clock=self.clock,
        )
        for output in self.outputs.values():
            self._events.listen(partial(output.take, EVENT))
        self._publishing: Publishing | None = None
        if self.outputs:
            self._publishing = Publishing(
                config, self.clock, self.navigator, self.sources, self.scheduler, self.outputs
            )
        self.solution: Solution | None = None
        self._on_solution = on_solution
        self._started_ns = self.clock.now_ns()
        self._ready = False
        self._second = Every(SECOND_NS)

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until `stop` is set."""
        log.info(
            "fusiond %s, vehicle %s, config %s",
            version("fusiond"),
            self.config.vehicle,
            config_digest(self.config),
        )
        outputs = [
            asyncio.create_task(
                supervise(
                    f"output {name}",
                    output.run,
                    partial(self._events.report, name, "output_fault"),
                )
            )
            for name, output in self.outputs.items()
        ]
        work = [
            asyncio.create_task(self.sources.run(), name="sources"),
            asyncio.create_task(self.scheduler.run(), name="scheduler"),
        ]
        stopped = asyncio.create_task(stop.wait())
        try:
            done, _ = await asyncio.wait([*work, stopped], return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            self.service.stopping()
            await _cancel(*work, stopped)
            await self._state.close(self.solution)
            await self._warm.close(self.solution, self.navigator)
            await self._calibration.close(self.navigator)
            await _cancel(*outputs)
            self.service.close()
            log.info(
                "stopped after %d ticks, %d overruns", self.scheduler.ticks, self.scheduler.overruns
            )

    def _tick(self, t_ns: int) -> None:
        arrived = self.sources.take_imu()
        if arrived is not None:
            self.navigator.add_imu(*arrived)
        self.navigator.advance()
        solution = self.navigator.solution(t_ns)
        before, self.solution = self.solution, solution
        if self._on_solution is not None:
            self._on_solution(solution)
        changed = before is None or before.mode is not solution.mode
        if changed:
            self._events.report("navigator", f"mode_{solution.mode}", solution.reason)
        if self._publishing is not None:
            self._publishing.tick(t_ns, solution)
        if self._second.due(t_ns) or changed:
            self._each_second(t_ns, solution)
        self._state.keep(t_ns, solution)
        self._warm.keep(t_ns, solution, self.navigator)
        self._calibration.keep(t_ns, self.navigator)

    def _each_second(self, t_ns: int, solution: Solution) -> None:
        """Tell the service manager and the terminals how it stands."""
        text = f"{solution.mode}: {solution.reason}"
        if self._ready:
            self.service.status(text)
        elif self.sources.all_running or (t_ns - self._started_ns) * 1e-9 > READY_AFTER_S:
            self._ready = True
            self.service.ready(text)
        if solution.mode in (Mode.NAVIGATING, Mode.COASTING):
            self.sources.height_hint(solution.height_m, solution.sd_ned_m[2])


async def _cancel(*tasks: asyncio.Task[Any]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def run(config: Config, config_path: Path) -> None:
    """Run until SIGTERM or SIGINT. Exits 78 if the configuration leaves nothing to run."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(message)s")
    logging.getLogger("can").setLevel(logging.WARNING)  # a line for every attempt to open
    log.info("configuration %s", config_path)

    async def main() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, stop.set)
        if not config.sources:
            raise ConfigError("sources: there is none: add [sources.imu] with a driver")
        daemon = Daemon(config)
        release_compiler_pages()
        await daemon.run(stop)

    try:
        asyncio.run(main())
    except ConfigError as error:
        log.error("%s: %s", config_path, error)
        sys.exit(EXIT_CONFIG)
