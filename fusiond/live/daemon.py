"""The daemon: drivers, clock, navigator, scheduler and outputs put together.

Everything runs in one event loop. Drivers hand measurements over as they come; the tick alone runs
the filter and reads the solution, and outputs take the latest of it.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Awaitable, Callable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import EXIT_CONFIG, ConfigError, config_digest
from fusiond.configuration.schema import Config
from fusiond.live.calibration_keeper import CalibrationKeeper
from fusiond.live.chain import Chain
from fusiond.live.early_services import Front
from fusiond.live.process_usage import (
    release_start_memory,
    share_one_heap,
    widen_descriptor_table,
)
from fusiond.live.publishing import Publishing
from fusiond.live.rdss_message_keeper import MessageKeeper
from fusiond.live.reload import difference
from fusiond.live.restored_state import RESTORED_STATE, RestoredState
from fusiond.live.state_in_memory import KEPT_STATE, WarmKeeper
from fusiond.live.state_keeper import StateKeeper
from fusiond.live.stderr_log_handler import StandardErrorHandler
from fusiond.live.supervision import supervise
from fusiond.live.systemd_journal import handler
from fusiond.live.tick_scheduler import SECOND_NS, Every, Scheduler
from fusiond.navigation.compiled import kernels_can_be_kept, load_compiler, load_kernels
from fusiond.navigation.solution import Solution
from fusiond.navigator.kernel_widths import kernel_widths
from fusiond.navigator.timeline import Entry
from fusiond.outputs.base import Output
from fusiond.outputs.commands import (
    NAMES,
    Command,
    CommandRefusedError,
    SendMessage,
    SetGates,
    StartRecording,
    StopRecording,
)
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import EVENT
from fusiond.recording.recorder import Recorder, RecordingRefusedError
from fusiond.recording.state_digest import state_digest
from fusiond.workers.forked import ForkedJobs

log = logging.getLogger("fusiond")

SWITCH_S = 0.0005
"""Longest wait (s) of a tick for a computing thread, such as the log's, ten times a second.
CPython's default of 5 ms delayed one tick in a hundred by 7 ms."""
_NOT_KEPT = "NUMBA_CACHE_DIR, or XDG_CACHE_HOME, is no folder that may be written"


