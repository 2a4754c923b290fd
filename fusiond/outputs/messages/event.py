"""Message `event`: a notice for the operator."""

from __future__ import annotations

from pydantic import Field

from fusiond.outputs.messages.base import Message, stamp
from fusiond.outputs.messages.event_catalogue import Level, entry_of


class EventMessage(Message):
    """Event for the operator."""

    level: Level
    code: str = Field(description="stable, for rules")
    source: str
    text: str
    advice: str = Field(default="", description="next step; empty if none is needed")


def event_message(utc_ns: int | None, *, source: str, code: str, text: str) -> EventMessage:
    """Build an event with level and advice of its code."""
    t_utc, t_ms = stamp(utc_ns)
    level, _, advice = entry_of(code)
    return EventMessage(
        t_utc=t_utc, t_ms=t_ms, level=level, code=code, source=source, text=text, advice=advice
    )
