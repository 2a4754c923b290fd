"""Short messages between simulated terminals: carried, lost, damaged, refused by the card."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from drivers.rdss import binary_4_0, text_2_1
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
from drivers.rdss.position_report_coding import REPORT, decode_report
from drivers.rdss.text_coding import EncodedText, encode_bytes, encode_digits, encode_shortest
from drivers.rdss.vehicle_message_envelope import (
    TEXT,
    Receipt,
    decode_receipt_body,
    encode_envelope,
    encode_text_body,
    envelope_from_text,
    envelope_to_text,
)
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssOptions
from fusiond.simulation.rdss.short_messages import ConvoyVehicle, MessageNetwork
from fusiond.simulation.rdss.terminal import RdssTerminal
from tests.simulation.utc_start import UTC_START_NS

FAMILIES: tuple[Family, ...] = ("4.0", "2.1")
A, B = 242286, 242407


class Pair:
    """Two terminals and their network; nothing sleeps."""

    def __init__(self, truth: Truth, family: Family, level: int = 3, **network: float) -> None:
        self.codec = binary_4_0 if family == "4.0" else text_2_1
        self.network = MessageNetwork(np.random.default_rng(7), **network)  # type: ignore[arg-type]
        self.terminals = {}
        for card in (A, B):
            options = RdssOptions(family=family, user=card, service_frequency_s=1, comm_level=level)
            rng = np.random.default_rng(card)
            self.terminals[card] = RdssTerminal(truth, options, rng, UTC_START_NS)
            self.network.join(self.terminals[card])

    def ask(self, message: Message, t_s: float, card: int = A) -> None:
        self.terminals[card].receive(self.codec.encode(message), t_s)

    def hear(self, card: int, until_s: float) -> list[Message]:
        said = self.terminals[card].read(until_s)
        heard: list[Message] = self.codec.Decoder().feed(said)
        return heard


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    "wording",
    [
        encode_shortest("hello"),
        encode_shortest("你好"),
        encode_digits("12345"),
        encode_bytes(b"\xff$"),
    ],
)
def test_a_message_comes_as_it_was_sent(truth: Truth, family: Family, wording: EncodedText) -> None:
    pair = Pair(truth, family)
    pair.ask(TextRequest(B, wording.payload, wording.encoding, A, odd=wording.odd), 10.0)
    (feedback,) = pair.hear(A, 20.0)
    assert isinstance(feedback, Feedback)
    assert (feedback.outcome, feedback.command) == (
        Outcome.OK,
        "TXSQ" if family == "4.0" else "TXA",
    )
    (text,) = pair.hear(B, 20.0)
    assert isinstance(text, Text)
    assert (text.sender, text.payload, text.encoding, text.odd) == (A, *wording)
    assert text.minute_of_day is not None
    assert pair.network.counters == {"carried": 1}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("level", "taken"), [(0, False), (1, False), (2, True)])
def test_the_card_bounds_a_message(truth: Truth, family: Family, level: int, taken: bool) -> None:
    pair = Pair(truth, family, level)
    pair.ask(IdentityRequest(), 1.0)
    (identity,) = pair.hear(A, 2.0)
    assert isinstance(identity, Identity)
    assert identity.comm_level == level
    pair.ask(TextRequest(B, b"\xa4" + b"x" * 20, "mixed", A), 10.0)
    (feedback,) = pair.hear(A, 20.0)
    assert isinstance(feedback, Feedback)
    assert (feedback.outcome is Outcome.OK) == taken
    assert len(pair.hear(B, 20.0)) == taken


def test_messages_and_fixes_share_the_cards_spacing(truth: Truth) -> None:
    pair = Pair(truth, "4.0")
    pair.ask(PositionRequest(), 10.0)
    pair.ask(TextRequest(B, b"\xa4x", "mixed", A), 10.5)
    outcomes = [m.outcome for m in pair.hear(A, 10.8) if isinstance(m, Feedback)]
    assert outcomes == [Outcome.OK, Outcome.FREQUENCY]
    assert pair.terminals[A].bursts_s == [10.0]
    assert pair.network.counters == Counter()


def test_of_many_messages_so_many_are_lost_and_damaged_and_each_is_counted(truth: Truth) -> None:
    pair = Pair(truth, "4.0", loss_probability=0.3, damage_probability=0.2)
    for k in range(400):
        pair.ask(TextRequest(B, b"\xa4%d" % k, "mixed", A), 10.0 + 2.0 * k)
    texts = [m for m in pair.hear(B, 2000.0) if isinstance(m, Text)]
    counters = pair.network.counters
    assert sum(counters.values()) == 400
    assert counters["lost"] == pytest.approx(120, abs=4 * (400 * 0.21) ** 0.5)
    assert counters["damaged"] == pytest.approx(56, abs=4 * (400 * 0.12) ** 0.5)
    assert [t.crc_ok for t in texts].count(False) == counters["damaged"]
    pair.ask(TextRequest(1, b"\xa4x", "mixed", A), 3000.0)
    assert counters["nobody"] == 1


def test_a_busy_terminal_says_nothing_to_some(truth: Truth) -> None:
    options = RdssOptions(user=A, service_frequency_s=1, mute_probability=0.5)
    terminal = RdssTerminal(truth, options, np.random.default_rng(3), UTC_START_NS)
    for k in range(100):
        terminal.receive(binary_4_0.encode(TextRequest(B, b"\xa4x", "mixed", A)), 2.0 * k)
    assert terminal.counters["muted"] == pytest.approx(50, abs=20)
    assert len(terminal.bursts_s) == 100 - terminal.counters["muted"]


def test_the_other_vehicle_reports_orders_and_confirms(truth: Truth) -> None:
    options = RdssOptions(user=A, service_frequency_s=1, convoy=True)
    terminal = RdssTerminal(truth, options, np.random.default_rng(3), UTC_START_NS)
    convoy = ConvoyVehicle(truth, terminal)
    envelope = encode_envelope(TEXT, encode_text_body(5, b"where are you"))
    wording = envelope_to_text(envelope, "binary")
    terminal.receive(
        binary_4_0.encode(TextRequest(ConvoyVehicle.CARD, wording.payload, "mixed", A)), 3.0
    )
    for k in range(60):
        convoy.tick(float(k))
    texts = [m for m in binary_4_0.Decoder().feed(terminal.read(70.0)) if isinstance(m, Text)]
    found = [envelope_from_text(EncodedText(t.payload, t.encoding, t.odd)) for t in texts]
    reports = [decode_report(e.kind, e.body) for e in found if e is not None and e.kind == REPORT]
    assert len(reports) == 6
    assert reports[-1].t_s == pytest.approx(UTC_START_NS * 1e-9 + 55.0)
    there = truth.at(np.array([47.0])).position[0]
    assert np.radians([reports[-1].lat_deg, reports[-1].lon_deg]) == pytest.approx(there[:2])
    (receipt,) = [e for e in found if e is not None and e.kind not in (REPORT, TEXT)]
    assert decode_receipt_body(receipt.body) == Receipt(5, int.from_bytes(envelope[-2:], "big"))
    assert found.count(None) == 1  # one order, in plain words