class Daemon:
    """Daemon of one vehicle. `on_solution` receives every tick's solution (for demo and tests);
    `front` exists already if it had to wait for kernels."""

    def __init__(
        self,
        config: Config,
        clock: Clock | None = None,
        on_solution: Callable[[Solution], None] | None = None,
        front: Front | None = None,
    ) -> None:
        self.config = config
        self._front = front = front or Front(config, clock or Clock(config.clock))
        self.clock, self._events = front.clock, front.events
        navigator_event = partial(self._events.report, "navigator")
        self._state = StateKeeper(config, self.clock, navigator_event)
        self._warm = WarmKeeper(config, self.clock, navigator_event)
        self._calibration = CalibrationKeeper(config, self.clock, navigator_event)
        self._messages = MessageKeeper(config, self.clock, partial(self._events.report, "messages"))
        recording_event = partial(self._events.report, "recording")
        self.recorder = Recorder(config, self.clock, recording_event)
        saved = self._state.load()
        self._chain = Chain(config, self.clock, self._events, saved, self._on_outcome)
        self.navigator = navigator = self._chain.navigator
        # Load now, so that no tick links a kernel; only the covariance widths in use, which saves
        # 10 MB.
        load_kernels(kernel_widths(navigator))
        self.navigator.timeline.keeps_raw = config.recording.directory is not None
        self.sources = self._chain.sources
        self._calibration.restore_into(self.navigator)
        if saved is None or "saved" not in config.alignment.heading:
            # The state saved at rest, if there is one, holds a better heading than the one in
            # memory.
            self._warm.restore_into(self.navigator)
        messages = self._messages.load(self._chain.messaging)
        self._restored = RestoredState(
            saved, self._warm.restored, self.navigator.calibration, messages
        )
        self.service = front.service
        self.scheduler = Scheduler(
            config.scheduler.rate_hz,
            self._tick,
            now=self.clock.now_ns,
            on_time=None if self.service.watchdog_s is None else self.service.feed_watchdog,
        )
        self._output_tasks = front.output_tasks
        front.on_command = self._carry_out
        self.outputs = self._completed(front.outputs)
        self._publishing = Publishing(
            config,
            self._chain,
            self.scheduler.status,
            self.outputs,
            lambda: self.recorder.recording,
        )
        self._on_solution = on_solution
        keepers = self._state, self._warm, self._calibration
        self._saving = [k.schedule for k in keepers if k.schedule is not None]
        self._second = Every(SECOND_NS)

    @property
    def solution(self) -> Solution | None:
        """Solution of the last tick."""
        return self._chain.solution

    def _completed(self, outputs: dict[str, Output]) -> dict[str, Output]:
        """Outputs connected to the chain and the recorder."""
        mqtt = outputs.get("mqtt")
        if isinstance(mqtt, MqttPublisher):
            mqtt.on_confirmed = self._chain.messaging.confirm
        if self.config.recording.directory is not None:
            return {**outputs, "recording": self.recorder}
        return outputs

    def _send_event(self, message: EventMessage) -> None:
        for output in self.outputs.values():
            output.publish(EVENT, message)

    async def reload_when(self, again: asyncio.Event, read: Callable[[], Config]) -> None:
        """Call `reload` whenever `again` is set, until cancelled; requests during a reload cause
        one more."""

        async def wait() -> None:
            while True:
                await again.wait()
                again.clear()
                await self.reload(read)

        await supervise("reload", wait, partial(self._events.report, "daemon", "reload_fault"))

    async def reload(self, read: Callable[[], Config]) -> None:
        """Apply outputs, gates and log level of the configuration from `read`. A mistake changes
        nothing; events report the result."""
        self.service.reloading()
        try:
            await self._reload(await asyncio.to_thread(read))
        except ConfigError as error:
            text = "; ".join(str(error).splitlines())
            self._events.report("daemon", "reload_refused", text)
        finally:
            if self._front.ready:
                self.service.ready()

    async def _reload(self, read: Config) -> None:
        found = difference(self.config, read)
        kept = {n: o for n, o in self.outputs.items() if n not in found.outputs}
        made = self._front.make_outputs(found.config, kept)
        # From here on nothing can be refused.
        self.config = found.config
        made = self._completed(made)
        await self._output_tasks.stop(found.outputs)
        self.outputs = made
        self._publishing.serve(found.config, made)
        self._output_tasks.start(made)
        log.setLevel(found.config.log_level.upper())
        if found.gates:
            self._carry_out(SetGates(id="reload", gates=dict(found.gates)))
        report = partial(self._events.report, "daemon")
        report("reloaded", f"changed: {', '.join(found.taken) or 'nothing'}")
        if found.restart:
            report("restart_needed", f"by {', '.join(found.restart)}: they are as before")

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until `stop` is set."""
        log.info(
            "fusiond %s, vehicle %s, config %s",
            version("fusiond"),
            self.config.vehicle,
            config_digest(self.config),
        )
        self.recorder.listen(self.sources.inputs)
        self.recorder.arm(RESTORED_STATE.dump_python(self._restored, mode="json"))
        self._events.listen(self._send_event)
        self._output_tasks.start(self.outputs)
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
            await self._state.close(self.solution, confirmed=not self.navigator.trial.unconfirmed)
            await self._warm.close(self.solution, self.navigator)
            await self._calibration.close(self.navigator)
            await self._output_tasks.stop()
            await self._messages.close(self.clock.now_ns(), self._chain.messaging)
            self.service.close()
            log.info(
                "stopped after %d ticks, %d overruns", self.scheduler.ticks, self.scheduler.overruns
            )

    def _tick(self, t_ns: int) -> None:
        delay_ns = self.clock.now_ns() - t_ns
        self.sources.poll()
        if self.recorder.state != "off":
            self.recorder.tick_begins(t_ns)
        if self._nobody_reads(t_ns) and self._chain.may_wait(t_ns):
            self._chain.wait()
            return
        solution = self._chain.tick(t_ns)
        if self._records:
            digest = state_digest(self.navigator, solution)
            self.recorder.tick_ended(t_ns, delay_ns, self.scheduler.overruns, digest)
            self._keep_in_log(t_ns, solution)
        if self._on_solution is not None:
            self._on_solution(solution)
        if self.outputs:
            self._publishing.tick(t_ns, solution)
        if self._second.due(t_ns) or self._chain.changed:
            self._each_second(solution)
        changed = self._chain.messaging.revision != self._messages.written
        if changed or self._state.kept or not all(each.waits(t_ns) for each in self._saving):
            self._save(t_ns, solution)

    def _save(self, t_ns: int, solution: Solution) -> None:
        """Store what must outlive the process, each part when it is due."""
        self._state.keep(t_ns, solution, confirmed=not self.navigator.trial.unconfirmed)
        self._warm.keep(t_ns, solution, self.navigator)
        self._calibration.keep(t_ns, self.navigator)
        self._messages.keep(t_ns, self._chain.messaging)

    @property
    def _records(self) -> bool:
        """True if a log wants what happens."""
        return self.recorder.state != "off" and self.recorder.active

    def _nobody_reads(self, t_ns: int) -> bool:
        """True if nobody reads this tick's solution. A log holds every tick, so recording counts as
        a reader."""
        unread = self._on_solution is None and not self._records
        return unread and self._second.waits(t_ns) and self._publishing.waits(t_ns)

    def _keep_in_log(self, t_ns: int, solution: Solution) -> None:
        """Write the state into the log at intervals, so that a replay can start there."""
        if self.recorder.state_due(t_ns):
            state = self._warm.state(solution, self.navigator)
            if state is not None:
                self.recorder.keep_state(t_ns, KEPT_STATE.dump_json(state))

    def _on_outcome(self, entry: Entry) -> None:
        if self._records:
            self.recorder.innovation(entry)

    def _carry_out(self, command: Command) -> str | Awaitable[str]:
        """Execute an operator's command and return its result. Raises `CommandRefusedError`."""
        try:
            match command:
                case StartRecording():
                    return f"recording into {self.recorder.begin()}"
                case StopRecording():
                    return f"recorded {self.recorder.end('by a command')}"
        except RecordingRefusedError as error:
            raise CommandRefusedError(str(error)) from error
        t_ns = self.clock.now_ns()
        self.sources.catch_up()
        self.recorder.command(t_ns, NAMES[type(command)], command)
        text = self._chain.operator.carry_out(command, t_ns)
        return self._when_kept(text) if isinstance(command, SendMessage) else text

    async def _when_kept(self, text: str) -> str:
        """Reply for a queued message, once it is on disk."""
        messaging = self._chain.messaging
        missing = await self._messages.kept(messaging.revision, messaging)
        return f"{text}; {missing}" if missing else text

    def _each_second(self, solution: Solution) -> None:
        """Report status and watchdog to the service manager."""
        self._front.report_status(f"{solution.mode}: {solution.reason}", self.sources.all_running)


