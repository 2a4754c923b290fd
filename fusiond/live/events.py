"""Events: what an operator should know, logged and told to whoever listens."""

from __future__ import annotations

import logging
from collections.abc import Callable

from fusiond.clock.clock import Clock
from fusiond.outputs.messages.event import EventMessage, Level, event_message

log = logging.getLogger("fusiond")

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
    "jumped",
    "stepped",
    "resumed",
    "saturated",
    "repeated",
    "no_gravity",
    "spike",
    "stamp_ahead",
    "axis_dead",
    "not_finite",
    "out_of_range",
    "imu_time",
)
ERRORS = ("fault", "failed", "bus_off", "no_card")


def level_of(code: str) -> Level:
    """How much an event of that code matters."""
    if any(word in code for word in ERRORS):
        return "error"
    if any(word in code for word in WARNINGS):
        return "warning"
    return "info"


class Events:
    """Takes the events of all parts; `listeners` hear each as the message that goes out."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.listeners: list[Callable[[EventMessage], None]] = []

    def report(self, source: str, code: str, text: str) -> None:
        level = level_of(code)
        log.log(getattr(logging, level.upper()), "%s: %s: %s", source, code, text)
        if not self.listeners:
            return
        utc_ns = self._clock.utc_ns(self._clock.now_ns())
        message = event_message(utc_ns, source=source, code=code, text=text, level=level)
        for listener in self.listeners:
            listener(message)
