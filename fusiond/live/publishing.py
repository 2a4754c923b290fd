"""Schedule of publishing: the solution, the status, health and the verdicts, each at its rate."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from importlib.metadata import version

from fusiond.configuration.load import config_digest
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.process_usage import ProcessUsage
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.calibration import CalibrationState
from fusiond.navigator.navigator import Navigator
from fusiond.outputs.base import Output
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.calibration import calibration_message
from fusiond.outputs.messages.consistency import consistency_message
from fusiond.outputs.messages.health import OutputHealth, SchedulerStatus, health_message
from fusiond.outputs.messages.innovations import innovations_message
from fusiond.outputs.messages.nav import nav_message
from fusiond.outputs.messages.status import DaemonState, RecordingStatus, status_message
from fusiond.outputs.messages.tracker import Tracking
from fusiond.outputs.topics import (
    CALIBRATION,
    CONSISTENCY,
    HEALTH,
    INNOVATIONS,
    NAV,
    STATUS,
    TRACKER,
    Topic,
)

STATUS_EVERY_S = 1
# A calibration changes over minutes. A change of a parameter's state is published at once.
CALIBRATION_EVERY_S = 30


Make = Callable[[int, int | None], tuple[Topic, Message] | None]
"""Factory of a message for an instant (monotonic ns, UTC ns); None without contents."""


class Publishing:
    """Publisher of a vehicle's messages: builds them in the tick and hands them to every output."""

    def __init__(
        self,
        config: Config,
        chain: Chain,
        scheduler: Callable[[], SchedulerStatus],
        outputs: Mapping[str, Output],
        recording: Callable[[], RecordingStatus] = RecordingStatus,
    ) -> None:
        self._clock = chain.clock
        self._navigator = chain.navigator
        self._sources = chain.sources
        self._injection = chain.injection
        self._messaging = chain.messaging
        self._scheduler = scheduler
        self._recording = recording
        self._innovations = chain.innovations
        self._usage = ProcessUsage()
        self._version = version("fusiond")
        self._started_ns = self._since_ns = chain.clock.now_ns()
        self._mode: Mode | None = None
        self._tracking = Tracking()
        self._status = Every(STATUS_EVERY_S * SECOND_NS)
        self._calibration = Every(CALIBRATION_EVERY_S * SECOND_NS)
        self._waiting: deque[Make] = deque()
        self._spare_ns = round(0.5 * SECOND_NS / config.scheduler.rate_hz)
        self.serve(config, outputs)

    def serve(self, config: Config, outputs: Mapping[str, Output]) -> None:
        """Switch to this configuration and these outputs."""
        self._outputs = outputs
        self._digest = config_digest(config)
        self._nav = [(o, Every(round(SECOND_NS / o.nav_rate_hz))) for o in outputs.values()]
        self._health = Every(round(SECOND_NS / config.mqtt.health_rate_hz))
        self._calibrated: tuple[CalibrationState, ...] = ()

    def tick(self, t_ns: int, solution: Solution) -> None:
        """Publish the messages due at the tick of `t_ns`, and the status at every change of mode.

        The large messages that are due once a second are made one a tick, in ticks with half of
        their period left: a rewind for a delayed fix may have used the rest. One at a time, because
        a broker passes each message to all clients before the next one, and the next `nav` would
        wait."""
        changed = solution.mode is not self._mode
        if changed:
            self._mode, self._since_ns = solution.mode, t_ns
        utc_ns = self._clock.utc_ns(t_ns)
        self._publish_nav(t_ns, utc_ns, solution)
        if self._messaging.waiting:
            self._publish_messages()
        if self._status.due(t_ns) or changed:
            self._publish_status(t_ns, utc_ns, solution)
        due = self._health.due(t_ns)
        while self._waiting and (due or self._clock.now_ns() - t_ns < self._spare_ns):
            message = self._waiting.popleft()(t_ns, utc_ns)
            if message is not None:
                self._publish(*message)
                if not due:
                    break
        if due:
            self._waiting.extend((self._health_of, self._consistency_of, self._innovations_of))
        self._publish_calibration(t_ns, utc_ns)

    def waits(self, t_ns: int) -> bool:
        """True if nothing is due at `t_ns`."""
        if self._waiting or self._messaging.waiting:
            return False
        if not self._calibration.waits(t_ns) and self._navigator.calibrating.parameters:
            return False
        every = self._status, self._health, *(each for _, each in self._nav)
        return all(each.waits(t_ns) for each in every)

    def _publish(self, topic: Topic, message: Message) -> None:
        for output in self._outputs.values():
            output.publish(topic, message)

    def _publish_nav(self, t_ns: int, utc_ns: int | None, solution: Solution) -> None:
        due = [output for output, every in self._nav if every.due(t_ns)]
        if not due:
            return
        message = settled = nav_message(solution, utc_ns)
        if t_ns >= self._tracking.earliest_ns:
            tracker = self._tracking.due(t_ns, message)
            if tracker is not None:
                self._publish(TRACKER, tracker)
        if utc_ns is not None and not self._clock.sets_others:
            settled = message.model_copy(update={"t_utc": None, "t_ms": None})
        for output in due:
            output.publish(NAV, settled if output.sets_clocks else message)

    def _publish_messages(self) -> None:
        for topic, message in self._messaging.take_waiting():
            self._publish(topic, message)
            if "mqtt" not in self._outputs:
                self._messaging.confirm(message)

    def _publish_calibration(self, t_ns: int, utc_ns: int | None) -> None:
        watch = self._navigator.calibrating
        states = tuple(p.state for p in watch.parameters)
        if not states or not (self._calibration.due(t_ns) or states != self._calibrated):
            return
        self._calibrated = states
        message = calibration_message(utc_ns, watch.parameters, watch.settled)
        self._publish(CALIBRATION, message)

    def _publish_status(self, t_ns: int, utc_ns: int | None, solution: Solution) -> None:
        fused, rejected = _totals(self._navigator)
        mqtt = self._outputs.get("mqtt")
        self._publish(
            STATUS,
            status_message(
                solution,
                utc_ns,
                DaemonState(
                    since_utc_ns=self._clock.utc_ns(self._since_ns),
                    version=self._version,
                    config_digest=self._digest,
                    uptime_s=(t_ns - self._started_ns) * 1e-9,
                    scheduler=self._scheduler(),
                    fused=fused,
                    rejected=rejected,
                    imu=self._sources.imu.used,
                    faults=self._sources.faults(t_ns),
                    calibrated=self._navigator.calibrating.settled,
                    recording=self._recording(),
                    injected=self._injection.active,
                    mqtt={} if mqtt is None else mqtt.counters,
                ),
            ),
        )

    def _health_of(self, t_ns: int, utc_ns: int | None) -> tuple[Topic, Message]:
        cpu_percent, memory_mb = self._usage.sample()
        message = health_message(
            utc_ns,
            sources=self._sources.health(t_ns),
            outputs={name: _health(output) for name, output in self._outputs.items()},
            scheduler=self._scheduler(),
            clock=self._clock.status(),
            cpu_percent=cpu_percent,
            memory_mb=memory_mb,
        )
        return HEALTH, message

    def _consistency_of(self, _: int, utc_ns: int | None) -> tuple[Topic, Message] | None:
        reports = self._navigator.verdicts.reports()
        return (CONSISTENCY, consistency_message(utc_ns, reports)) if reports else None

    def _innovations_of(self, _: int, utc_ns: int | None) -> tuple[Topic, Message] | None:
        innovations = self._innovations.since()
        return (INNOVATIONS, innovations_message(utc_ns, innovations)) if innovations else None


def _health(output: Output) -> OutputHealth:
    counters = {name: int(count) for name, count in output.counters.items() if count}
    status = output.status
    return OutputHealth(state=status.state, detail=status.detail, counters=counters)


def _totals(navigator: Navigator) -> tuple[int, int]:
    """Numbers of measurements of all sources, fused and rejected, since the start."""
    fused = rejected = 0
    for outcomes in navigator.outcomes().values():
        fused += outcomes["fused"]
        rejected += outcomes.total() - outcomes["fused"]
    for refused in navigator.outcome_watch.refused.values():
        rejected += refused.total()
    return fused, rejected
