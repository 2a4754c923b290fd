"""The request cycle of an RDSS terminal: a state machine without I/O and without a clock.

The state is in `request_cycle_state`; `message_effects` changes it by the terminal's messages.
Inputs: `opened`, `closed`, `received`, `tick`, each with the host's monotonic clock in ns. Outputs:
the actions they return, and `next_deadline_ns`, when to call `tick` next. Only `tick` sends.

    PROBING ──identity──► CHECKING ──beam >= 2──► READY ──► AWAIT_FEEDBACK ──► AWAIT_FIX ──► READY
                 │              │                    └────► AWAIT_MESSAGE ──► READY
                 │ no card      │ none                         │ refused
                 ▼              ▼                              ▼
              NO_CARD        NO_BEAM            NO_BEAM, HOLDING, SUPPRESSED, SILENT, READY

Never sent are a lift of radio silence and an emergency request. A request or a message is not sent
while another is in flight, before the card's service interval has passed since the previous one,
while the terminal is suppressed or silent, or without the option `transmit`. An overdue fix holds
up the next request, until it is given up, but no message. If a request and a message both wait,
`outbox.StrideScheduler` decides. Figures: PROTOCOLS 1.1 and 1.5.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from drivers.rdss.deadline_actions import DeadlineActions
from drivers.rdss.inbox import Inbox
from drivers.rdss.mail import MessageRefusedError
from drivers.rdss.message_effects import MessageEffects
from drivers.rdss.messages import (
    BeamPower,
    Family,
    Feedback,
    Fix,
    Identity,
    Message,
    Reply,
    Text,
)
from drivers.rdss.outbox import Outbox
from drivers.rdss.position_report_coding import PositionReport
from drivers.rdss.request_cycle_state import RequestCycleState
from drivers.rdss.request_height import HeightSource
from drivers.rdss.state_tables import (
    DETAIL,
    FIX_EXPECTED_NS,
    NEVER_NS,
    READ_ONLY_DETAIL,
    SECOND,
    Action,
    Notice,
    State,
    TerminalOptions,
)


class Terminal:
    """State machine of one terminal: see the module. `state`, `detail` (in words) and `counters`
    show its activity.

    Counters: `requested`, `accepted`, `fixes`, `late_fix` (after giving up, still used),
    `slow_fix` (over 5 s), `multi_value` (handed on, marked); refused `foreign_fix`, `unsolicited`;
    `timeout_feedback`, `timeout_fix`; one for each refusal: `refused`, `refused_other`,
    `refused_frequency`, `no_beam`, `not_sent`, `encryption_error`, `crc_error`, `no_permission`,
    `low_battery`, `suppressed`, `silence`, `no_card`; `feedback_unmatched`, `bad_fraction`,
    `height_implausible`, `beams_unknown`, `probes`, `echo`, `before_identity`.

    Of messages: `messages_queued`, `messages_written`, `messages_sent`, `messages_refused`,
    `messages_received`, `message_<stage>` for each end, `message_<fault>` for what came faulty,
    `message_repeated`; `timeout_message` (no feedback), `late_feedback`, `timeout_receipt`,
    `receipt_unmatched`, `receipt_waiting`, `receipt_queue_full`, `receipt_forbidden`, and the
    refusals above; refused before they were queued: `message_queue_full`, `message_known`,
    `message_read_only`.
    """

    def __init__(self, options: TerminalOptions, counters: Counter[str] | None = None) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._options = options
        self._session = RequestCycleState(options, self.counters)
        self._replies = MessageEffects(self._session)
        self.height = HeightSource(options)
        self._t_ns = 0
        self._deadlines = DeadlineActions(options, self._session, self.height, self.counters)

    # ------------------------------------------------------------------ inputs

    def opened(self, t_ns: int) -> list[Action]:
        """Note that the line is open, and probe for a terminal."""
        self._t_ns = t_ns
        self._session.search(t_ns)
        return []

    def closed(self, t_ns: int) -> list[Action]:
        """Note that the line is gone. Spacing, suppression and silence stay in force."""
        self._t_ns = t_ns
        self._session.abandon()
        self._session.enter(State.CLOSED, None)
        return []

    def received(self, message: Message, t_ns: int, family: Family) -> list[Action]:
        """Process a message that the codec of `family` decoded."""
        self._t_ns = t_ns
        if isinstance(message, Reply) and not isinstance(message, Feedback | Fix | Text):
            self._deadlines.quiet_until_ns = min(self._deadlines.quiet_until_ns, t_ns)
        return self._replies.take(message, t_ns, family)

    def tick(self, t_ns: int) -> list[Action]:
        """Execute due actions. Call at `next_deadline_ns` or at any other time."""
        session = self._session
        self._t_ns = t_ns
        self.outbox.settle(t_ns)
        actions: list[Action] = []
        for _ in State:  # each state passes to the next at most once in a call
            due = self.next_deadline_ns
            if due is None or t_ns < due:
                break
            if self._gone_quiet(t_ns):
                actions.append(
                    Notice("rdss_silent", f"No valid message for {self._options.timeout_s:g} s")
                )
                session.abandon()
                session.search(t_ns)
            self._deadlines.due(t_ns, actions)
        return actions

    def request_now(self, t_ns: int) -> Notice:
        """Request a fix as soon as the card's spacing allows; return when, or why not, in words."""
        session = self._session
        self._t_ns = t_ns
        code = "rdss_request"
        if session.fix_awaited:
            return Notice(code, "a request is in flight already")
        if session.state not in (State.READY, State.AWAIT_MESSAGE) or not self._options.transmit:
            return Notice(code, f"refused: {self.detail}")
        session.pace.asap = True
        return Notice(code, f"request in {self._seconds_to(session.pace.due_ns)} s")

    def post_text(self, key: str, receiver: int, text: str, receipt: bool, t_ns: int) -> None:
        """Queue a text for a card. Raises `MessageRefusedError`."""
        self._post(lambda: self.outbox.post_text(key, receiver, text, receipt, t_ns))

    def post_report(self, key: str, receiver: int, report: PositionReport, t_ns: int) -> None:
        """Queue a position report for a card. Raises `MessageRefusedError`."""
        self._post(lambda: self.outbox.post_report(key, receiver, report, t_ns))

    def _post(self, post: Callable[[], None]) -> None:
        try:
            if not self._options.transmit:
                raise MessageRefusedError("message_read_only", "transmit = false: it is only read")
            post()
        except MessageRefusedError as error:
            self.counters[error.counter] += 1
            raise

    # ------------------------------------------------------------------ outputs

    @property
    def outbox(self) -> Outbox:
        """Waiting messages."""
        return self._session.outbox

    @property
    def inbox(self) -> Inbox:
        """Inbox of received messages."""
        return self._replies.inbox

    @property
    def beams(self) -> BeamPower | None:
        """Last reading of the beams, with their levels."""
        return self._session.beams_said

    @property
    def next_deadline_ns(self) -> int | None:
        """Instant of the next `tick`; None while the line is closed."""
        session = self._session
        due = session.deadline_ns
        if session.state is State.READY:
            due = session.next_poll_ns
            if self._options.transmit:
                due = min(due, session.pace.due_ns, self._message_ns())
            due = max(due, self._deadlines.quiet_until_ns)
        elif session.state is State.AWAIT_FIX and due is not None:
            overdue_ns = (session.pace.requested_ns or 0) + FIX_EXPECTED_NS
            due = min(due, max(overdue_ns, self._message_ns()))
        if due is not None and session.answered:
            due = min(due, session.received_ns + int(self._options.timeout_s * SECOND))
        return due

    def _message_ns(self) -> int:
        """Instant from which the next message may be written."""
        session = self._session
        if session.outbox.next_ns is None:
            return NEVER_NS
        return max(session.pace.free_ns, session.outbox.next_ns)

    @property
    def state(self) -> State:
        """State in the cycle; CLOSED at first."""
        return self._session.state

    @property
    def family(self) -> Family | None:
        """Family of the terminal that last replied."""
        return self._session.family

    @property
    def identity(self) -> Identity | None:
        """The card read last."""
        return self._session.identity

    @property
    def answered(self) -> bool:
        """True if a terminal of a known family has replied."""
        return self._session.answered

    @property
    def unanswered_round(self) -> bool:
        """True if every baud rate was probed without a reply."""
        return self._session.state is State.PROBING and self._session.probe.in_vain

    @property
    def baud(self) -> int:
        """The rate in use or being tried."""
        return self._session.probe.baud

    @property
    def detail(self) -> str:
        """Present activity, in words."""
        session = self._session
        waiting = len(session.outbox.waiting)
        words = DETAIL[session.state]
        if session.state is State.READY and not self._options.transmit:
            words = READ_ONLY_DETAIL
        return words.format(
            baud=self.baud,
            families=" and ".join(self._options.families),
            card=f"{session.identity.user:07d}" if session.identity is not None else "none",
            service=session.pace.service_s,
            beams=session.beams,
            waiting=f", messages waiting: {waiting}" if waiting else "",
            due=self._seconds_to(session.pace.due_ns),
            age=self._seconds_since(session.pace.requested_ns),
            why=session.hold_why,
            hold=self._seconds_to(session.blocked_until_ns or 0),
        )

    def _seconds_to(self, t_ns: int) -> int:
        return max(0, -((self._t_ns - t_ns) // SECOND))

    def _seconds_since(self, t_ns: int | None) -> int:
        return 0 if t_ns is None else (self._t_ns - t_ns) // SECOND

    def _gone_quiet(self, t_ns: int) -> bool:
        quiet_ns = int(self._options.timeout_s * SECOND)
        return self._session.answered and t_ns - self._session.received_ns >= quiet_ns
