"""Message `message`: a sent or received short message of an RDSS terminal."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, WithJsonSchema

from drivers.rdss.mail import Fault, Kind, MessageReceived, MessageStage, Stage
from fusiond.outputs.messages.base import Count, Message, stamp

Card = Annotated[
    int, Field(ge=0), WithJsonSchema({"type": "integer", "minimum": 0, "maximum": 16_777_215})
]
"""An RDSS card's number: 21 bits are used, 24 are sent."""


class ShortMessage(Message):
    """State of one message: each change of an own one, and each received one, once.

    Its time is that of the change. A report that a killed daemon could not publish follows after
    its restart: the same `serial` marks the same message.
    """

    serial: Count = Field(description="grows with each report; equal in a repetition")
    direction: Literal["sent", "received"]
    source: str = Field(description="name of the terminal")
    card: Card = Field(description="the other card: receiver or sender")
    id: str | None = Field(description="id of its command; null for a received message")
    kind: Kind
    state: Stage | Literal["received"]
    over: bool = Field(description="last report of this message")
    why: str = Field(description="reason for the wait, or for the end")
    text: str | None = Field(description="null if it is no text, such as a report")
    hex: str = Field(description="bytes as the terminal carries them")
    attempts: Count = Field(description="number of transmissions, as far as known")
    receipt: bool = Field(description="a receipt was requested")
    repeated: bool = Field(description="the text came before: its receipt was lost")
    fault: Fault | None = Field(description="defect of a received message; null if none")
    sent_at: str | None = Field(description="hh:mm by the centre, in the terminal's zone")


def of_stage(stage: MessageStage, serial: int, utc_ns: int | None) -> ShortMessage:
    """Build `message` of a sent short message at its present stage."""
    t_utc, t_ms = stamp(utc_ns)
    return ShortMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        serial=serial,
        direction="sent",
        source=stage.source,
        card=stage.receiver,
        id=stage.key,
        kind=stage.kind,
        state=stage.stage,
        over=stage.over,
        why=stage.why,
        text=stage.text,
        hex=stage.payload.hex(),
        attempts=stage.attempts,
        receipt=stage.wants_receipt,
        repeated=False,
        fault=None,
        sent_at=None,
    )


def of_received(mail: MessageReceived, serial: int, utc_ns: int | None) -> ShortMessage:
    """Build `message` of a received short message."""
    t_utc, t_ms = stamp(utc_ns)
    minute = mail.minute_of_day
    return ShortMessage(
        t_utc=t_utc,
        t_ms=t_ms,
        serial=serial,
        direction="received",
        source=mail.source,
        card=mail.sender,
        id=None,
        kind=mail.kind,
        state="received",
        over=True,
        why=f"for card {mail.receiver:07d}" if mail.fault == "other_card" else "",
        text=mail.text,
        hex=mail.payload.hex(),
        attempts=0,
        receipt=mail.kind == "text" and mail.number is not None,
        repeated=mail.repeated,
        fault=mail.fault or None,
        sent_at=None if minute is None else f"{minute // 60:02d}:{minute % 60:02d}",
    )
