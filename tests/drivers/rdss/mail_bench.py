"""A terminal that takes messages, for tests: what it is asked, what it answers, what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from drivers.rdss.mail import FleetFix, MessageReceived
from drivers.rdss.messages import (
    Family,
    Feedback,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    PositionRequest,
    Text,
    TextRequest,
)
from drivers.rdss.outbox import StageChange
from drivers.rdss.position_report_coding import PositionReport
from drivers.rdss.state_tables import Action, MailReady, TerminalOptions
from drivers.rdss.text_coding import EncodedText
from drivers.rdss.vehicle_message_envelope import (
    RECEIPT,
    TEXT,
    Receipt,
    decode_text_body,
    encode_envelope,
    encode_receipt_body,
    encode_text_body,
    envelope_from_text,
    envelope_to_text,
)
from tests.drivers.rdss.bench import USER, Bench

OTHER = 242407


SENT = Feedback(Outcome.OK, "TXSQ", user=USER)


OPTIONS = TerminalOptions(bauds=(115200,), families=("4.0",), source="rdss")


HERE = PositionReport(1_700_000_000.0, 30.0, 114.0, "navigating", (1.0, 1.0, 2.0), 40.0, 5.0, 90.0)


AnswerText = Callable[[TextRequest], Iterable[tuple[float, Message]]]


def sent(request: TextRequest) -> Iterable[tuple[float, Message]]:
    return [(0.2, SENT)]


@dataclass
class MailBench(Bench):
    """A terminal that takes messages too, with a card of `level`."""

    level: int = 3
    answer_text: AnswerText = sent
    mail: list[MessageReceived | FleetFix] = field(default_factory=list)
    changes: list[StageChange] = field(default_factory=list)
    bursts: list[tuple[float, Message]] = field(default_factory=list)

    def do(self, actions: list[Action]) -> None:
        rest = []
        for action in actions:
            if isinstance(action, MailReady):
                assert isinstance(action.mail, MessageReceived | FleetFix)
                self.mail.append(action.mail)
            else:
                rest.append(action)
        super().do(rest)
        self.changes += self.cycle.outbox.take_changes()

    def hear(self, message: Message, family: Family) -> None:
        match message:
            case IdentityRequest():
                identity = Identity(self.user, self.service_s, comm_level=self.level)
                self.say(identity, 0.1)
            case TextRequest():
                self.bursts.append((self.t, message))
                for delay, reply in self.answer_text(message):
                    self.say(reply, delay)
            case PositionRequest():
                self.bursts.append((self.t, message))
                super().hear(message, family)
            case _:
                super().hear(message, family)

    def post(self, text: str, key: str = "a", receipt: bool = False) -> None:
        self.cycle.post_text(key, OTHER, text, receipt, self.t_ns)
        self.changes += self.cycle.outbox.take_changes()

    def stages(self, key: str = "a") -> list[str]:
        return [c.stage for c in self.changes if c.message.key == key]

    @property
    def texts(self) -> list[TextRequest]:
        return [m for _, m in self.bursts if isinstance(m, TextRequest)]


def bench(**given: object) -> MailBench:
    made = MailBench(OPTIONS, **given)  # type: ignore[arg-type]
    made.run(3)
    return made


def receipt_for(request: TextRequest) -> Text:
    envelope = envelope_from_text(EncodedText(request.payload, request.encoding))
    assert envelope is not None
    number, _ = decode_text_body(envelope.body)
    body = encode_receipt_body(Receipt(number, envelope.crc))
    wording = envelope_to_text(encode_envelope(RECEIPT, body), "binary")
    return Text(OTHER, wording.payload, wording.encoding, USER)


def asking(number: int, text: bytes) -> Text:
    wording = envelope_to_text(encode_envelope(TEXT, encode_text_body(number, text)), "binary")
    return Text(OTHER, wording.payload, wording.encoding, USER, 600)
