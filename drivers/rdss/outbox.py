"""Queue of messages to send: order, attempts, receipts and ends. No I/O and no clock.

Every message ends in a stage of `mail.Stage`, and each change of stage is reported. While the
terminal is blocked (no beam, suppression, a low battery, the card's spacing) a message waits until
it expires, without an attempt. Receipts are sent first, then texts, then the latest report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from drivers.rdss.mail import Kind, MessageRefusedError, Stage
from drivers.rdss.messages import Outcome
from drivers.rdss.position_report_coding import (
    REPORT,
    SHORT_REPORT,
    PositionReport,
    encode_report,
    encode_short,
)
from drivers.rdss.state_tables import GIVE_UP_NS
from drivers.rdss.text_coding import EncodedText, card_level_bits, encode_shortest
from drivers.rdss.vehicle_message_envelope import (
    RECEIPT,
    TEXT,
    Carriage,
    Receipt,
    encode_envelope,
    encode_receipt_body,
    encode_text_body,
    envelope_crc,
    envelope_to_text,
)

MOST_WAITING = 32
"""Half an hour of a card of 60 s; who queues more gets a refusal (our choice)."""
MOST_ATTEMPTS = 5
"""Attempts of a message: of ten, each lost with its receipt in three of ten, one in fifty is then
reported as unconfirmed: 1 - 0.7^2 is 0.51, to the fifth 0.03 (our choice)."""
MOST_REFUSALS = 3
"""Refusals in a row without a transient reason: public code asks three times (1.5)."""
RECEIPT_SPACINGS = 6
"""Turns of a similar card within which a receipt may come: every other turn is for its fixes, and
two messages may precede it (our choice)."""
RANKS: dict[Kind, int] = {"receipt": 0, "text": 1, "report": 2}
BLOCKED = frozenset(
    {
        *(Outcome.FREQUENCY, Outcome.NOT_LOCKED, Outcome.NOT_SENT, Outcome.LOW_BATTERY),
        *(Outcome.SUPPRESSED, Outcome.SILENCE, Outcome.SILENCE_OR_LIFTED, Outcome.NO_CARD),
    }
)
"""Temporary refusals: they pass by themselves or by somebody; they are no attempt."""


@dataclass(slots=True)
class Outgoing:
    """Outgoing message. `wordings` in order of preference: the first that the card allows is sent.

    `receipted` is the contents of the awaited receipt, None if none is requested. Instants are
    monotonic ns; `stage` is `queued`, or `sent` while it waits for the receipt.
    """

    key: str
    receiver: int
    kind: Kind
    wordings: tuple[EncodedText, ...]
    created_ns: int
    text: str | None = None
    receipted: Receipt | None = None
    attempts: int = 0
    refusals: int = 0
    stage: Stage = "queued"
    not_before_ns: int = 0
    why: str = ""


@dataclass(slots=True)
class StageChange:
    """Change of a message's stage, or its return to the queue, with the message at that time."""

    message: Outgoing
    stage: Stage
    why: str


