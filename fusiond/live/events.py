"""Events: what an operator should know, logged and told to whoever listens."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable

from fusiond.clock.clock import Clock
from fusiond.live.journal import fields
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
    "implausible",
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
    "imu_units",
    "damaged",
    "taken",
    "flooded",
    "protection_level",
    "injected",
    "restart_needed",
    "message_",
    "messages_not_kept",
)
ERRORS = ("fault", "failed", "bus_off", "no_card")

# What the parts of a start say before the outputs are there: each of them says little.
MOST_UNHEARD = 32


def level_of(code: str) -> Level:
    """How much an event of that code matters."""
    if any(word in code for word in ERRORS):
        return "error"
    if any(word in code for word in WARNINGS):
        return "warning"
    return "info"


class Events:
    """Takes the events of all parts; each who listens hears them as the messages that go out, and
    first those of the time before anybody listened."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._listeners: list[Callable[[EventMessage], None]] = []
        self._unheard: deque[EventMessage] = deque(maxlen=MOST_UNHEARD)

    def listen(self, *listeners: Callable[[EventMessage], None]) -> None:
        """Tell `listeners` every event from now on, and what nobody has heard yet."""
        self._listeners.extend(listeners)
        while self._unheard:
            message = self._unheard.popleft()
            for listener in listeners:
                listener(message)

    def report(self, source: str, code: str, text: str) -> None:
        level = level_of(code)
        said = source, code, text
        log.log(getattr(logging, level.upper()), "%s: %s: %s", *said, extra=fields(source, code))
        utc_ns = self._clock.utc_ns(self._clock.now_ns())
        message = event_message(utc_ns, source=source, code=code, text=text, level=level)
        if not self._listeners:
            self._unheard.append(message)
        for listener in self._listeners:
            listener(message)
