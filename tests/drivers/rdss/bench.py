"""A scripted RDSS terminal, the request cycle against it, and a clock that the test owns."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import pytest

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    Family,
    Feedback,
    Fix,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    PositionRequest,
    SelfTest,
    SelfTestRequest,
    TextRequest,
)
from drivers.rdss.request_state_machine import Terminal
from drivers.rdss.state_tables import (
    SECOND,
    Action,
    FixReady,
    Notice,
    Send,
    SetBaud,
    TerminalOptions,
)

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
                    assert (kind == "request") == isinstance(message, PositionRequest | TextRequest)
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
                service_s = self.service_s if self.user else 0
                replies = [(0.1, Identity(self.user, service_s, comm_level=3))]
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
