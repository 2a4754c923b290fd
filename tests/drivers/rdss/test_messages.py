"""Short messages through the request cycle: shared turns, receipts, resending, and named ends."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.rdss.mail import ENDS, MessageRefusedError
from drivers.rdss.messages import (
    Feedback,
    Message,
    Outcome,
    Text,
)
from drivers.rdss.outbox import MOST_ATTEMPTS, MOST_WAITING, StrideScheduler
from drivers.rdss.position_report_coding import REPORT, encode_report
from drivers.rdss.state_tables import SECOND, State
from drivers.rdss.text_coding import encode_bytes
from drivers.rdss.vehicle_message_envelope import (
    encode_envelope,
)
from tests.drivers.rdss.bench import FIX, OK, USER
from tests.drivers.rdss.mail_bench import (
    HERE,
    OPTIONS,
    OTHER,
    SENT,
    MailBench,
    asking,
    bench,
    sent,
)

# --------------------------------------------------------------------------- turns


def test_a_text_is_sent_and_ends_so() -> None:
    b = bench()
    b.post("hello")
    b.run(62)
    assert b.stages() == ["queued", "sent"]
    (text,) = b.texts
    assert (text.user, text.receiver, text.payload) == (USER, OTHER, b"\xa4hello")
    assert not b.cycle.outbox.waiting


@pytest.mark.parametrize(("share", "messages"), [(0.5, 15), (0.25, 8), (0.8, 24)])
def test_fixes_and_messages_share_the_card_as_configured(share: float, messages: int) -> None:
    b = MailBench(replace(OPTIONS, message_share=share), service_s=10)
    b.run(3)
    for n in range(30):
        b.post("x", key=str(n))
    b.run(304)
    times = [t for t, _ in b.bursts]
    assert all(y - x >= 10 for x, y in itertools.pairwise(times))
    assert len(b.bursts) == 31
    assert len(b.texts) == pytest.approx(messages, abs=1)


def test_without_messages_all_turns_are_fixes_and_the_other_way_round() -> None:
    b = MailBench(replace(OPTIONS, request_interval_s=3600.0), service_s=10)
    b.run(3)
    assert len(b.requests) == 1
    for n in range(20):
        b.post("x", key=str(n))
    b.run(160)
    assert len(b.texts) == 16
    assert len(b.requests) == 1


@given(st.floats(0.05, 0.95), st.lists(st.booleans(), max_size=60))
def test_nobody_saves_up_turns_while_the_other_is_alone(share: float, alone: list[bool]) -> None:
    """After any time with one of both alone, the shares hold from then on."""
    turns = StrideScheduler(share)
    for message in alone:
        turns.took(message=message, other_waits=False)
    count = 0
    for _ in range(200):
        message = turns.message_first
        turns.took(message=message, other_waits=True)
        count += message
    assert count == pytest.approx(200 * share, abs=3 + max(1 / share, 1 / (1 - share)))


def test_a_fast_card_is_used_as_soon_as_it_and_the_cycle_allow() -> None:
    b = bench(service_s=1, answer=lambda _: [(0.05, OK), (0.7, FIX)])
    b.run(60)
    gaps = [y - x for x, y in itertools.pairwise(t for t, _ in b.requests)]
    assert sorted(gaps)[len(gaps) // 2] == pytest.approx(1.1, abs=0.01)
    assert len(b.requests) > 50


def test_a_terminal_that_finds_it_too_early_gets_a_greater_margin() -> None:
    b = bench(service_s=10)
    b.answer = lambda _: [(0.1, Feedback(Outcome.FREQUENCY, None, 5.0))]
    b.run(40)
    assert b.cycle._session.pace.margin_ns == SECOND // 10, "somebody else has used the card"
    b.answer = lambda _: [(0.1, Feedback(Outcome.FREQUENCY, None, 1.0))]
    b.run(120)
    b.answer = lambda _: [(0.1, OK), (0.5, FIX)]
    start = len(b.requests)
    b.run(60)
    gaps = [y - x for x, y in itertools.pairwise([t for t, _ in b.requests][start + 1 :])]
    assert min(gaps) >= 11


# --------------------------------------------------------------------------- ends


@pytest.mark.parametrize(
    ("outcome", "end"),
    [
        (Outcome.FAILED, "failed"),
        (Outcome.OTHER, "failed"),
        (Outcome.CRC, "failed"),
        (Outcome.ENCRYPTION, "failed"),
    ],
)
def test_what_is_refused_without_a_passing_reason_fails(outcome: Outcome, end: str) -> None:
    b = bench(service_s=10, answer_text=lambda _: [(0.2, Feedback(outcome, "TXSQ"))])
    b.post("hello")
    b.run(120)
    assert b.stages()[-1] == end
    assert len(b.texts) == 3
    assert b.cycle.counters["message_failed"] == 1


@pytest.mark.parametrize(
    "outcome",
    [Outcome.FREQUENCY, Outcome.NOT_LOCKED, Outcome.NOT_SENT, Outcome.LOW_BATTERY],
)
def test_what_blocks_the_terminal_delays_a_message_and_ends_none(outcome: Outcome) -> None:
    b = bench(service_s=10, answer_text=lambda _: [(0.2, Feedback(outcome, None, 5.0))])
    b.post("hello")
    b.run(200)
    assert set(b.stages()) == {"queued"}
    b.answer_text = sent
    b.run(200)
    assert b.stages()[-1] == "sent"


def test_a_busy_terminal_that_never_answers_leaves_a_message_unconfirmed() -> None:
    b = bench(service_s=10, answer_text=lambda _: [])
    b.post("hello")
    b.run(300)
    assert b.stages()[-1] == "unconfirmed"
    assert len(b.texts) == MOST_ATTEMPTS
    assert b.cycle.counters["timeout_message"] == MOST_ATTEMPTS


def test_a_feedback_that_comes_late_counts_and_nothing_goes_twice() -> None:
    b = bench(service_s=10, answer_text=lambda _: [(5.0, SENT)])
    b.post("hello")
    b.run(60)
    assert b.stages() == ["queued", "queued", "sent"]
    assert len(b.texts) == 1
    assert b.cycle.counters["late_feedback"] == 1


def test_no_permission_ends_a_message_and_leaves_fixes_alone() -> None:
    b = bench(service_s=10, answer_text=lambda _: [(0.2, Feedback(Outcome.NO_PERMISSION, "TXA"))])
    b.post("hello")
    b.run(60)
    assert b.stages()[-1] == "no_permission"
    assert b.cycle.counters["fixes"] >= 4


def test_a_message_that_cannot_leave_expires() -> None:
    b = MailBench(replace(OPTIONS, message_expiry_s=100.0), levels=(0, 1, 0))
    b.run(3)
    b.post("hello")
    b.run(99)
    assert b.stages() == ["queued"]
    b.run(10)
    assert b.stages()[-1] == "expired"


def test_suppression_and_silence_keep_a_message() -> None:
    b = bench(service_s=10, answer_text=lambda _: [(0.2, Feedback(Outcome.SUPPRESSED))])
    b.post("hello")
    b.run(60)
    assert b.cycle.state is State.SUPPRESSED
    assert len(b.texts) == 1
    b.answer_text = sent
    b.say(Feedback(Outcome.OK, "TXA", inhibited=False))
    b.run(60)
    assert b.stages()[-1] == "sent"


def test_the_line_that_goes_away_may_have_taken_a_message_with_it() -> None:
    b = bench(service_s=10, answer_text=lambda _: [])
    b.post("hello")
    b.run(8.5)
    assert b.cycle.state is State.AWAIT_MESSAGE
    b.do(b.cycle.closed(b.t_ns))
    b.answer_text = sent
    b.run(20)
    b.do(b.cycle.opened(b.t_ns))
    b.run(60)
    assert b.stages()[-1] == "sent"
    assert len(b.texts) == 2


# --------------------------------------------------------------------------- what is not queued


def refusal(b: MailBench, text: str, **given: str) -> MessageRefusedError:
    with pytest.raises(MessageRefusedError) as error:
        b.post(text, **given)
    assert b.cycle.counters[error.value.counter] == 1
    return error.value


@pytest.mark.parametrize(("level", "longest"), [(1, 12), (2, 44), (3, 71), (4, 105)])
def test_the_level_of_the_card_bounds_a_message(level: int, longest: int) -> None:
    b = bench(level=level)
    b.post("x" * longest)
    assert refusal(b, "x" * (longest + 1), key="b").counter == "message_too_long"


def test_a_card_of_level_0_sends_nothing_and_says_so() -> None:
    b = bench(level=0)
    assert "level, 0, allows no message" in str(refusal(b, "x"))
    assert b.cycle.counters["message_forbidden"] == 1


def test_before_the_card_is_known_a_text_waits_and_ends_by_the_card() -> None:
    b = MailBench(OPTIONS, level=0)
    b.post("x")
    b.post("y" * 200, key="b")
    b.run(70)
    assert (b.stages()[-1], b.stages("b")[-1]) == ("forbidden", "forbidden")
    c = MailBench(OPTIONS, level=1)
    c.post("y" * 200)
    c.run(70)
    assert c.stages()[-1] == "too_long"


def test_a_full_queue_a_known_id_and_a_terminal_that_is_only_read_refuse() -> None:
    b = bench()
    for n in range(MOST_WAITING):
        b.post("x", key=str(n))
    assert refusal(b, "x", key="more").counter == "message_queue_full"
    assert refusal(b, "x", key="5").counter == "message_known"
    silent = MailBench(replace(OPTIONS, transmit=False))
    silent.run(3)
    assert refusal(silent, "x").counter == "message_read_only"


# --------------------------------------------------------------------------- whatever happens

feedbacks = st.builds(
    Feedback,
    outcome=st.sampled_from(Outcome),
    command=st.sampled_from((None, "DWSQ", "TXSQ", "TXA", "XTZJ")),
    wait_s=st.sampled_from((None, 0.0, 5.0, 37.0)),
)
texts = st.builds(
    Text,
    sender=st.sampled_from((0, OTHER, USER)),
    payload=st.one_of(
        st.binary(max_size=40),
        st.binary(max_size=40).map(lambda b: b"\xa4" + b),
        st.just(encode_bytes(encode_envelope(REPORT, encode_report(HERE))).payload),
        st.just(asking(9, b"abc").payload),
    ),
    encoding=st.sampled_from(("chinese", "code", "mixed")),
    user=st.sampled_from((0, OTHER, USER)),
    crc_ok=st.booleans(),
)
replies = st.one_of(feedbacks, texts, st.just(FIX), st.just(SENT))


@given(
    script=st.lists(
        st.tuples(
            st.integers(0, 30),
            st.one_of(replies, st.sampled_from(("close", "open", "text", "asks", "report"))),
        ),
        max_size=25,
    ),
    answers=st.lists(
        st.lists(st.tuples(st.sampled_from((0.2, 1.2, 4.0, 12.0)), replies), max_size=2),
        min_size=1,
        max_size=5,
    ),
    service=st.sampled_from((1, 10, 60)),
    level=st.integers(0, 4),
)
@settings(max_examples=150, deadline=None)
def test_whatever_a_terminal_does_every_message_ends_and_the_card_is_kept(
    script: list[tuple[int, Message | str]],
    answers: list[list[tuple[float, Message]]],
    service: int,
    level: int,
) -> None:
    turns = itertools.cycle(answers)
    b = MailBench(
        replace(OPTIONS, message_expiry_s=1200.0),
        service_s=service,
        level=level,
        answer=lambda _: next(turns),
        answer_text=lambda _: next(turns),
    )
    posted: set[str] = set()
    for n, (delay, event) in enumerate(script):
        b.run(delay)
        match event:
            case "close":
                b.do(b.cycle.closed(b.t_ns))
            case "open" if b.cycle.state is State.CLOSED:
                b.do(b.cycle.opened(b.t_ns))
            case "text" | "asks" | "report":
                try:
                    if event == "report":
                        b.cycle.post_report(str(n), OTHER, HERE, b.t_ns)
                    else:
                        b.cycle.post_text(str(n), OTHER, "hello", event == "asks", b.t_ns)
                except MessageRefusedError:
                    continue
                posted.add(str(n))
            case str():
                pass
            case _:
                b.say(event)
    b.t_ns += 1300 * SECOND
    for _ in range(3):  # what is in flight, then what has expired, then what that made room for
        b.do(b.cycle.tick(b.t_ns))
    last = {c.message.key: c for c in b.changes}
    assert posted <= last.keys()
    for change in last.values():
        over = change.stage in ENDS or (change.stage == "sent" and not change.message.receipted)
        assert over
    times = [t for t, _ in b.bursts]
    assert all(y - x >= service for x, y in itertools.pairwise(times))
