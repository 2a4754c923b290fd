"""What comes of messages: receipts, texts and reports of others, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pytest

from drivers.rdss.mail import FleetFix, MessageReceived
from drivers.rdss.messages import (
    Message,
    Text,
    TextRequest,
)
from drivers.rdss.outbox import MOST_ATTEMPTS
from drivers.rdss.position_report_coding import decode_report
from drivers.rdss.text_coding import EncodedText
from drivers.rdss.vehicle_message_envelope import (
    TEXT,
    Receipt,
    decode_receipt_body,
    encode_envelope,
    encode_text_body,
    envelope_crc,
    envelope_from_text,
)
from tests.drivers.rdss.bench import FIX, USER
from tests.drivers.rdss.mail_bench import (
    HERE,
    OTHER,
    SENT,
    asking,
    bench,
    receipt_for,
)


def test_a_receipt_ends_a_text_as_delivered() -> None:
    b = bench(service_s=10, answer_text=lambda m: [(0.2, SENT), (8.0, receipt_for(m))])
    b.post("hello", receipt=True)
    b.run(60)
    assert b.stages() == ["queued", "sent", "delivered"]
    assert len(b.texts) == 1


def test_a_text_without_its_receipt_goes_again_and_ends_unconfirmed() -> None:
    b = bench(service_s=10)
    b.post("hello", receipt=True)
    b.run(1500)
    assert b.stages()[-1] == "unconfirmed"
    assert len(b.texts) == MOST_ATTEMPTS
    assert len({m.payload for m in b.texts}) == 1, "the receiver must know it again"


def test_another_cards_or_anothers_receipt_is_none() -> None:
    def wrong(m: TextRequest) -> Iterable[tuple[float, Message]]:
        return [(0.2, SENT), (1.0, replace(receipt_for(m), sender=OTHER + 1))]

    b = bench(service_s=10, answer_text=wrong)
    b.post("hello", receipt=True)
    b.run(20)
    assert b.stages()[-1] == "sent"
    assert b.cycle.counters["receipt_unmatched"] == 1


def test_a_text_that_asks_is_answered_each_time_and_known_when_it_comes_again() -> None:
    b = bench(service_s=10)
    for _ in range(2):
        b.say(asking(7, b"go north"))
        b.run(30)
    assert [(m.text, m.number, m.repeated) for m in b.mail if isinstance(m, MessageReceived)] == [
        ("go north", 7, False),
        ("go north", 7, True),
    ]
    assert len(b.texts) == 2
    envelope = envelope_from_text(EncodedText(b.texts[0].payload, b.texts[0].encoding))
    assert envelope is not None
    crc = envelope_crc(encode_envelope(TEXT, encode_text_body(7, b"go north")))
    assert decode_receipt_body(envelope.body) == Receipt(7, crc)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (Text(OTHER, b"\xa4hello", "mixed", USER), ""),
        (Text(OTHER, b"\xa4hello", "mixed", OTHER), "other_card"),
        (Text(OTHER, b"\xa4hello", "mixed", USER, crc_ok=False), "crc"),
        (Text(OTHER, b"\xa4\xf9abc", "mixed", USER), "cut"),
        (replace(asking(1, b"hello"), payload=asking(1, b"hello").payload[:-3]), "cut"),
        (replace(asking(1, b"hello"), payload=asking(1, b"hello").payload[:-1] + b"\0"), "damaged"),
        (Text(OTHER, b"\xa4" + encode_envelope(7, b"\x02"), "mixed", USER), "version"),
    ],
)
def test_whatever_comes_is_handed_on_with_what_is_wrong_of_it(text: Text, fault: str) -> None:
    b = bench()
    b.say(text)
    b.run(1)
    (mail,) = b.mail
    assert isinstance(mail, MessageReceived)
    assert (mail.fault, mail.payload) == (fault, text.payload)
    assert b.cycle.counters["messages_received"] == 1
    assert not fault or b.cycle.counters[f"message_{fault}"] == 1


def test_a_report_is_read_and_the_newest_alone_waits() -> None:
    b = bench(service_s=10)
    for n in range(3):
        b.cycle.post_report(f"r{n}", OTHER, HERE._replace(height_m=float(n)), b.t_ns)
    b.do([])
    b.run(30)
    assert [b.stages(f"r{n}")[-1] for n in range(3)] == ["superseded", "superseded", "sent"]
    (request,) = b.texts
    b.say(Text(OTHER, request.payload, request.encoding, USER))
    b.run(1)
    (mail,) = b.mail
    assert isinstance(mail, MessageReceived)
    assert mail.report is not None
    assert mail.report.height_m == pytest.approx(2.0, abs=0.05)


def test_a_card_of_level_1_reports_in_short() -> None:
    b = bench(level=1)
    b.cycle.post_report("r", OTHER, HERE, b.t_ns)
    b.run(62)
    envelope = envelope_from_text(EncodedText(b.texts[0].payload, b.texts[0].encoding))
    assert envelope is not None
    assert decode_report(*envelope[:2]).dated is False


def test_the_place_of_another_card_is_handed_on() -> None:
    b = bench()
    b.say(replace(FIX, kind="query", queried=OTHER))
    b.say(replace(FIX, kind="own", user=OTHER))
    b.run(1)
    (mail,) = b.mail
    assert isinstance(mail, FleetFix)
    assert mail.card == OTHER
    assert b.cycle.counters["foreign_fix"] == 2