async def _cancel(*tasks: asyncio.Task[Any]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def run_daemon(
    config: Config,
    config_path: Path,
    read: Callable[[], Config],
    missing: Sequence[Callable[[], None]] = (),
) -> None:
    """Run until SIGTERM or SIGINT; SIGHUP applies the reloadable part of the configuration from
    `read`. The `missing` kernels are compiled first. Exits 78 if the configuration leaves nothing
    to run."""
    written = handler()
    logging.basicConfig(level=logging.INFO, handlers=[written])
    logging.getLogger("can").setLevel(logging.WARNING)  # it logs a line for every attempt to open
    log.setLevel(config.log_level.upper())
    log.info("configuration %s", config_path)
    sys.setswitchinterval(SWITCH_S)
    share_one_heap()
    widen_descriptor_table()

    async def main(compiling: ForkedJobs | None) -> None:
        if isinstance(written, StandardErrorHandler):
            written.begin_thread()
        stop, again = asyncio.Event(), asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, stop.set)
        loop.add_signal_handler(signal.SIGHUP, again.set)
        front = Front(config, Clock(config.clock))
        if compiling is not None:
            await front.wait_for(compiling, stop)
            if stop.is_set():
                await front.close()
                return
            for load in missing:  # links them, and compiles those that could not be stored
                load()
        daemon = Daemon(config, front=front)
        release_start_memory()
        reloading = asyncio.create_task(daemon.reload_when(again, read), name="reload")
        await daemon.run(stop)
        await _cancel(reloading)

    try:
        if not config.sources:
            raise ConfigError("No [sources]: add [sources.imu] with a driver")
        if missing and not kernels_can_be_kept():
            log.warning("compiling %d kernels, at each start: %s", len(missing), _NOT_KEPT)
            for load in missing:
                load()
            missing = ()
        # Fork the children before this process starts a thread or an event loop.
        with ForkedJobs(missing, load_compiler) if missing else nullcontext() as compiling:
            asyncio.run(main(compiling))
    except ConfigError as error:
        log.error("%s: %s", config_path, error)
        sys.exit(EXIT_CONFIG)
    finally:
        written.close()
