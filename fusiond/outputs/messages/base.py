"""Base of every message: its instant of validity, null while UTC is unknown.

An unknown quantity is `null` (NaN here). Bounds are in the published schemas only: the daemon
builds messages from its own values, and a check would refuse NaN.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

Number = float | None
LARGEST_INTEGER = 2**53 - 1
"""Largest integer that every JSON reader preserves (RFC 8259, section 6)."""
Count = Annotated[
    int,
    Field(ge=0),
    WithJsonSchema({"type": "integer", "minimum": 0, "maximum": LARGEST_INTEGER}),
]
Milliseconds = Annotated[
    int, WithJsonSchema({"type": "integer", "minimum": 0, "maximum": 253_402_300_799_999})
]
"""POSIX, from 1970 to the end of 9999: what `t_utc` can write with four digits of a year."""


def _within(low: float, high: float) -> WithJsonSchema:
    return WithJsonSchema({"type": "number", "minimum": low, "maximum": high})


QuarterTurn = Annotated[float, _within(-90.0, 90.0)] | None
"""Angle from -90 to 90 deg: a latitude, a pitch."""
HalfTurn = Annotated[float, _within(-180.0, 180.0)] | None
Turn = Annotated[float, _within(0.0, 360.0)] | None


class Message(BaseModel):
    """Base of every message."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    t_utc: str | None = Field(description="ISO 8601 with milliseconds, UTC")
    t_ms: Milliseconds | None = Field(description="POSIX milliseconds, UTC")


def stamp(utc_ns: int | None) -> tuple[str | None, int | None]:
    """`t_utc` and `t_ms` of a UTC instant in ns; both null if it is unknown."""
    if utc_ns is None:
        return None, None
    t_ms = utc_ns // 1_000_000
    second = datetime.fromtimestamp(t_ms // 1000, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{t_ms % 1000:03d}Z", t_ms
