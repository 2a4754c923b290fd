"""What is published when: the solution, the status, health and the verdicts, each at its rate."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version

from fusiond.configuration.load import config_digest
from fusiond.configuration.schema import Config
from fusiond.live.chain import Chain
from fusiond.live.process_usage import ProcessUsage
from fusiond.live.scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.calibration import CalibrationState
from fusiond.navigator.navigator import Navigator
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.calibration import calibration_message
from fusiond.outputs.messages.consistency import consistency_message
from fusiond.outputs.messages.health import SchedulerStatus, health_message
from fusiond.outputs.messages.nav import nav_message
from fusiond.outputs.messages.status import RecordingStatus, status_message
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import CALIBRATION, CONSISTENCY, HEALTH, NAV, STATUS, Topic
from fusiond.recording.recorder import Recorder

STATUS_EVERY_S = 1
# A calibration moves over minutes; a state that changes goes out at once.
CALIBRATION_EVERY_S = 30


class Publishing:
    """Makes a vehicle's messages in the tick and puts them into their places at the publisher."""

    def __init__(
        self,
        config: Config,
        chain: Chain,
        scheduler: Callable[[], SchedulerStatus],
        mqtt: MqttPublisher | None,
        recorder: Recorder | None = None,
    ) -> None:
        self._clock = chain.clock
        self._navigator = chain.navigator
        self._sources = chain.sources
        self._injection = chain.injection
        self._scheduler = scheduler
        self._mqtt = mqtt
        self._recorder = recorder
        self._usage = ProcessUsage()
        self._version = version("fusiond")
        self._digest = config_digest(config)
        self._started_ns = self._since_ns = chain.clock.now_ns()
        self._mode: Mode | None = None
        self._nav = Every(round(SECOND_NS / config.mqtt.nav_rate_hz))
        self._health = Every(round(SECOND_NS / config.mqtt.health_rate_hz))
        self._status = Every(STATUS_EVERY_S * SECOND_NS)
        self._calibration = Every(CALIBRATION_EVERY_S * SECOND_NS)
        self._calibrated: tuple[CalibrationState, ...] = ()

    def tick(self, t_ns: int, solution: Solution) -> None:
        """Publish what is due at the tick of `t_ns`, the status at every change of mode too."""
        changed = solution.mode is not self._mode
        if changed:
            self._mode, self._since_ns = solution.mode, t_ns
        if self._mqtt is None and (self._recorder is None or not self._recorder.active):
            return
        utc_ns = self._clock.utc_ns(t_ns)
        if self._nav.due(t_ns):
            self._publish(NAV, nav_message(solution, utc_ns))
        if self._status.due(t_ns) or changed:
            self._publish_status(t_ns, utc_ns, solution)
        if self._health.due(t_ns):
            self._publish_health(t_ns, utc_ns)
        self._publish_calibration(t_ns, utc_ns)

    def _publish(self, topic: Topic, message: Message) -> None:
        if self._mqtt is not None:
            self._mqtt.publish(topic, message)
        if self._recorder is not None:
            self._recorder.publish(topic, message)

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
        recorder = self._recorder
        self._publish(
            STATUS,
            status_message(
                solution,
                utc_ns,
                since_utc_ns=self._clock.utc_ns(self._since_ns),
                version=self._version,
                config_digest=self._digest,
                uptime_s=(t_ns - self._started_ns) * 1e-9,
                scheduler=self._scheduler(),
                fused=fused,
                rejected=rejected,
                calibrated=self._navigator.calibrating.settled,
                recording=recorder.status if recorder is not None else RecordingStatus(),
                injected=self._injection.active,
                mqtt=self._mqtt.counters if self._mqtt is not None else {},
            ),
        )

    def _publish_health(self, t_ns: int, utc_ns: int | None) -> None:
        cpu_percent, memory_mb = self._usage.sample()
        self._publish(
            HEALTH,
            health_message(
                utc_ns,
                sources=self._sources.health(t_ns),
                scheduler=self._scheduler(),
                clock=self._clock.status(),
                cpu_percent=cpu_percent,
                memory_mb=memory_mb,
            ),
        )
        reports = self._navigator.verdicts.reports()
        if reports:
            self._publish(CONSISTENCY, consistency_message(utc_ns, reports))


def _totals(navigator: Navigator) -> tuple[int, int]:
    """Measurements fused and rejected, of all sources since the start."""
    fused = rejected = 0
    for outcomes in navigator.timeline.counters.outcomes.values():
        fused += outcomes["fused"]
        rejected += outcomes.total() - outcomes["fused"]
    for refused in navigator.refused.values():
        rejected += refused.total()
    return fused, rejected
