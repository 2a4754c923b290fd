"""What every message has: the instant that it speaks of, null while the daemon knows no UTC.

A quantity that is not known is `null` (NaN here).
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Number = float | None
Count = Annotated[int, Field(ge=0)]


class Message(BaseModel):
    """Base of every message."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    t_utc: str | None = Field(description="ISO 8601 with milliseconds, UTC")
    t_ms: int | None = Field(description="POSIX milliseconds, UTC")


def stamp(utc_ns: int | None) -> tuple[str | None, int | None]:
    """`t_utc` and `t_ms` of a UTC instant in ns; both null if it is not known."""
    if utc_ns is None:
        return None, None
    t_ms = utc_ns // 1_000_000
    second = datetime.fromtimestamp(t_ms // 1000, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{t_ms % 1000:03d}Z", t_ms
