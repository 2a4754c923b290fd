"""Mail of an RDSS driver: received short messages, and stages of sent ones.

A separate module, since a daemon without a terminal loads only this one.
"""

from __future__ import annotations

from typing import Literal

from drivers.immutable import immutable
from drivers.rdss.position_report_coding import PositionReport

TextEncoding = Literal["chinese", "code", "mixed"]
"""Encodings: Chinese characters (GB 2312, two bytes each), digits of 4 bits, or 0xA4 and any bytes.
"""
Kind = Literal["text", "report", "receipt"]
Stage = Literal[
    "queued",
    "sent",
    "delivered",
    "unconfirmed",
    "failed",
    "expired",
    "superseded",
    "too_long",
    "forbidden",
    "no_permission",
    "unsayable",
]
"""Stages. `queued`: waits for its turn or another attempt. `sent`: accepted by the terminal; a
receipt is expected, or none was requested, which is its end.

Ends: `delivered` (its receipt came), `unconfirmed` (written as often or as long as it may be, and
nobody said that it left or arrived), `failed` (refused as often), `expired` (it never left),
`superseded` (a report, by a newer
one), `too_long` (for the card), `forbidden` (the card's level allows no message), `no_permission`
(the terminal says so), `unsayable` (in the terminal's family)."""
ENDS: frozenset[Stage] = frozenset(
    {
        *("delivered", "unconfirmed", "failed", "expired", "superseded"),
        *("too_long", "forbidden", "no_permission", "unsayable"),
    }
)
Fault = Literal["", "crc", "cut", "damaged", "version", "other_card"]
"""Fault of a received message: the terminal says that its CRC failed; an envelope of fusiond's
is cut, damaged or of a later version; it is for another card. It is handed on all the same, as
bytes."""


@immutable()
class MessageReceived:
    """Short message that the terminal has received.

    `text` is None for bytes that are no text. `minute_of_day` is the centre's, in the terminal's
    zone. `report` is the position report in the message; `repeated`: the message came before.
    """

    source: str
    t_seen_ns: int
    sender: int
    receiver: int
    kind: Kind
    payload: bytes
    encoding: TextEncoding
    text: str | None
    minute_of_day: int | None
    number: int | None = None
    report: PositionReport | None = None
    repeated: bool = False
    fault: Fault = ""


@immutable()
class MessageStage:
    """Stage of a sent message: `key` is the sender's name for the message, `why` the reason as
    text."""

    source: str
    t_seen_ns: int
    key: str
    receiver: int
    kind: Kind
    payload: bytes
    text: str | None
    stage: Stage
    why: str
    attempts: int
    wants_receipt: bool

    @property
    def over(self) -> bool:
        """True for a final stage."""
        return self.stage in ENDS or (self.stage == "sent" and not self.wants_receipt)


@immutable()
class FleetFix:
    """Position of another card from the centre, queried or reported.

    Degrees, metres; `time_of_day_s` in the terminal's zone, without a date.
    """

    source: str
    t_seen_ns: int
    card: int
    time_of_day_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    precision_class_m: float


class MessageRefusedError(ValueError):
    """Error: a message cannot be queued; the text is the reason, `counter` its counter."""

    def __init__(self, counter: str, text: str) -> None:
        super().__init__(text)
        self.counter = counter


Mail = MessageReceived | MessageStage | FleetFix
