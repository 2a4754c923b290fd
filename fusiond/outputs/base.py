"""Interface of an output: takes the vehicle's messages in the tick and sends them in its own
task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from drivers.base import DriverStatus
from fusiond.clock.stamp_mapping import Clock
from fusiond.outputs.client_sockets import Guests
from fusiond.outputs.messages.base import Message
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import Topic


class Output(Protocol):
    """Output of a vehicle's messages. `health` shows `counters` and `status` under `name`.

    `nav_rate_hz`: rate at which it takes `nav`. `sets_clocks`: True if clients may set clocks by
    its time of day; its `nav` then has no `t_utc` and `t_ms` before UTC is settled.
    """

    @property
    def name(self) -> str: ...
    @property
    def nav_rate_hz(self) -> float: ...
    @property
    def sets_clocks(self) -> bool: ...
    @property
    def counters(self) -> Counter[str]: ...
    @property
    def status(self) -> DriverStatus: ...

    def publish(self, topic: Topic, message: Message) -> None:
        """Store a message; the task may send only the latest. Never waits, never raises."""

    async def run(self) -> None:
        """Send until cancelled."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Context of an output: `on_event(code, text)` receives its events."""

    vehicle: str
    on_event: Callable[[str, str], None]
    geoid_separation_m: float | None = None
    sources: tuple[str, ...] = ()
    """Names of the devices."""
    mqtt: MqttPublisher | None = None
    clock: Clock | None = None
    guests: Guests = field(default_factory=Guests)
    """The door of all servers."""

    def broker(self) -> MqttPublisher:
        """Broker for an output that publishes through MQTT; such an output requires one in the
        configuration."""
        assert self.mqtt is not None
        return self.mqtt

    def time(self) -> Clock:
        """Clock for an output that publishes time."""
        assert self.clock is not None
        return self.clock
