"""Events for the operator: logged, and passed to listeners."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable

from fusiond.clock.stamp_mapping import Clock
from fusiond.live.systemd_journal import fields
from fusiond.outputs.messages.event import EventMessage, event_message
from fusiond.outputs.messages.event_catalogue import entry_of

log = logging.getLogger("fusiond")

# Most events stored before the outputs listen; each part reports only a few at the start.
MOST_UNHEARD = 32


class Events:
    """Distributor of all events as messages; a new listener first gets the earlier ones."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._listeners: list[Callable[[EventMessage], None]] = []
        self._unheard: deque[EventMessage] = deque(maxlen=MOST_UNHEARD)

    def listen(self, *listeners: Callable[[EventMessage], None]) -> None:
        """Pass every event to `listeners` from now on, and earlier events without a listener."""
        self._listeners.extend(listeners)
        while self._unheard:
            message = self._unheard.popleft()
            for listener in listeners:
                listener(message)

    def report(self, source: str, code: str, text: str) -> None:
        """Log an event and pass it to every listener."""
        level = getattr(logging, entry_of(code).level.upper())
        log.log(level, "%s: %s: %s", source, code, text, extra=fields(source, code))
        utc_ns = self._clock.utc_ns(self._clock.now_ns())
        message = event_message(utc_ns, source=source, code=code, text=text)
        if not self._listeners:
            self._unheard.append(message)
        for listener in self._listeners:
            listener(message)
