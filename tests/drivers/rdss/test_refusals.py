"""What the RDSS request cycle does when the terminal refuses, falls short, or may not transmit."""

from __future__ import annotations

import itertools

import pytest

from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    Feedback,
    Outcome,
    SelfTest,
    SelfTestRequest,
)
from drivers.rdss.state_tables import State
from tests.drivers.rdss.bench import FIX, USER, Bench, good, refuse, say


@pytest.mark.parametrize(
    ("outcome", "counter"),
    [
        (Outcome.FAILED, "refused"),
        (Outcome.OTHER, "refused_other"),
        (Outcome.FREQUENCY, "refused_frequency"),
    ],
)
def test_refused_goes_on_at_normal_cadence(outcome: Outcome, counter: str) -> None:
    bench = Bench(answer=refuse(outcome))
    bench.run(130)
    assert bench.cycle.counters[counter] == len(bench.requests) == 3
    assert bench.cycle.counters["timeout_feedback"] == 0


@pytest.mark.parametrize(
    ("stated", "earliest"), [(90.0, 91), (None, 61), (100000.0, 61), (5.0, 60.1)]
)
def test_refused_by_frequency_waits(stated: float | None, earliest: float) -> None:
    bench = Bench(answer=refuse(Outcome.FREQUENCY, stated))
    bench.run(3)
    bench.answer = good
    bench.run(100)
    (first, _), (second, _) = bench.requests[:2]
    assert earliest - 1e-6 <= second - first < earliest + 2


@pytest.mark.parametrize("outcome", [Outcome.NOT_LOCKED, Outcome.NOT_SENT])
def test_no_lock_polls_beams_every_5_s(outcome: Outcome) -> None:
    bench = Bench(answer=refuse(outcome))
    bench.run(2)
    assert bench.cycle.state is State.NO_BEAM
    bench.levels, bench.answer = (0, 1, 0, 0, 0, 0), good
    start = bench.t
    bench.run(100)
    polls = [t for t, m in bench.sent if isinstance(m, BeamPowerRequest) and t > start]
    assert len(polls) == 20
    assert all(b - a == pytest.approx(5) for a, b in itertools.pairwise(polls))
    assert len(bench.requests) == 1
    assert bench.cycle.detail == "No beam (strongest level 1); asking again every 5 s"
    assert bench.notices.count("rdss_no_beam") == 1
    bench.levels = (0, 2, 0, 0, 0, 0)
    bench.run(10)
    assert len(bench.requests) == 2
    assert "rdss_beam" in bench.notices


def test_no_request_without_a_beam_from_the_start() -> None:
    bench = Bench(levels=(1, 1, 0, 0, 0, 0))
    bench.run(100)
    assert bench.requests == []
    assert bench.cycle.counters["no_beam"] == 1


def test_empty_levels_in_the_self_test_do_not_end_the_beam() -> None:
    bench = Bench()
    bench.run(30)
    states = []
    for message in (SelfTest(80.0, levels=(0,) * 6), BeamPower((0,) * 6)):
        bench.say(message)
        bench.run(1)
        states.append(bench.cycle.state)
    assert states == [State.READY, State.NO_BEAM]


def test_a_terminal_that_never_tells_its_beams_is_used_all_the_same() -> None:
    bench = Bench(answers_beams=False)
    bench.run(30)
    assert bench.cycle.counters["beams_unknown"] == 1
    assert bench.fixes


def test_low_battery_alarms_and_backs_off_60_s() -> None:
    bench = Bench(service_s=10, answer=refuse(Outcome.LOW_BATTERY))
    bench.run(200)
    times = [t for t, _ in bench.requests]
    assert len(times) == 4
    assert all(b - a >= 60 - 1e-6 for a, b in itertools.pairwise(times))
    assert "rdss_low_battery" in bench.notices
    assert bench.cycle.detail.startswith("battery low: next attempt in")


@pytest.mark.parametrize(
    ("outcome", "counter"),
    [(Outcome.ENCRYPTION, "encryption_error"), (Outcome.CRC, "crc_error")],
)
def test_encryption_and_crc_get_one_retry_then_an_alarm(outcome: Outcome, counter: str) -> None:
    bench = Bench(service_s=10, answer=refuse(outcome))
    bench.run(5)
    assert f"rdss_{counter}" not in bench.notices
    bench.run(20)
    assert len(bench.requests) == 2
    assert bench.cycle.state is State.HOLDING
    bench.run(200)
    assert bench.notices.count(f"rdss_{counter}") == 1
    assert len(bench.requests) == 5