@dataclass(slots=True)
class Outbox:
    """Queue of messages: see the module. `changes` has the changes not yet taken, `number` the last
    number used."""

    counters: Counter[str]
    expiry_ns: int
    waiting: list[Outgoing] = field(default_factory=list)
    changes: list[StageChange] = field(default_factory=list)
    number: int = 0
    carriage: Carriage = "binary"
    """Encoding of texts with a receipt, and of receipts."""
    comm_level: int | None = None
    spacing_ns: int = 0
    in_flight: Outgoing | None = None
    doubtful: Outgoing | None = None
    """Written, and no feedback came: a late one still counts."""

    # ------------------------------------------------------------------ queueing

    def post_text(self, key: str, receiver: int, text: str, receipt: bool, t_ns: int) -> None:
        """Queue a text. Raises `MessageRefusedError`."""
        if any(m.key == key for m in self.waiting):
            raise MessageRefusedError("message_known", "it is queued already under this id")
        if sum(m.kind == "text" for m in self.waiting) >= MOST_WAITING:
            raise MessageRefusedError("message_queue_full", f"{MOST_WAITING} messages wait already")
        try:
            wording, receipted = self._worded(text, receipt)
        except ValueError as error:
            raise MessageRefusedError("message_unsayable", str(error)) from None
        self._look_at(wording)
        self._queue(Outgoing(key, receiver, "text", (wording,), t_ns, text, receipted))

    def post_report(self, key: str, receiver: int, report: PositionReport, t_ns: int) -> None:
        """Queue a report in place of a waiting one. Raises `MessageRefusedError`."""
        try:
            full = encode_envelope(REPORT, encode_report(report))
            short = encode_envelope(SHORT_REPORT, encode_short(report))
        except ValueError as error:
            raise MessageRefusedError("message_unsayable", str(error)) from None
        wordings = envelope_to_text(full, self.carriage), envelope_to_text(short, self.carriage)
        self._look_at(wordings[-1])
        for older in [m for m in self.waiting if m.kind == "report" and m.receiver == receiver]:
            if older is not self.in_flight:
                self._end(older, "superseded", "a newer report is due")
        self._queue(Outgoing(key, receiver, "report", wordings, t_ns))

    def post_receipt(self, receiver: int, receipted: Receipt, t_ns: int) -> None:
        """Queue the receipt for a received message, unless the same receipt waits already."""
        key = f"receipt-{receiver}-{receipted.number}-{receipted.crc:04x}"
        if any(m.key == key for m in self.waiting):
            self.counters["receipt_waiting"] += 1
            return
        if sum(m.kind == "receipt" for m in self.waiting) >= MOST_WAITING:
            self.counters["receipt_queue_full"] += 1
            return
        if self.comm_level is not None and not card_level_bits(self.comm_level):
            self.counters["receipt_forbidden"] += 1
            return
        wording = envelope_to_text(
            encode_envelope(RECEIPT, encode_receipt_body(receipted)), self.carriage
        )
        self._queue(Outgoing(key, receiver, "receipt", (wording,), t_ns))

    def restore(self, messages: Sequence[Outgoing], number: int) -> None:
        """Restore the last run's messages; one in flight may be sent twice."""
        self.waiting = list(messages)
        self.number = number
        for message in self.waiting:
            self._report(message, message.stage, "kept over a restart")

    def _worded(self, text: str, receipt: bool) -> tuple[EncodedText, Receipt | None]:
        if not receipt:
            return encode_shortest(text), None
        number = self.number % 0xFFFF + 1
        envelope = encode_envelope(TEXT, encode_text_body(number, text.encode("gb18030")))
        self.number = number
        return envelope_to_text(envelope, self.carriage), Receipt(number, envelope_crc(envelope))

    def _look_at(self, wording: EncodedText) -> None:
        """Refuse a message that the known card can never send."""
        if self.comm_level is None:
            return
        most = card_level_bits(self.comm_level)
        if not most:
            text = f"the card's communication level, {self.comm_level}, allows no message"
            raise MessageRefusedError("message_forbidden", text)
        if wording.bits > most:
            text = f"{wording.bits} bits, and a card of level {self.comm_level} sends {most}"
            raise MessageRefusedError("message_too_long", text)

    def _queue(self, message: Outgoing) -> None:
        self.waiting.append(message)
        self.counters["messages_queued"] += 1
        self._report(message, "queued", "")

    # ------------------------------------------------------------------ sending

    def next(self, t_ns: int) -> Outgoing | None:
        """Message to send next."""
        due = [m for m in self.waiting if m.stage == "queued" and m.not_before_ns <= t_ns]
        return min(due, key=lambda m: (RANKS[m.kind], m.attempts > 0, m.created_ns), default=None)

    @property
    def next_ns(self) -> int | None:
        """Next instant of work: a message to send, a missing receipt, an expiry."""
        return min((min(m.not_before_ns, self._end_ns(m)) for m in self.waiting), default=None)

    def wording(self, message: Outgoing) -> EncodedText | None:
        """Wording for this card; None ends the message."""
        most = card_level_bits(self.comm_level or 0)
        for wording in message.wordings:
            if wording.bits <= most:
                return wording
        if most:
            self._end(message, "too_long", f"a card of level {self.comm_level} sends {most} bits")
        else:
            self._end(message, "forbidden", f"a card of level {self.comm_level} sends no message")
        return None

    def unsayable(self, message: Outgoing, why: str) -> None:
        """Refuse a message that the terminal's family cannot encode."""
        self._end(message, "unsayable", why)

    def written(self, message: Outgoing) -> None:
        """Note that the message was written to the terminal."""
        self.in_flight, self.doubtful = message, None
        message.attempts += 1
        self.counters["messages_written"] += 1

    def accepted(self, t_ns: int) -> None:
        """Note the terminal's acceptance of the message in flight, or of one it did not confirm."""
        message = self.in_flight or self.doubtful
        self.in_flight = self.doubtful = None
        if message is None or message not in self.waiting:
            return
        self.counters["messages_sent"] += 1
        message.refusals = 0
        if message.receipted is None:
            self._end(message, "sent", "")
            return
        message.stage = "sent"
        wait_ns = max(GIVE_UP_NS, RECEIPT_SPACINGS * self.spacing_ns) * message.attempts
        message.not_before_ns = t_ns + wait_ns
        self._report(message, "sent", "awaiting its receipt")

    def refused(self, outcome: Outcome, t_ns: int) -> None:
        """Note the terminal's refusal of the message in flight."""
        message, self.in_flight = self.in_flight, None
        if message is None:
            return
        self.counters["messages_refused"] += 1
        message.attempts -= 1
        if outcome is Outcome.NO_PERMISSION:
            self._end(message, "no_permission", "the card has no permission to send messages")
            return
        if outcome not in BLOCKED:
            message.refusals += 1
            if message.refusals >= MOST_REFUSALS:
                self._end(message, "failed", f"refused {message.refusals} times: {outcome}")
                return
        self._report(message, "queued", f"refused: {outcome}")

    def unanswered(self) -> None:
        """Requeue the message in flight after a missing feedback; it may have been sent."""
        message, self.in_flight = self.in_flight, None
        if message is None:
            return
        self.counters["timeout_message"] += 1
        self.doubtful = message
        if message.attempts >= MOST_ATTEMPTS:
            self._end(message, "unconfirmed", f"written {message.attempts} times, no feedback")
        else:
            self._report(message, "queued", "no feedback: it may have left")

    def receipt(self, sender: int, receipted: Receipt) -> None:
        """Note a receipt from this card."""
        for message in self.waiting:
            if message.receiver == sender and message.receipted == receipted:
                self._end(message, "delivered", "")
                return
        self.counters["receipt_unmatched"] += 1

    def settle(self, t_ns: int) -> None:
        """End expired messages, and requeue those without a receipt."""
        for message in [m for m in self.waiting if m is not self.in_flight]:
            if t_ns >= self._end_ns(message):
                # It was written before, so it may have been transmitted or have arrived.
                stage: Stage = "unconfirmed" if message.attempts else "expired"
                self._end(message, stage, f"its time is over; {message.why or 'never sent'}")
            elif message.stage == "sent" and t_ns >= message.not_before_ns:
                self.counters["timeout_receipt"] += 1
                if message.attempts >= MOST_ATTEMPTS:
                    text = f"sent {message.attempts} times, no receipt"
                    self._end(message, "unconfirmed", text)
                else:
                    message.stage = "queued"
                    self._report(message, "queued", "no receipt: it goes again")

    # ------------------------------------------------------------------ inside

    def _end_ns(self, message: Outgoing) -> int:
        return message.created_ns + self.expiry_ns

    def _end(self, message: Outgoing, stage: Stage, why: str) -> None:
        self.waiting.remove(message)
        if self.in_flight is message:
            self.in_flight = None
        if self.doubtful is message:
            self.doubtful = None
        self.counters[f"message_{stage}"] += 1
        self._report(message, stage, why)

    def _report(self, message: Outgoing, stage: Stage, why: str) -> None:
        message.why = why
        self.changes.append(StageChange(message, stage, why))

    def take_changes(self) -> Iterator[StageChange]:
        """Changes since the last call."""
        changes, self.changes = self.changes, []
        return iter(changes)


class StrideScheduler:
    """Order of fixes and messages while both wait: messages get `share` of the turns.

    Stride scheduling (Waldspurger and Weihl, MIT/LCS/TM-528, 1995): each turn costs its class the
    inverse of its share, and the class that has spent less goes next. An idle class does not save
    up turns.
    """

    def __init__(self, share: float) -> None:
        self._cost = {"message": 1.0 / share, "fix": 1.0 / (1.0 - share)}
        self._spent = {"message": 0.0, "fix": 0.0}

    @property
    def message_first(self) -> bool:
        """True if the message goes first; at equal cost the fix goes first."""
        return self._spent["message"] < self._spent["fix"]

    def took(self, message: bool, other_waits: bool) -> None:
        """Charge a turn to its class."""
        mine, other = ("message", "fix") if message else ("fix", "message")
        if not other_waits:
            self._spent[other] = max(self._spent[other], self._spent[mine])
        self._spent[mine] += self._cost[mine]
