"""The daemon: drivers, clock, navigator, scheduler and outputs put together.

Everything runs in one event loop. Drivers hand measurements over as they come; the tick alone runs
the filter and reads the solution, and outputs take the latest of it.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import Backoff
from fusiond.clock.clock import Clock
from fusiond.configuration.load import EXIT_CONFIG, ConfigError, config_digest
from fusiond.configuration.schema import Config
from fusiond.configuration.settings import DEG
from fusiond.live.process_usage import ProcessUsage, release_compiler_pages
from fusiond.live.scheduler import Scheduler
from fusiond.live.service_manager import ServiceManager
from fusiond.live.sources import Sources
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_state import SavedState, load_state, save_state
from fusiond.outputs.commands import (
    Command,
    CommandRefusedError,
    RequestFix,
    ResetFilter,
    SetPosition,
)
from fusiond.outputs.messages.consistency import consistency_message
from fusiond.outputs.messages.event import Level, event_message
from fusiond.outputs.messages.health import health_message
from fusiond.outputs.messages.nav import nav_message
from fusiond.outputs.messages.status import status_message
from fusiond.outputs.mqtt import MqttPublisher

log = logging.getLogger("fusiond")

# Readiness is told when every device sends, or after this long with what there is: an absent
# receiver must not keep the vehicle's other services waiting.
READY_AFTER_S = 10.0
# The state on disk is renewed this often while the vehicle stands: a power cut loses a minute.
SAVE_EVERY_S = 60.0
STATUS_EVERY_S = 1.0
# Beyond this speed (m/s) the vehicle does not stand, and its heading is not worth keeping.
SAVE_MAX_SPEED_M_S = 0.2
# Beyond this one (m/s) it drives for certain, whatever the velocity's sigma (0.05 m/s aided): the
# heading on disk is no longer its own, and a power cut must not bring it back.
FORGET_SPEED_M_S = 1.0
# Words in an event's code that make it a warning or an error for whoever filters by level.
WARNINGS = (
    "absent",
    "isolated",
    "optimistic",
    "pessimistic",
    "coloured",
    "lost",
    "silent",
    "silence",
    "gap",
    "down",
    "passive",
    "suppressed",
    "refused",
)
ERRORS = ("fault", "failed", "bus_off", "no_card")


@dataclass(slots=True)
class _Every:
    """Due once a period, on the tick's own time."""

    period_ns: int
    next_ns: int = 0

    def due(self, t_ns: int) -> bool:
        if t_ns < self.next_ns:
            return False
        behind = t_ns - self.next_ns
        self.next_ns = (
            t_ns + self.period_ns if behind > self.period_ns else self.next_ns + self.period_ns
        )
        return True


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
        self._state_file = _state_file(config)
        saved = self._load_state()
        self.navigator = Navigator(
            config, saved, on_event=lambda code, text: self._event("navigator", code, text)
        )
        self.sources = Sources(config, self.clock, self.navigator, self._event)
        self.service = ServiceManager()
        self.mqtt = self._publisher() if config.mqtt.enabled else None
        self.scheduler = Scheduler(
            config.scheduler.rate_hz,
            self._tick,
            now=self.clock.now_ns,
            on_time=self.service.feed_watchdog,
        )
        self.solution: Solution | None = None
        self._on_solution = on_solution
        self._usage = ProcessUsage()
        self._digest = config_digest(config)
        self._version = version("fusiond")
        self._started_ns = self.clock.now_ns()
        self._since_ns = self._started_ns
        self._ready = False
        self._saving: asyncio.Task[None] | None = None
        self._kept = saved is not None
        self._nav = _Every(round(1e9 / config.mqtt.nav_rate_hz))
        self._health = _Every(round(1e9 / config.mqtt.health_rate_hz))
        self._status = _Every(round(STATUS_EVERY_S * 1e9))
        self._save = _Every(round(SAVE_EVERY_S * 1e9))

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until `stop` is set."""
        log.info(
            "fusiond %s, vehicle %s, config %s", self._version, self.config.vehicle, self._digest
        )
        outputs = asyncio.create_task(self._publish(self.mqtt)) if self.mqtt is not None else None
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
            if self._saving is not None:
                await asyncio.wait([self._saving])
            await asyncio.to_thread(self._write_state, self._state())
            if outputs is not None:
                await _cancel(outputs)
            self.service.close()
            log.info(
                "stopped after %d ticks, %d overruns", self.scheduler.ticks, self.scheduler.overruns
            )

    # ------------------------------------------------------------------ the tick

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
            self._since_ns = t_ns
            self._event("navigator", f"mode_{solution.mode}", solution.reason)
        if self.mqtt is not None and self._nav.due(t_ns):
            self.mqtt.publish_nav(nav_message(solution, self.clock.utc_ns(t_ns)))
        if self._status.due(t_ns) or changed:
            self._each_second(t_ns, solution)
        if self.mqtt is not None and self._health.due(t_ns):
            self._publish_health(t_ns)
        self._keep_state(t_ns)

    def _each_second(self, t_ns: int, solution: Solution) -> None:
        text = f"{solution.mode}: {solution.reason}"
        if not self._ready:
            waited = (t_ns - self._started_ns) * 1e-9
            if self.sources.all_running or waited > READY_AFTER_S:
                self._ready = True
                self.service.ready(text)
        else:
            self.service.status(text)
        if solution.mode in (Mode.NAVIGATING, Mode.COASTING):
            self.sources.height_hint(solution.height_m, solution.sd_ned_m[2])
        if self.mqtt is None:
            return
        fused = rejected = 0
        for outcomes in self.navigator.timeline.counters.outcomes.values():
            fused += outcomes["fused"]
            rejected += outcomes.total() - outcomes["fused"]
        for refused in self.navigator.refused.values():
            rejected += refused.total()
        self.mqtt.publish_status(
            status_message(
                solution,
                self.clock.utc_ns(t_ns),
                since_utc_ns=self.clock.utc_ns(self._since_ns),
                version=self._version,
                config_digest=self._digest,
                uptime_s=(t_ns - self._started_ns) * 1e-9,
                scheduler=self.scheduler.status(),
                fused=fused,
                rejected=rejected,
                mqtt=self.mqtt.counters,
            )
        )

    def _publish_health(self, t_ns: int) -> None:
        assert self.mqtt is not None
        cpu_percent, memory_mb = self._usage.sample()
        self.mqtt.publish_health(
            health_message(
                self.clock.utc_ns(t_ns),
                sources=self.sources.health(t_ns),
                scheduler=self.scheduler.status(),
                clock=self.clock.status(),
                cpu_percent=cpu_percent,
                memory_mb=memory_mb,
            )
        )
        reports = self.navigator.verdicts.reports()
        if reports:
            utc_ns = self.clock.utc_ns(t_ns)
            self.mqtt.publish_consistency(consistency_message(utc_ns, reports))

    # ------------------------------------------------------------------ events and commands

    async def _publish(self, mqtt: MqttPublisher) -> None:
        """Keep the output alive: a fault of it costs messages, never a tick."""
        backoff = Backoff()
        while True:
            try:
                await mqtt.run()
            except Exception as error:
                log.exception("output mqtt failed")
                self._event("mqtt", "output_fault", f"{error!r}: restarting it")
            await asyncio.sleep(backoff.next())

    def _event(self, source: str, code: str, text: str) -> None:
        level: Level = "info"
        if any(word in code for word in ERRORS):
            level = "error"
        elif any(word in code for word in WARNINGS):
            level = "warning"
        log.log(getattr(logging, level.upper()), "%s: %s: %s", source, code, text)
        mqtt = getattr(self, "mqtt", None)
        if mqtt is not None:
            utc_ns = self.clock.utc_ns(self.clock.now_ns())
            mqtt.publish_event(
                event_message(utc_ns, source=source, code=code, text=text, level=level)
            )

    def _publisher(self) -> MqttPublisher:
        return MqttPublisher(
            self.config.mqtt,
            self.config.vehicle,
            on_event=lambda code, text: self._event("mqtt", code, text),
            on_command=self._command,
            utc_now=lambda: self.clock.utc_ns(self.clock.now_ns()),
        )

    def _command(self, command: Command) -> str:
        match command:
            case SetPosition():
                if not self.navigator.imu.end:
                    raise CommandRefusedError("no IMU data yet")
                self.navigator.set_position(
                    command.lat_deg * DEG, command.lon_deg * DEG, command.height_m, command.sd_m
                )
                return "position taken"
            case RequestFix():
                said = self.sources.request_fix()
                if not said:
                    raise CommandRefusedError("there is no RDSS terminal")
                return "; ".join(said)
            case ResetFilter():
                self.navigator.reset("reset by an operator")
                return "aligning anew"
            case _:
                raise CommandRefusedError(f"unknown command {type(command).__name__}")

    # ------------------------------------------------------------------ the state on disk

    def _load_state(self) -> SavedState | None:
        if self._state_file is None:
            return None
        utc_ns = self.clock.utc_ns(self.clock.now_ns())
        state, why = load_state(
            self._state_file, (utc_ns or 0) * 1e-9, self.config.alignment.saved_max_age_s
        )
        log.info("%s: %s", self._state_file, why)
        return state

    def _keep_state(self, t_ns: int) -> None:
        """Renew the file while the vehicle stands; remove it once the vehicle drives."""
        if self._saving is not None and not self._saving.done():
            return
        if self._save.due(t_ns):
            state = self._state()
            if state is not None:
                self._kept = True
                self._saving = asyncio.create_task(asyncio.to_thread(self._write_state, state))
        elif self._kept and self._drives():
            self._kept = False
            self._saving = asyncio.create_task(asyncio.to_thread(self._remove_state))

    def _drives(self) -> bool:
        s = self.solution
        return (
            s is not None
            and s.mode in (Mode.NAVIGATING, Mode.COASTING)
            and math.hypot(*s.v_ned_m_s) > FORGET_SPEED_M_S
        )

    def _state(self) -> SavedState | None:
        """What to keep: only a solution at rest, for only then the heading lasts."""
        s = self.solution
        if s is None or s.mode not in (Mode.NAVIGATING, Mode.COASTING):
            return None
        utc_ns = self.clock.utc_ns(s.t_ns)
        if utc_ns is None or math.hypot(*s.v_ned_m_s) > SAVE_MAX_SPEED_M_S:
            return None
        return SavedState(
            utc_ns * 1e-9,
            (s.lat_rad, s.lon_rad, s.height_m),
            float(np.hypot(s.sd_ned_m[0], s.sd_ned_m[1])),
            s.rpy_rad[2],
            s.sd_rpy_rad[2],
        )

    def _write_state(self, state: SavedState | None) -> None:
        if state is None or self._state_file is None:
            return
        try:
            save_state(self._state_file, state)
        except OSError as error:
            log.warning("state not saved: %s", error)

    def _remove_state(self) -> None:
        if self._state_file is None:
            return
        try:
            self._state_file.unlink(missing_ok=True)
        except OSError as error:
            log.warning("state not removed: %s", error)


def _state_file(config: Config) -> Path | None:
    if config.state_file is not None:
        return config.state_file
    directory = os.environ.get("STATE_DIRECTORY")
    return Path(directory.split(":")[0]) / f"{config.vehicle}.json" if directory else None


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