def test_no_permission_alarms_at_once() -> None:
    bench = Bench(answer=refuse(Outcome.NO_PERMISSION))
    bench.run(5)
    assert "rdss_no_permission" in bench.notices
    assert bench.cycle.state is State.HOLDING


def test_suppressed_only_reads_and_tries_again_after_the_hold() -> None:
    bench = Bench(service_s=10, answer=refuse(Outcome.SUPPRESSED))
    bench.run(599)
    assert len(bench.requests) == 1
    assert bench.cycle.state is State.SUPPRESSED
    assert any(isinstance(m, SelfTestRequest) for t, m in bench.sent if t > 30)
    assert "refused" in bench.cycle.request_now(bench.t_ns).text
    bench.run(10)
    assert len(bench.requests) == 2
    assert bench.notices.count("rdss_suppressed") == 2


@pytest.mark.parametrize(
    "lift",
    [
        Feedback(Outcome.SILENCE_OR_LIFTED, code=8),
        Feedback(Outcome.OK, "DWA", inhibited=False),
    ],
)
def test_suppression_ends_with_the_lifted_notice(lift: Feedback) -> None:
    bench = Bench(service_s=10, answer=refuse(Outcome.SUPPRESSED))
    bench.run(100)
    bench.answer = good
    bench.say(lift)
    bench.run(5)
    assert len(bench.requests) == 2
    assert bench.fixes
    assert "rdss_lifted" in bench.notices


def test_the_feedback_of_the_request_before_does_not_lift() -> None:
    late = (0.5, Feedback(Outcome.OK, "DWA", inhibited=False))
    suppressed = (0.2, Feedback(Outcome.SUPPRESSED, code=1, inhibited=True))
    bench = Bench(service_s=1, answer=say(suppressed, late))
    bench.run(100)
    assert len(bench.requests) == 1


@pytest.mark.parametrize("outcome", [Outcome.SILENCE, Outcome.SILENCE_OR_LIFTED])
def test_radio_silence_is_never_broken_nor_lifted(outcome: Outcome) -> None:
    bench = Bench(service_s=10, answer=refuse(outcome))
    bench.run(5000)
    assert len(bench.requests) == 1
    assert bench.cycle.state is State.SILENT
    assert "refused" in bench.cycle.request_now(bench.t_ns).text
    bench.run(100)
    bench.do(bench.cycle.closed(bench.t_ns))
    bench.do(bench.cycle.opened(bench.t_ns))
    bench.run(100)
    assert len(bench.requests) == 1
    assert bench.cycle.state is State.SILENT
    bench.answer = good
    bench.say(Feedback(Outcome.OK, "JMS", inhibited=False))
    bench.run(5)
    assert len(bench.requests) == 2


def test_end_of_silence_is_seen_in_the_inbound_state() -> None:
    bench = Bench(service_s=10)
    bench.run(30)
    bench.inbound = 0
    bench.answer = refuse(Outcome.SILENCE)
    bench.run(200)
    assert bench.cycle.state is State.SILENT
    count = len(bench.requests)
    bench.inbound, bench.answer = 2, good
    bench.run(100)
    assert len(bench.requests) > count


def test_no_card_asks_for_one_and_starts_when_it_comes() -> None:
    bench = Bench(user=0)
    bench.run(60)
    assert bench.requests == []
    assert bench.cycle.state is State.NO_CARD
    bench.user = USER
    bench.run(15)
    assert bench.fixes
    bench.user = 0
    bench.say(Feedback(Outcome.NO_CARD, code=5))
    bench.run(100)
    assert len(bench.requests) == 1


def test_no_feedback_and_no_fix_time_out_and_the_cycle_goes_on() -> None:
    bench = Bench(answer=say())
    bench.run(5)
    assert bench.cycle.counters["timeout_feedback"] == 1
    assert bench.cycle.state is State.AWAIT_FIX
    bench.run(200)
    assert bench.cycle.counters["timeout_fix"] == len(bench.requests) == 4
    assert bench.notices.count("rdss_no_fixes") == 1


def test_a_fix_without_feedback_counts() -> None:
    bench = Bench(answer=say((1.5, FIX)))
    bench.run(20)
    assert bench.cycle.counters["fixes"] == 1
    assert bench.cycle.counters["timeout_fix"] == 0
