"""Whatever a terminal says, the RDSS request cycle keeps the rules of the radio."""

from __future__ import annotations

import itertools
from contextlib import suppress

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.rdss.mail import MessageRefusedError
from drivers.rdss.messages import (
    BeamPower,
    Family,
    Feedback,
    Fix,
    Identity,
    Message,
    Outcome,
    PositionRequest,
    SelfTest,
    TextRequest,
)
from drivers.rdss.state_tables import State
from tests.drivers.rdss.bench import FIX, OK, USER, Bench


class Referee(Bench):
    """Holds every request against the radio rules, by what has been said on the line alone."""

    def __post_init__(self) -> None:
        self.card_s = 0
        self.asked_s: float | None = None
        self.settled = True
        self.forbidden = False
        self.texted = False
        self.fix_asked_s: float | None = None
        super().__post_init__()

    def watch(self, message: Message) -> None:
        if isinstance(message, Identity) and message.user and self.cycle.state is not State.CLOSED:
            self.card_s = message.service_frequency_s or 60
        if not self.cycle.answered:
            return
        match message:
            case Fix():
                self.fix_asked_s = None
                self.settled = self.settled or not self.texted
            case Feedback(outcome=Outcome.SUPPRESSED | Outcome.SILENCE):
                self.settled = self.forbidden = True
                self.fix_asked_s = None
            case Feedback(outcome=Outcome.SILENCE_OR_LIFTED) | SelfTest():
                self.settled, self.forbidden = True, False  # may lift: no verdict
                self.fix_asked_s = None
            case Feedback(inhibited=False):
                self.settled, self.forbidden = True, False
                self.fix_asked_s = None
            case Feedback(outcome=outcome) if outcome is not Outcome.OK or self.texted:
                self.settled = True
                if not self.texted:
                    self.fix_asked_s = None

    def hear(self, message: Message, family: Family) -> None:
        if isinstance(message, PositionRequest | TextRequest):
            assert self.card_s, "a request before the card was read"
            assert not self.forbidden, "a request while suppressed or silent"
            if self.asked_s is not None:
                apart = self.t - self.asked_s
                assert apart >= self.card_s - 1e-6, "closer than the card allows"
                texting = isinstance(message, TextRequest)
                patience_s = 3 if self.texted else 5 if texting else 10
                assert self.settled or apart >= patience_s - 1e-6, "two requests in flight"
                if not texting and self.fix_asked_s is not None:
                    assert self.t - self.fix_asked_s >= 10 - 1e-6, "two fixes in flight"
            self.asked_s, self.settled = self.t, False
            self.texted = isinstance(message, TextRequest)
            if not self.texted:
                self.fix_asked_s = self.t
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
    st.just(Identity(USER, 10, comm_level=4)),
)
doings = st.sampled_from(("close", "open", "ask", "text"))


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
            case "text":
                with suppress(MessageRefusedError):
                    bench.cycle.post_text(str(bench.t_ns), 242407, "hello", False, bench.t_ns)
            case str():
                pass
            case _:
                bench.say(event)
    bench.run(30)
