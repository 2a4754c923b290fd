"""Stored short messages: waiting ones, and received ones that are not yet published.

Instants are stored as ages, since a monotonic clock may restart.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, TypeAdapter
from pydantic.dataclasses import dataclass

from drivers.rdss.inbox import Inbox
from drivers.rdss.mail import Kind, Stage, TextEncoding
from drivers.rdss.messages import FieldError
from drivers.rdss.outbox import Outbox, Outgoing
from drivers.rdss.text_coding import EncodedText, printable_text
from drivers.rdss.vehicle_message_envelope import Receipt, decode_text_body, envelope_from_text
from fusiond.outputs.messages.short_message import ShortMessage

SECOND_NS = 1_000_000_000
Hex = Annotated[str, Field(pattern=r"^([0-9a-f]{2}){0,256}$")]
Natural = Annotated[int, Field(ge=0, le=2**62)]


@dataclass(frozen=True, slots=True)
class KeptWording:
    """Stored `EncodedText`, its bytes in hex."""

    payload: Hex
    encoding: TextEncoding
    odd: bool = False


@dataclass(frozen=True, slots=True)
class KeptMessage:
    """Stored `Outgoing`; `age_s` is the time since it was queued."""

    key: Annotated[str, Field(max_length=64)]
    receiver: Natural
    kind: Kind
    wordings: Annotated[tuple[KeptWording, ...], Field(min_length=1, max_length=4)]
    age_s: Annotated[float, Field(ge=0.0)]
    receipted: tuple[Natural, Natural] | None
    attempts: Natural
    refusals: Natural
    stage: Stage


@dataclass(frozen=True, slots=True)
class KeptBox:
    """Messages of one terminal.

    `number`: the last one used for a text that asks for a receipt. `seen`: received texts that
    asked for a receipt."""

    number: Natural
    waiting: tuple[KeptMessage, ...]
    seen: tuple[tuple[Natural, Natural, Natural], ...]


@dataclass(frozen=True, slots=True)
class KeptMessages:
    """Stored messages by terminal; no broker has confirmed those of `untold`. `utc_s` is the
    instant of writing, None if unknown; `taken_up_ns` the instant of the restore."""

    serial: Natural
    boxes: dict[str, KeptBox]
    untold: tuple[ShortMessage, ...]
    utc_s: float | None = None
    taken_up_ns: int | None = None


KEPT_MESSAGES = TypeAdapter(KeptMessages)


def kept_box(outbox: Outbox, inbox: Inbox, t_ns: int) -> KeptBox:
    """Messages of a terminal at `t_ns`, for storage."""
    return KeptBox(
        outbox.number,
        tuple(_kept(m, t_ns) for m in outbox.waiting),
        tuple(inbox.seen),
    )


def restore(box: KeptBox, outbox: Outbox, inbox: Inbox, t_ns: int) -> None:
    """Restore a terminal's messages at `t_ns`."""
    inbox.seen.update(dict.fromkeys(box.seen))
    outbox.restore([_outgoing(m, t_ns) for m in box.waiting], box.number)


def _kept(m: Outgoing, t_ns: int) -> KeptMessage:
    return KeptMessage(
        m.key,
        m.receiver,
        m.kind,
        tuple(KeptWording(w.payload.hex(), w.encoding, w.odd) for w in m.wordings),
        max(0.0, (t_ns - m.created_ns) / SECOND_NS),
        m.receipted,
        m.attempts,
        m.refusals,
        m.stage,
    )


def _outgoing(kept: KeptMessage, t_ns: int) -> Outgoing:
    """Restore a message; one that waits for a receipt waits at most as long as a new one."""
    wordings = tuple(
        EncodedText(bytes.fromhex(w.payload), w.encoding, w.odd) for w in kept.wordings
    )
    return Outgoing(
        kept.key,
        kept.receiver,
        kept.kind,
        wordings,
        t_ns - round(kept.age_s * SECOND_NS),
        _text(wordings[0]) if kept.kind == "text" else None,
        None if kept.receipted is None else Receipt(*kept.receipted),
        kept.attempts,
        kept.refusals,
        "queued",
    )


def _text(wording: EncodedText) -> str | None:
    try:
        envelope = envelope_from_text(wording)
    except FieldError:
        return None
    if envelope is None:
        return printable_text(wording)
    return printable_text(EncodedText(decode_text_body(envelope.body)[1], "mixed"))
