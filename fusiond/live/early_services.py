"""Services that start before the navigator: events, service manager, outputs. They answer while
kernels compile."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from importlib.metadata import version

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import config_digest
from fusiond.configuration.schema import Config
from fusiond.live.events import Events
from fusiond.live.output_tasks import OutputTasks
from fusiond.live.service_manager import ServiceManager
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.mode_reasons import reason
from fusiond.outputs.base import Output
from fusiond.outputs.catalogue import make_outputs
from fusiond.outputs.client_sockets import Guests
from fusiond.outputs.commands import Command, CommandRefusedError
from fusiond.outputs.messages.health import SchedulerStatus
from fusiond.outputs.messages.status import DaemonState, status_message
from fusiond.outputs.topics import STATUS
from fusiond.workers.forked import ForkedJobs

log = logging.getLogger("fusiond")

# READY is sent when every device sends, or after this time at the latest: an absent receiver or a
# long compilation must not hold up the vehicle's other services.
READY_AFTER_S = 10.0
# Period of `status`, as later from the navigator, and of the journal's line while kernels compile.
STATUS_EVERY_S, LINE_EVERY_NS = 1.0, 5 * SECOND_NS
_NO_TICK = SchedulerStatus(0, 0, 0.0, 0.0, 0.0, 0.0, (), 0, 0, 0.0)


class Front:
    """Services of one vehicle from its start on. `on_command` executes an operator's command; until
    the daemon sets it, commands are refused."""

    def __init__(self, config: Config, clock: Clock) -> None:
        self.config = config
        self.clock = clock
        self.events = Events(clock)
        self.service = ServiceManager()
        self.output_tasks = OutputTasks(self.events.report)
        self.guests = Guests()
        self.on_command: Callable[[Command], str | Awaitable[str]] = _refuse
        self.outputs = self.make_outputs(config, {})
        self.started_ns = clock.now_ns()
        self.ready = False

    def make_outputs(self, config: Config, kept: Mapping[str, Output]) -> dict[str, Output]:
        """Make the outputs of `config`, except `kept`, which exist."""
        return make_outputs(
            config,
            on_event=self.events.report,
            on_command=self._carry_out,
            clock=self.clock,
            guests=self.guests,
            kept=kept,
        )

    def _carry_out(self, command: Command) -> str | Awaitable[str]:
        return self.on_command(command)

    def report_status(self, text: str, all_running: bool) -> None:
        """Send a status sentence to the service manager, and readiness when due."""
        if self.ready:
            self.service.status(text)
        elif all_running or (self.clock.now_ns() - self.started_ns) * 1e-9 > READY_AFTER_S:
            self.ready = True
            self.service.ready(text)
        else:
            self.service.status(text)

    async def wait_for(self, compiling: ForkedJobs, stop: asyncio.Event) -> None:
        """Report the progress of compilation over MQTT, journal and service manager, until it is
        complete or `stop` is set."""
        self.output_tasks.start({n: o for n, o in self.outputs.items() if n == "mqtt"})
        loop = asyncio.get_running_loop()
        over = loop.create_future()

        def news() -> None:
            if not compiling.read():
                loop.remove_reader(compiling.fileno())
                over.set_result(None)

        loop.add_reader(compiling.fileno(), news)
        stopped = asyncio.create_task(stop.wait())
        line = Every(LINE_EVERY_NS)
        while not (over.done() or stop.is_set()):
            text = reason("compiling", done=compiling.done, total=compiling.total)
            t_ns = self.clock.now_ns()
            if line.due(t_ns):
                log.info(text)
            self._publish(t_ns, text)
            self.report_status(text, all_running=False)
            self.service.feed_watchdog(t_ns)
            waiting = {over, stopped}
            await asyncio.wait(waiting, timeout=STATUS_EVERY_S, return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        loop.remove_reader(compiling.fileno())
        spent_s = (self.clock.now_ns() - self.started_ns) * 1e-9
        log.info("compiled %d of %d kernels in %.0f s", compiling.done, compiling.total, spent_s)

    async def close(self) -> None:
        """Stop the outputs before the daemon exits."""
        self.service.stopping()
        await self.output_tasks.stop()
        self.service.close()

    def _publish(self, t_ns: int, text: str) -> None:
        mqtt = self.outputs.get("mqtt")
        if mqtt is None:
            return
        mqtt.publish(
            STATUS,
            status_message(
                Solution(t_ns, Mode.WAITING, text),
                self.clock.utc_ns(t_ns),
                DaemonState(
                    since_utc_ns=self.clock.utc_ns(self.started_ns),
                    version=version("fusiond"),
                    config_digest=config_digest(self.config),
                    uptime_s=(t_ns - self.started_ns) * 1e-9,
                    scheduler=_NO_TICK,
                    mqtt=mqtt.counters,
                ),
            ),
        )


def _refuse(_: Command) -> str:
    raise CommandRefusedError("kernels are being compiled: once they are, it can be done")
