"""The RDSS request cycle against a scripted terminal and a clock that the test owns."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.cycle import (
    SECOND,
    Action,
    FixReady,
    Notice,
    Send,
    SetBaud,
    State,
    TerminalOptions,
)
from drivers.rdss.fraction import FractionReader
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    Family,
    Feedback,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
)
from drivers.rdss.terminal import Terminal

USER = 242286
FIX = Fix(USER, 31776.0, 23.0, 113.0, 14.0, fraction=50)
OK = Feedback(Outcome.OK, "DWSQ", user=USER)

Answer = Callable[[PositionRequest], Iterable[tuple[float, Message]]]


def good(request: PositionRequest) -> Iterable[tuple[float, Message]]:
    return [(0.2, OK), (1.2, FIX)]


def say(*replies: tuple[float, Message]) -> Answer:
    return lambda request: replies


def refuse(outcome: Outcome, wait_s: float | None = None) -> Answer:
    return say((0.2, Feedback(outcome, "DWSQ", wait_s)))


@dataclass
class Bench:
    """A terminal, its state machine and the clock between them."""

    options: TerminalOptions = TerminalOptions(bauds=(115200,), families=("4.0",))  # noqa: RUF009
    service_s: int = 60
    family: Family = "4.0"
    baud: int = 115200
    user: int = USER
    levels: tuple[int, ...] = (0, 3, 4, 0, 2, 0)
    inbound: int = 2
    answer: Answer = good
    answers_beams: bool = True
    mute: bool = False
    t_ns: int = 5 * SECOND
    sent: list[tuple[float, Message]] = field(default_factory=list)
    fixes: list[tuple[float, FixReady]] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    due: list[tuple[int, Message]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.cycle = Terminal(self.options)
        self.line_baud = self.options.bauds[0]
        self.do(self.cycle.opened(self.t_ns))

    @property
    def t(self) -> float:
        return self.t_ns / SECOND

    @property
    def requests(self) -> list[tuple[float, PositionRequest]]:
        return [(t, m) for t, m in self.sent if isinstance(m, PositionRequest)]

    def do(self, actions: list[Action]) -> None:
        for action in actions:
            match action:
                case Send(data, kind):
                    module = binary_4_0 if data[5] == 0 else text_2_1
                    (message,) = module.Decoder().feed(data)
                    assert (kind == "request") == isinstance(message, PositionRequest)
                    self.sent.append((self.t, message))
                    if self.line_baud == self.baud and not self.mute:
                        self.hear(message, "4.0" if module is binary_4_0 else "2.1")
                case SetBaud(baud):
                    self.line_baud = baud
                case FixReady():
                    self.fixes.append((self.t, action))
                case Notice(code, _):
                    self.notices.append(code)

    def hear(self, message: Message, family: Family) -> None:
        if family != self.family:
            return
        replies: Iterable[tuple[float, Message]] = ()
        match message:
            case IdentityRequest():
                replies = [(0.1, Identity(self.user, self.service_s if self.user else 0))]
            case BeamPowerRequest() if self.answers_beams:
                replies = [(0.1, BeamPower(self.levels, self.user))]
            case SelfTestRequest():
                replies = [(0.1, SelfTest(80.0, user=self.user, inbound_state=self.inbound))]
            case PositionRequest():
                replies = self.answer(message)
        for delay, reply in replies:
            self.say(reply, delay)

    def watch(self, message: Message) -> None:
        """What a test may want to know of every message before the state machine has it."""

    def say(self, message: Message, delay_s: float = 0.0) -> None:
        self.due.append((self.t_ns + round(delay_s * SECOND), message))

    def run(self, seconds: float) -> None:
        end = self.t_ns + round(seconds * SECOND)
        for _ in range(100_000):
            deadline = self.cycle.next_deadline_ns
            events = [t for t, _ in self.due] + ([deadline] if deadline is not None else [])
            at = min(events, default=end + 1)
            if at > end:
                break
            self.t_ns = max(self.t_ns, at)
            ready = sorted((d for d in self.due if d[0] <= self.t_ns), key=lambda d: d[0])
            self.due = [d for d in self.due if d[0] > self.t_ns]
            for _, message in ready:
                self.watch(message)
                self.do(self.cycle.received(message, self.t_ns, self.family))
            self.do(self.cycle.tick(self.t_ns))
            assert (self.cycle.next_deadline_ns or self.t_ns + 1) > self.t_ns, "a deadline stuck"
        else:
            pytest.fail("the state machine spins")
        self.t_ns = end


# --------------------------------------------------------------------------- finding the terminal


@pytest.mark.parametrize("family", ["4.0", "2.1"])
@pytest.mark.parametrize("baud", [115200, 19200, 9600])
def test_family_and_baud_are_found(family: Family, baud: int) -> None:
    bench = Bench(TerminalOptions(), family=family, baud=baud)
    bench.run(15)
    assert bench.cycle.family == family
    assert bench.line_baud == baud
    assert bench.cycle.identity is not None
    assert "rdss_card" in bench.notices
    assert bench.requests
    first = [type(m) for _, m in bench.sent]
    assert first.index(PositionRequest) > first.index(BeamPowerRequest)


def test_nobody_answers_is_said_once_and_asked_for_ever() -> None:
    bench = Bench(TerminalOptions(), mute=True)
    bench.run(60)
    assert bench.notices == ["rdss_no_answer"]
    assert bench.cycle.unanswered_round
    assert bench.cycle.counters["probes"] == 21
    assert {type(m) for _, m in bench.sent} == {IdentityRequest}
    bench.mute = False
    bench.run(20)
    assert bench.fixes


def test_a_terminal_that_falls_silent_is_looked_for_again() -> None:
    bench = Bench()
    bench.run(30)
    bench.mute = True
    bench.run(60)
    assert "rdss_silent" in bench.notices
    assert bench.cycle.state is State.PROBING
    bench.mute = False
    before = len(bench.requests)
    bench.run(70)
    assert bench.cycle.answered
    assert len(bench.requests) > before


# --------------------------------------------------------------------------- the regular cycle


def test_regular_cycle_keeps_the_cards_spacing() -> None:
    bench = Bench()
    bench.run(400)
    times = [t for t, _ in bench.requests]
    assert len(times) == 7
    assert all(b - a >= 61 - 1e-6 for a, b in itertools.pairwise(times))
    assert max(b - a for a, b in itertools.pairwise(times)) < 63
    assert bench.cycle.counters["fixes"] == 7
    for (asked, _), (_, ready) in zip(bench.requests, bench.fixes, strict=False):
        assert ready.requested_ns == round(asked * SECOND)
        assert ready.time_of_day_s == pytest.approx(31776.5)
        assert ready.uncertainty_s == 0.005
    request = bench.requests[0][1]
    assert (request.user, request.period_s, request.emergency) == (USER, 0, False)


def test_wanted_interval_never_undercuts_the_card_and_an_operator_may_ask_earlier() -> None:
    bench = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), request_interval_s=300))
    bench.run(100)
    assert len(bench.requests) == 1
    bench.cycle.request_now(bench.t_ns)
    bench.run(20)
    assert len(bench.requests) == 2
    assert bench.cycle.request_now(bench.t_ns).text.startswith("request in 4")
    bench.run(60)
    assert len(bench.requests) == 3
    assert bench.requests[2][0] - bench.requests[1][0] >= 61 - 1e-6
    fast = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), request_interval_s=1))
    fast.run(100)
    assert len(fast.requests) == 2


def test_spacing_survives_a_replug() -> None:
    bench = Bench()
    bench.run(5)
    for _ in range(5):
        bench.do(bench.cycle.closed(bench.t_ns))
        bench.run(1)
        bench.do(bench.cycle.opened(bench.t_ns))
        bench.run(5)
    assert len(bench.requests) == 1
    bench.run(60)
    assert len(bench.requests) == 2


# --------------------------------------------------------------------------- height


def test_height_given_from_solution_config_or_terrain() -> None:
    bench = Bench(
        TerminalOptions(bauds=(115200,), families=("4.0",), antenna_height_m=2.5), service_s=9
    )
    bench.run(5)
    assert bench.requests[-1][1].height_mode is HeightMode.NONE
    assert bench.requests[-1][1].antenna_height_m == 2.5
    for height, sd, mode in [
        (438.4, 3.0, HeightMode.GIVEN),
        (438.4, 10.0, HeightMode.NONE),
        (float("nan"), 1.0, HeightMode.NONE),
        (438.4, float("nan"), HeightMode.NONE),
        (90000.0, 1.0, HeightMode.NONE),
    ]:
        count = len(bench.requests)
        while len(bench.requests) == count:
            bench.cycle.height_hint(height, sd, bench.t_ns)
            bench.run(1)
        assert bench.requests[-1][1].height_mode is mode
    bench.cycle.height_hint(438.4, 3.0, bench.t_ns)
    bench.run(9)
    bench.run(9)
    assert bench.requests[-1][1].height_mode is HeightMode.NONE, "a stale hint was used"

    ship = Bench(TerminalOptions(bauds=(115200,), families=("4.0",), height_m=17.0))
    ship.run(5)
    assert ship.requests[0][1] == PositionRequest(USER, HeightMode.GIVEN, height_m=17.0)
    own = TerminalOptions(bauds=(115200,), families=("4.0",), use_solution_height=False)
    terrain = Bench(own)
    terrain.cycle.height_hint(438.0, 1.0, terrain.t_ns)
    terrain.run(5)
    assert terrain.requests[0][1].height_mode is HeightMode.NONE


# --------------------------------------------------------------------------- failure table


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
    ("stated", "earliest"), [(90.0, 91), (None, 61), (100000.0, 61), (5.0, 61)]
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
    assert bench.cycle.detail == "no beam: strongest level 1, polling every 5 s"
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


# --------------------------------------------------------------------------- which fixes


def test_late_fix_of_a_known_request_is_used_and_a_second_one_is_unsolicited() -> None:
    bench = Bench(answer=say((0.2, OK), (15.0, FIX), (16.0, FIX)))
    bench.run(30)
    ((_, ready),) = bench.fixes
    assert ready.requested_ns == round(bench.requests[0][0] * SECOND)
    counters = bench.cycle.counters
    assert (counters["timeout_fix"], counters["late_fix"], counters["unsolicited"]) == (1, 1, 1)
    assert counters["slow_fix"] == 1


def test_a_fix_of_a_refused_request_is_unsolicited() -> None:
    bench = Bench(answer=say((0.2, Feedback(Outcome.FAILED, "DWSQ")), (1.0, FIX)))
    bench.run(20)
    assert bench.fixes == []
    assert bench.cycle.counters["unsolicited"] == 1


@pytest.mark.parametrize(
    "foreign",
    [
        replace(FIX, kind="query", queried=5),
        replace(FIX, kind="report"),
        replace(FIX, user=USER + 1),
    ],
)
def test_foreign_fix_is_refused_by_name(foreign: Fix) -> None:
    bench = Bench(answer=say((0.2, OK), (1.0, foreign), (1.5, FIX)))
    bench.run(20)
    assert bench.cycle.counters["foreign_fix"] == 1
    assert [ready.fix for _, ready in bench.fixes] == [FIX]


def test_multi_value_fix_is_handed_on_marked() -> None:
    bench = Bench(answer=say((0.2, OK), (1.0, replace(FIX, multi_value=True))))
    bench.run(20)
    assert [ready.fix.multi_value for _, ready in bench.fixes] == [True]
    assert bench.cycle.counters["multi_value"] == 1


def test_anothers_message_uses_up_the_spacing() -> None:
    bench = Bench()
    bench.run(30)
    bench.say(Feedback(Outcome.OK, "TXSQ"))
    bench.run(120)
    assert bench.requests[1][0] - 35 >= 61 - 1e-6


def test_an_echo_of_our_own_bytes_is_no_answer() -> None:
    bench = Bench(mute=True)
    bench.say(IdentityRequest(), 1.0)
    bench.say(PositionRequest(), 1.0)
    bench.run(10)
    assert bench.cycle.counters["echo"] == 2
    assert not bench.cycle.answered


# --------------------------------------------------------------------------- fraction of T


def test_fraction_of_t() -> None:
    auto = FractionReader("auto")
    low, bound = auto.read(8)
    assert low - bound == pytest.approx(0.08)
    assert low + bound == pytest.approx(0.8)
    assert auto.read(71) == pytest.approx((0.71, 0.005))
    assert auto.read(8) == pytest.approx((0.08, 0.005))
    assert FractionReader("0.1").read(8) == pytest.approx((0.8, 0.05))
    assert FractionReader("0.01").read(8) == pytest.approx((0.08, 0.005))
    for unit, value in (("0.1", 71), ("auto", 200), ("0.01", 100)):
        assert FractionReader(unit).read(value) == (0.5, 0.5)  # type: ignore[arg-type]


# --------------------------------------------------------------------------- safety, any terminal


class Referee(Bench):
    """Holds every request against the radio rules, by what has been said on the line alone."""

    def __post_init__(self) -> None:
        self.card_s = 0
        self.asked_s: float | None = None
        self.settled = True
        self.forbidden = False
        super().__post_init__()

    def watch(self, message: Message) -> None:
        if isinstance(message, Identity) and message.user and self.cycle.state is not State.CLOSED:
            self.card_s = message.service_frequency_s or 60
        if not self.cycle.answered:
            return
        match message:
            case Fix():
                self.settled = True
            case Feedback(outcome=Outcome.SUPPRESSED | Outcome.SILENCE):
                self.settled = self.forbidden = True
            case Feedback(outcome=Outcome.SILENCE_OR_LIFTED) | SelfTest():
                self.settled, self.forbidden = True, False  # may lift: no verdict
            case Feedback(inhibited=False):
                self.settled, self.forbidden = True, False
            case Feedback(outcome=outcome) if outcome is not Outcome.OK:
                self.settled = True

    def hear(self, message: Message, family: Family) -> None:
        if isinstance(message, PositionRequest):
            assert self.card_s, "a request before the card was read"
            assert not self.forbidden, "a request while suppressed or silent"
            if self.asked_s is not None:
                apart = self.t - self.asked_s
                assert apart >= self.card_s + 1 - 1e-6, "closer than the card allows"
                assert self.settled or apart >= 10 - 1e-6, "two requests in flight"
            self.asked_s, self.settled = self.t, False
        super().hear(message, family)


feedbacks = st.builds(
    Feedback,
    outcome=st.sampled_from(Outcome),
    command=st.sampled_from((None, "DWSQ", "TXSQ", "XTZJ")),
    wait_s=st.sampled_from((None, 0.0, 5.0, 37.0, 1e6)),
)
messages = st.one_of(
    feedbacks,
    st.just(FIX),
    st.just(OK),
    st.just(Feedback(Outcome.OK, "DWA", inhibited=False)),
    st.builds(BeamPower, levels=st.lists(st.integers(0, 4), max_size=6).map(tuple)),
    st.builds(SelfTest, battery_percent=st.just(50.0), inbound_state=st.integers(0, 3)),
    st.sampled_from((Identity(0, 0), Identity(USER, 60), Identity(USER, 1), Identity(USER, 0))),
)
doings = st.sampled_from(("close", "open", "ask"))


@given(
    script=st.lists(st.tuples(st.integers(0, 30), st.one_of(messages, doings)), max_size=20),
    answers=st.lists(
        st.lists(st.tuples(st.sampled_from((0.2, 1.2, 4.0, 12.0)), messages), max_size=2),
        min_size=1,
        max_size=5,
    ),
    service=st.sampled_from((1, 10, 60)),
)
@settings(max_examples=200, deadline=None)
def test_whatever_a_terminal_does_the_radio_rules_hold(
    script: list[tuple[int, Message | str]],
    answers: list[list[tuple[float, Message]]],
    service: int,
) -> None:
    """Never two requests in flight, never closer than the card allows, never while forbidden."""
    turns = itertools.cycle(answers)
    bench = Referee(service_s=service, answer=lambda _: next(turns))
    for delay, event in script:
        bench.run(delay)
        match event:
            case "close":
                bench.do(bench.cycle.closed(bench.t_ns))
            case "open" if bench.cycle.state is State.CLOSED:
                bench.do(bench.cycle.opened(bench.t_ns))
            case "ask":
                bench.cycle.request_now(bench.t_ns)
            case str():
                pass
            case _:
                bench.say(event)
    bench.run(30)
