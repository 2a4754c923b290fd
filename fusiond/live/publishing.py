"""Schedule of publishing: the solution, the status, health and the verdicts, each at its rate."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version

from fusiond.configuration.load import config_digest
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.process_usage import ProcessUsage
from fusiond.live.scheduler import SECOND_NS, Every
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
from fusiond.outputs.tracking import Tracking

STATUS_EVERY_S = 1
# A calibration moves over minutes; a state that changes goes out at once.
CALIBRATION_EVERY_S = 30


class Publishing:
    """Makes a vehicle's messages in the tick and hands them to every output, which keeps them."""

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
        self._waiting: deque[tuple[Topic, Message]] = deque()
        self.serve(config, outputs)

    def serve(self, config: Config, outputs: Mapping[str, Output]) -> None:
        """From now on by this configuration, to these outputs."""
        self._outputs = outputs
        self._digest = config_digest(config)
        self._nav = [(o, Every(round(SECOND_NS / o.nav_rate_hz))) for o in outputs.values()]
        self._health = Every(round(SECOND_NS / config.mqtt.health_rate_hz))
        self._calibrated: tuple[CalibrationState, ...] = ()

    def tick(self, t_ns: int, solution: Solution) -> None:
        """Publish what is due at the tick of `t_ns`, the status at every change of mode too.

        The large messages of a second are of one instant and go out a tick each: a broker hands one
        to all its clients before the next, and the next solution would wait for all of them."""
        changed = solution.mode is not self._mode
        if changed:
            self._mode, self._since_ns = solution.mode, t_ns
        utc_ns = self._clock.utc_ns(t_ns)
        self._publish_nav(t_ns, utc_ns, solution)
        self._publish_messages()
        if self._health.due(t_ns):
            self._publish_waiting(most=len(self._waiting))
            self._waiting.extend(self._of_health(t_ns, utc_ns))
        if self._status.due(t_ns) or changed:
            self._publish_status(t_ns, utc_ns, solution)
        self._publish_waiting(most=1)
        self._publish_calibration(t_ns, utc_ns)

    def _publish(self, topic: Topic, message: Message) -> None:
        for output in self._outputs.values():
            output.publish(topic, message)

    def _publish_nav(self, t_ns: int, utc_ns: int | None, solution: Solution) -> None:
        due = [output for output, every in self._nav if every.due(t_ns)]
        if not due:
            return
        message = settled = nav_message(solution, utc_ns)
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

    def _publish_waiting(self, most: int) -> None:
        for _ in range(min(most, len(self._waiting))):
            self._publish(*self._waiting.popleft())

    def _of_health(self, t_ns: int, utc_ns: int | None) -> Iterator[tuple[Topic, Message]]:
        cpu_percent, memory_mb = self._usage.sample()
        yield (
            HEALTH,
            health_message(
                utc_ns,
                sources=self._sources.health(t_ns),
                outputs={name: _health(output) for name, output in self._outputs.items()},
                scheduler=self._scheduler(),
                clock=self._clock.status(),
                cpu_percent=cpu_percent,
                memory_mb=memory_mb,
            ),
        )
        reports = self._navigator.verdicts.reports()
        if reports:
            yield CONSISTENCY, consistency_message(utc_ns, reports)
        innovations = self._innovations.since()
        if innovations:
            yield INNOVATIONS, innovations_message(utc_ns, innovations)


def _health(output: Output) -> OutputHealth:
    counters = {name: int(count) for name, count in output.counters.items() if count}
    status = output.status
    return OutputHealth(state=status.state, detail=status.detail, counters=counters)


def _totals(navigator: Navigator) -> tuple[int, int]:
    """Measurements fused and rejected, of all sources since the start."""
    fused = rejected = 0
    for outcomes in navigator.outcomes().values():
        fused += outcomes["fused"]
        rejected += outcomes.total() - outcomes["fused"]
    for refused in navigator.outcome_watch.refused.values():
        rejected += refused.total()
    return fused, rejected
