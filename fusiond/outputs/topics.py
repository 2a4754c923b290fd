"""MQTT topics of a vehicle: contents and delivery."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from pydantic import BaseModel

from fusiond.outputs.messages.calibration import CalibrationMessage
from fusiond.outputs.messages.consistency import ConsistencyMessage
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.fleet import FleetMessage
from fusiond.outputs.messages.health import HealthMessage
from fusiond.outputs.messages.innovations import InnovationsMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.messages.recent_events import EventsMessage
from fusiond.outputs.messages.reply import ReplyMessage
from fusiond.outputs.messages.short_message import ShortMessage
from fusiond.outputs.messages.status import StatusMessage
from fusiond.outputs.messages.tracker import TrackerMessage


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Topic below `fusiond/<vehicle>`: contents and delivery. There is one object of each.

    `below` is the last part of the address of a topic that exists several times.
    """

    name: str
    message: type[BaseModel]
    qos: Literal[0, 1]
    retained: bool
    absolute: bool = False
    below: str = ""

    @property
    def path(self) -> str:
        """Name of the topic with `below`."""
        return f"{self.name}/{self.below}" if self.below else self.name

    def address(self, base: str) -> str:
        """Address at the broker; an `absolute` one is outside `base`."""
        return self.path if self.absolute else f"{base}/{self.path}"


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
MESSAGE = Topic("message", ShortMessage, 1, False)
FLEET = Topic("fleet", FleetMessage, 1, True, below="{card}")
"""Pattern of all cards' topics; `fleet(card)` is the topic of one."""
TOPICS = (
    *(NAV, STATUS, HEALTH, CONSISTENCY, INNOVATIONS, CALIBRATION, TRACKER),
    *(EVENT, EVENTS, REPLY, MESSAGE, FLEET),
)


@cache
def fleet(card: int) -> Topic:
    """Topic of the vehicle with a card's number."""
    return replace(FLEET, below=str(card))


def base_topic(vehicle: str) -> str:
    return f"fusiond/{vehicle}"
