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

    serial: Count = Field(description="grows with each; the same again says the same")
    direction: Literal["sent", "received"]
    source: str = Field(description="the terminal")
    card: Card = Field(description="the other one: whom it is for, or whom it is from")
    id: str | None = Field(description="of the command that sent it; null for one that came")
    kind: Kind
    state: Stage | Literal["received"]
    over: bool = Field(description="nothing more comes of it")
    why: str = Field(description="what it waits for, or why this is its end")
    text: str | None = Field(description="null where it is none, such as a report")
    hex: str = Field(description="as the terminal carries it")
    attempts: Count = Field(description="how often it was sent, as far as is known")
    receipt: bool = Field(description="a receipt was asked for")
    repeated: bool = Field(description="the same text came before: its receipt was lost")
    fault: Fault | None = Field(description="what is wrong with one that came; null: nothing")
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
