"""Message `events`: recent events for a later subscriber."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.event import EventMessage

MOST_KEPT = 20
"""A screenful; 4 kB at the broker."""


class EventsMessage(Message):
    """The last events, the newest at the end; its time is that one's."""

    events: tuple[EventMessage, ...] = Field(max_length=MOST_KEPT)


def events_message(events: Sequence[EventMessage]) -> EventsMessage:
    """Build `events` of at least one event, in order of occurrence."""
    last = tuple(events[-MOST_KEPT:])
    return EventsMessage(t_utc=last[-1].t_utc, t_ms=last[-1].t_ms, events=last)
