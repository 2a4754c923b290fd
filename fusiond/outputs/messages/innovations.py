"""Message `innovations`: outcomes of the latest measurements in the filter."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, Field

from fusiond.outputs.messages.base import Count, Message, Milliseconds, Number, stamp


class Innovation(BaseModel):
    """Innovation of one measurement. After a rewind by a delayed measurement, later measurements
    come again with the same source and `t_ms`; the last one counts."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str
    t_ms: Milliseconds | None = Field(description="instant of validity, POSIX milliseconds, UTC")
    outcome: str = Field(description="`fused`, `gated`, ... as `health` counts them")
    nis: Number = Field(description="nu^T S^-1 nu; null without an innovation")
    degrees: Count = Field(description="degrees of freedom: the expected `nis`")


class InnovationsMessage(Message):
    """Innovations since the last message, in order of validity."""

    innovations: tuple[Innovation, ...]


def innovations_message(
    utc_ns: int | None, innovations: Iterable[Innovation]
) -> InnovationsMessage:
    """Build `innovations` of the measurements since the last message."""
    t_utc, t_ms = stamp(utc_ns)
    return InnovationsMessage(t_utc=t_utc, t_ms=t_ms, innovations=tuple(innovations))
