"""Received short messages: senders, contents, and requested receipts."""

from __future__ import annotations

from collections import OrderedDict

from drivers.rdss.mail import Fault, FleetFix, Kind, MessageReceived
from drivers.rdss.messages import Fix, Text
from drivers.rdss.position_report_coding import PositionReport, decode_report
from drivers.rdss.request_cycle_state import RequestCycleState
from drivers.rdss.state_tables import MailReady
from drivers.rdss.text_coding import EncodedText, printable_text
from drivers.rdss.vehicle_message_envelope import (
    RECEIPT,
    TEXT,
    Envelope,
    EnvelopeDamagedError,
    EnvelopeLengthError,
    EnvelopeVersionError,
    Receipt,
    decode_receipt_body,
    decode_text_body,
    envelope_from_text,
)

MOST_REMEMBERED = 128
"""Texts that asked for a receipt: two hours of a card that is sent one a minute (our choice)."""
Seen = tuple[int, int, int]
"""Sender, number, CRC."""


class Inbox:
    """Inbox, which passes on all messages, even damaged ones. `seen` has the texts that requested a
    receipt, to recognise repetitions."""

    def __init__(self, session: RequestCycleState) -> None:
        self._session = session
        self.seen: OrderedDict[Seen, None] = OrderedDict()

    def mail_of(self, message: Text, t_ns: int) -> MailReady:
        """Mail from a message of the terminal."""
        session = self._session
        session.counters["messages_received"] += 1
        wording = EncodedText(message.payload, message.encoding, message.odd)
        card = session.identity.user if session.identity is not None else 0
        receiver = message.user or card
        fault: Fault = ""
        envelope: Envelope | None = None
        if receiver != card:
            fault = "other_card"
        elif not message.crc_ok:
            fault = "crc"
        else:
            envelope, fault = _opened(wording)
        kind: Kind = "text"
        text = None if fault in ("cut", "damaged", "version") else printable_text(wording)
        report: PositionReport | None = None
        number: int | None = None
        repeated = False
        if envelope is not None:
            if envelope.kind == TEXT:
                number, data = decode_text_body(envelope.body)
                text = printable_text(EncodedText(data, "mixed"))
                repeated = self._asks(message.sender, Receipt(number, envelope.crc), t_ns)
            elif envelope.kind == RECEIPT:
                kind, text = "receipt", None
                receipted = decode_receipt_body(envelope.body)
                number = receipted.number
                session.outbox.receipt(message.sender, receipted)
            else:
                kind, text = "report", None
                try:
                    report = decode_report(envelope.kind, envelope.body)
                except ValueError:
                    fault = "damaged"
        if fault:
            session.counters[f"message_{fault}"] += 1
        return MailReady(
            MessageReceived(
                session.options.source,
                t_ns,
                message.sender,
                receiver,
                kind,
                message.payload,
                message.encoding,
                text,
                message.minute_of_day,
                number,
                report,
                repeated,
                fault,
            )
        )

    def place(self, fix: Fix, t_ns: int) -> MailReady | None:
        """Position of another card by the centre; None for a fix of this card."""
        own = self._session.identity
        card = fix.queried or fix.user
        if fix.kind == "own" or own is None or card in (0, own.user):
            return None
        return MailReady(
            FleetFix(
                self._session.options.source,
                t_ns,
                card,
                fix.time_of_day_s,
                fix.lat_deg,
                fix.lon_deg,
                fix.height_m,
                float(fix.precision_class_m),
            )
        )

    def _asks(self, sender: int, receipted: Receipt, t_ns: int) -> bool:
        """Queue the receipt for a text; true if the text came before."""
        session = self._session
        if session.options.transmit:
            session.outbox.post_receipt(sender, receipted, t_ns)
        else:
            session.counters["receipt_read_only"] += 1
        seen = (sender, *receipted)
        repeated = seen in self.seen
        session.counters["message_repeated"] += repeated
        self.seen[seen] = None
        if len(self.seen) > MOST_REMEMBERED:
            self.seen.popitem(last=False)
        return repeated


def _opened(wording: EncodedText) -> tuple[Envelope | None, Fault]:
    """Decoded envelope, or the name of its fault."""
    try:
        return envelope_from_text(wording), ""
    except EnvelopeLengthError:
        return None, "cut"
    except EnvelopeDamagedError:
        return None, "damaged"
    except EnvelopeVersionError:
        return None, "version"
