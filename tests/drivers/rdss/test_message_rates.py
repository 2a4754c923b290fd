"""Fixes and messages together: each gets the turns that the card and a cycle of one fix allow."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable
from dataclasses import replace

import pytest

from drivers.rdss.messages import Feedback, Message, Outcome
from drivers.rdss.state_tables import FIX_EXPECTED_NS, SECOND
from tests.drivers.rdss.bench import FIX, OK
from tests.drivers.rdss.mail_bench import OPTIONS, SENT, MailBench, bench

Replies = Iterable[tuple[float, Message]]
MARGIN_S = 0.1
DELAY_S = 1.5
"""Of every fix, as in paper 000's cycle."""


def both_always_wait(service_s: int, turns: int, lost: float = 0.0, busy: float = 0.0) -> MailBench:
    """A card of whose `turns` fixes and messages want all; the bench after them."""
    dice = random.Random(service_s)

    def feedback(ok: Feedback, then: Replies) -> Replies:
        if dice.random() < busy:
            wait_s = float(dice.randint(1, service_s))
            return [(0.05, Feedback(Outcome.FREQUENCY, None, wait_s))]
        return [(0.05, ok), *then]

    b = MailBench(
        replace(OPTIONS, message_expiry_s=1e6),
        service_s=service_s,
        answer=lambda _: feedback(OK, [] if dice.random() < lost else [(DELAY_S, FIX)]),
        answer_text=lambda _: feedback(SENT, []),
    )
    b.run(3)
    for number in range(turns):
        while len(b.cycle.outbox.waiting) < 3:
            b.post("x", key=f"{number}-{len(b.cycle.outbox.waiting)}")
        b.run(service_s)
    return b


@pytest.mark.parametrize("service_s", [1, 10, 60])
def test_fixes_and_messages_have_all_turns_of_card_and_cycle(service_s: int) -> None:
    b = both_always_wait(service_s, 200)
    # A message's turn is the card's; a fix's is the card's or, of a fast card, the fix's own delay.
    card_s = service_s + MARGIN_S
    pair_s = card_s + max(card_s, DELAY_S)
    possible = 200 * service_s / pair_s
    assert b.cycle.counters["fixes"] == pytest.approx(possible, rel=0.03)
    assert b.cycle.counters["messages_sent"] == pytest.approx(possible, rel=0.03)


@pytest.mark.parametrize("service_s", [10, 60])
def test_lost_fixes_and_refusals_cost_no_turn_of_an_ordinary_card(service_s: int) -> None:
    b = both_always_wait(service_s, 200, lost=0.2)
    assert len(b.bursts) == pytest.approx(200 * service_s / (service_s + MARGIN_S), rel=0.03)
    busy = both_always_wait(service_s, 200, lost=0.2, busy=0.1)
    # A refusal states a wait in whole seconds, of up to a turn, and a second is added.
    refused = busy.cycle.counters["refused_frequency"]
    most_s = refused * (service_s + 1)
    assert len(busy.bursts) >= (200 * service_s - most_s) / (service_s + MARGIN_S)
    assert busy.cycle.counters["messages_sent"] > 0.4 * (len(busy.bursts) - refused)


def test_an_overdue_fix_holds_up_the_next_request_and_no_message() -> None:
    b = bench(service_s=1, answer=lambda _: [(0.05, OK)])
    for n in range(24):
        b.post("waits", key=f"a{n}")
    b.run(30)
    asked = [t for t, m in b.bursts if m not in b.texts]
    assert all(y - x >= 10.0 for x, y in itertools.pairwise(asked))
    assert len(asked) > 2
    for at in asked[:-1]:
        within = [t - at for t, m in b.bursts if m in b.texts and 0.0 < t - at < 10.0]
        assert min(within) == pytest.approx(FIX_EXPECTED_NS / SECOND, abs=0.01)
        assert len(within) >= 4
    assert b.cycle.counters["timeout_fix"] == len(asked) - 1


def test_a_slow_fix_counts_though_a_message_is_under_way() -> None:
    b = bench(service_s=1, answer=lambda _: [(0.05, OK), (5.1, FIX)])
    b.answer_text = lambda _: [(0.3, SENT)]
    b.post("meanwhile")
    b.run(6)
    assert b.stages()[-1] == "sent"
    assert b.cycle.counters["fixes"] >= 1
    assert b.cycle.counters["slow_fix"] == b.cycle.counters["fixes"]
    assert not b.cycle.counters["late_fix"]


def test_a_beam_lost_by_a_message_does_not_ask_for_a_second_fix_at_once() -> None:
    b = bench(service_s=1, answer=lambda _: [(0.05, OK)])
    b.answer_text = lambda _: [(0.1, Feedback(Outcome.NOT_LOCKED, "TXSQ"))]
    b.post("no beam")
    b.run(60)
    asked = [t for t, m in b.bursts if m not in b.texts]
    assert all(y - x >= 10.0 for x, y in itertools.pairwise(asked))
