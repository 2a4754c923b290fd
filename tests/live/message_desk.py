"""Messaging with real drivers whose lines nobody opens, for tests."""

from __future__ import annotations

import math
from typing import Any

from drivers.measurements import TimeReport
from drivers.rdss.driver import RdssDriver, RdssOptions
from drivers.rdss.mail import MessageReceived
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.rdss_messaging import Messaging
from fusiond.navigation.solution import Mode, Solution
from fusiond.outputs.commands import SendMessage

S = 1_000_000_000


OTHER = 242407


UTC_NS = 1_795_217_587 * S


SOLUTION = Solution(
    0,
    Mode.NAVIGATING,
    "aided by gnss",
    lat_rad=math.radians(30.0),
    lon_rad=math.radians(114.0),
    height_m=38.0,
    v_ned_m_s=(3.0, 4.0, 0.0),
    sd_ned_m=(3.0, 4.0, 2.0),
)


class Desk:
    """Messaging with real drivers whose lines nobody opens."""

    def __init__(self, names: tuple[str, ...] = ("rdss",), **reports: Any) -> None:
        sources = {name: {"driver": "rdss", "port": f"/dev/{name}"} for name in names}
        self.config = Config.model_validate({"sources": sources, "position_reports": reports})
        self.clock = Clock(self.config.clock)
        now_ns = self.clock.now_ns()
        self.clock.report(TimeReport("gnss", now_ns, UTC_NS, trusted=True))
        self.clock.report(TimeReport("gnss", now_ns, UTC_NS, trusted=True))
        self.events: list[tuple[str, str, str]] = []
        self.drivers = {
            name: RdssDriver(name, RdssOptions(port=f"/dev/{name}"), self._emit, self.clock.now_ns)
            for name in names
        }
        self.messaging = Messaging(
            self.config, self.clock, self.drivers, lambda *event: self.events.append(event)
        )

    def _emit(self, item: Any) -> None:
        self.messaging.receive(item)

    def send(self, text: str = "hello", **more: Any) -> str:
        command = {"id": "m1", "card": OTHER, "text": text, **more}
        return self.messaging.send(SendMessage.model_validate(command), self.clock.now_ns())

    def told(self) -> list[tuple[str, Any]]:
        return [(topic.path, message) for topic, message in self.messaging.take_waiting()]

    def received(self, **given: Any) -> None:
        mail = {
            "source": "rdss",
            "t_seen_ns": self.clock.now_ns(),
            "sender": OTHER,
            "receiver": 242286,
            "kind": "text",
            "payload": b"\xa4hi",
            "encoding": "mixed",
            "text": "hi",
            "minute_of_day": 615,
        }
        self.messaging.receive(MessageReceived(**{**mail, **given}))
