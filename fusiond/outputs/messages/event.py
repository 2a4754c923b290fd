"""`event`: what an operator should know."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from fusiond.outputs.messages.base import Message, stamp

Level = Literal["info", "warning", "error"]


class EventMessage(Message):
    """Something an operator should know."""

    level: Level
    code: str = Field(description="stable, for rules")
    source: str
    text: str


def event_message(
    utc_ns: int | None, *, source: str, code: str, text: str, level: Level = "info"
) -> EventMessage:
    t_utc, t_ms = stamp(utc_ns)
    return EventMessage(t_utc=t_utc, t_ms=t_ms, level=level, code=code, source=source, text=text)
