"""The MQTT topics of a vehicle: what each carries and how it is delivered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel

from fusiond.outputs.messages.calibration import CalibrationMessage
from fusiond.outputs.messages.consistency import ConsistencyMessage
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.events import EventsMessage
from fusiond.outputs.messages.health import HealthMessage
from fusiond.outputs.messages.innovations import InnovationsMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.messages.reply import ReplyMessage
from fusiond.outputs.messages.status import StatusMessage
from fusiond.outputs.messages.tracker import TrackerMessage


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic below `fusiond/<vehicle>`: what it carries and how it is delivered."""

    name: str
    message: type[BaseModel]
    qos: Literal[0, 1]
    retained: bool
    absolute: bool = False

    def address(self, base: str) -> str:
        """Where it stands at the broker; an `absolute` one stands outside `base`."""
        return self.name if self.absolute else f"{base}/{self.name}"


NAV = Topic("nav", NavMessage, 0, False)
STATUS = Topic("status", StatusMessage, 1, True)
HEALTH = Topic("health", HealthMessage, 0, True)
CONSISTENCY = Topic("consistency", ConsistencyMessage, 0, True)
INNOVATIONS = Topic("innovations", InnovationsMessage, 0, False)
CALIBRATION = Topic("calibration", CalibrationMessage, 1, True)
TRACKER = Topic("tracker", TrackerMessage, 1, True)
EVENT = Topic("event", EventMessage, 1, False)
EVENTS = Topic("events", EventsMessage, 1, True)
REPLY = Topic("reply", ReplyMessage, 1, False)
TOPICS = (
    *(NAV, STATUS, HEALTH, CONSISTENCY, INNOVATIONS, CALIBRATION, TRACKER),
    *(EVENT, EVENTS, REPLY),
)


def base_topic(vehicle: str) -> str:
    return f"fusiond/{vehicle}"
