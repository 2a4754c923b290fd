"""The request cycle of an RDSS terminal: a state machine without I/O and without a clock.

Inputs: `opened`, `closed`, `received`, `tick`, each with the host's monotonic clock in ns. Outputs:
the actions they return, and `next_deadline_ns`, when to call `tick` next. Only `tick` sends.

    PROBING ──identity──► CHECKING ──beam >= 2──► READY ──► AWAIT_FEEDBACK ──► AWAIT_FIX ──► READY
                 │ no card      │ none                         │ refused
                 ▼              ▼                              ▼
              NO_CARD        NO_BEAM            NO_BEAM, HOLDING, SUPPRESSED, SILENT, READY

What is never sent: a lift of radio silence, an emergency request, a request while another is in
flight, earlier than the card's service frequency and one second after the one before, or while
the terminal has said that it is suppressed or silent. Figures: PROTOCOLS 1.1 and 1.5.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from drivers.rdss.cycle import (
    ALWAYS,
    BEAM_ATTEMPTS,
    BEAM_POLL_NS,
    BEAMS_STALE_NS,
    DEFAULT_SERVICE_S,
    DETAIL,
    FEEDBACK_NS,
    FIX_EXPECTED_NS,
    GIVE_UP_NS,
    HOLD_NS,
    IN_FLIGHT,
    INBOUND_COMMANDS,
    OFFLINE,
    POLL_NS,
    POLL_REPLY_NS,
    POSITION_COMMANDS,
    PROBE_NS,
    REFUSALS,
    SECOND,
    TIMEOUTS_ALARM,
    USABLE_LEVEL,
    Action,
    FixReady,
    Notice,
    Send,
    State,
    TerminalOptions,
)
from drivers.rdss.fraction import FractionReader
from drivers.rdss.height import HeightSource
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    EncodeError,
    Family,
    Feedback,
    Fix,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    Request,
    SelfTest,
    SelfTestRequest,
    TimeRequest,
    Unknown,
)
from drivers.rdss.permit import Pace, TransmitPermit
from drivers.rdss.probe import ENCODE, Probe

_POLLS: tuple[Callable[[int], Request], ...] = (
    SelfTestRequest,
    BeamPowerRequest,
    TimeRequest,
    BeamPowerRequest,
    IdentityRequest,
    BeamPowerRequest,
)
_BLOCKED_POLLS: tuple[Callable[[int], Request], ...] = (SelfTestRequest, BeamPowerRequest)
"""While nothing may be transmitted: the self test may tell when that ends."""


class Terminal:
    """See the module. `state`, `detail` (in words) and `counters` say what it is doing.

    Counters: `requested`, `accepted`, `fixes`, `late_fix` (after giving up, still used),
    `slow_fix` (over 5 s), `multi_value` (handed on, marked); refused `foreign_fix`, `unsolicited`;
    `timeout_feedback`, `timeout_fix`; one for each refusal: `refused`, `refused_other`,
    `refused_frequency`, `no_beam`, `not_sent`, `encryption_error`, `crc_error`, `no_permission`,
    `low_battery`, `suppressed`, `silence`, `no_card`; `feedback_unmatched`, `bad_fraction`,
    `beams_unknown`, `probes`, `echo`, `before_identity`.
    """

    def __init__(self, options: TerminalOptions, counters: Counter[str] | None = None) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self.state = State.CLOSED
        self.family: Family | None = None
        self.identity: Identity | None = None
        self._options = options
        self._fraction = FractionReader(options.t_fraction)
        self._t_ns = 0
        self._deadline_ns: int | None = None
        self._heard_ns = 0
        self._probe = Probe(options.bauds, options.families)
        # reads
        self._polls = 0
        self._next_poll_ns = 0
        self._quiet_until_ns = 0
        self._levels: tuple[int, ...] = ()
        self._levels_ns: int | None = None
        self._beam_reads = 0
        self._faults: tuple[str, ...] = ()
        # requests
        self._pace = Pace(options.request_interval_s)
        self._answerable = False
        self._timeouts = 0
        self._refused: Counter[Outcome] = Counter()
        self._hold_why, self._hold_until_ns = "", 0
        self._height = HeightSource(options)
        self._permit = TransmitPermit(options.suppression_hold_s)

    # ------------------------------------------------------------------ inputs

    def opened(self, t_ns: int) -> list[Action]:
        """The line is open: look who is there."""
        self._t_ns = t_ns
        self._search(t_ns)
        return []

    def closed(self, t_ns: int) -> list[Action]:
        """The line is gone. Spacing, suppression and silence outlive it."""
        self._t_ns = t_ns
        self._abandon()
        self._enter(State.CLOSED, None)
        return []

    def received(self, message: Message, t_ns: int, family: Family) -> list[Action]:
        """A message that the codec of `family` decoded."""
        self._t_ns = t_ns
        actions: list[Action] = []
        if isinstance(message, Unknown) or self.state is State.CLOSED:
            return actions
        if isinstance(message, Request):
            self.counters["echo"] += 1
            return actions
        if self.state is State.PROBING and not isinstance(message, Identity):
            self.counters["before_identity"] += 1
            return actions
        self._heard_ns = t_ns
        match message:
            case Identity():
                self._on_identity(message, t_ns, family, actions)
            case BeamPower():
                self._on_levels(message.levels, t_ns, actions)
            case SelfTest():
                self._on_self_test(message, t_ns, actions)
            case Feedback():
                self._on_feedback(message, t_ns, actions)
            case Fix():
                self._on_fix(message, t_ns, actions)
            case _:
                pass
        return actions

    def tick(self, t_ns: int) -> list[Action]:
        """Do what is due. Call at `next_deadline_ns` or at any other time."""
        self._t_ns = t_ns
        actions: list[Action] = []
        for _ in State:  # each state hands on at most once in one call
            due = self.next_deadline_ns
            if due is None or t_ns < due:
                break
            if self._gone_quiet(t_ns):
                actions.append(
                    Notice("rdss_silent", f"nothing intelligible for {self._options.timeout_s:g} s")
                )
                self._abandon()
                self._search(t_ns)
            _DUE[self.state](self, t_ns, actions)
        return actions

    def height_hint(self, height_m: float, sd_m: float, t_ns: int) -> None:
        """Ellipsoidal height of the terminal's antenna from the navigation solution, one sigma."""
        self._height.hint(height_m, sd_m, t_ns)

    def request_now(self, t_ns: int) -> Notice:
        """An operator asks for a fix: as soon as the card's spacing allows, or why not."""
        self._t_ns = t_ns
        code = "rdss_request"
        if self.state in IN_FLIGHT:
            return Notice(code, "a request is in flight already")
        if self.state is not State.READY:
            return Notice(code, f"refused: {self.detail}")
        self._pace.asap = True
        return Notice(code, f"request in {self._seconds_to(self._pace.due_ns)} s")

    # ------------------------------------------------------------------ outputs

    @property
    def next_deadline_ns(self) -> int | None:
        """When `tick` has something to do; None while the line is closed."""
        due = self._deadline_ns
        if self.state is State.READY:
            due = max(min(self._next_poll_ns, self._pace.due_ns), self._quiet_until_ns)
        if due is not None and self.state not in OFFLINE:
            due = min(due, self._heard_ns + int(self._options.timeout_s * SECOND))
        return due

    @property
    def answered(self) -> bool:
        """A terminal with a known family is on the line."""
        return self.state not in OFFLINE

    @property
    def unanswered_round(self) -> bool:
        """Every baud rate has been probed and nobody answered."""
        return self.state is State.PROBING and self._probe.in_vain

    @property
    def baud(self) -> int:
        """The rate in use or being tried."""
        return self._probe.baud

    @property
    def detail(self) -> str:
        """What it is doing, in words."""
        words = DETAIL[self.state]
        return words.format(
            baud=self.baud,
            families=" and ".join(self._options.families),
            card=f"{self.identity.user:07d}" if self.identity is not None else "none",
            service=self._pace.service_s,
            beams=self._beams(),
            due=self._seconds_to(self._pace.due_ns),
            age=self._seconds_since(self._pace.requested_ns),
            why=self._hold_why,
            hold=self._seconds_to(self._blocked_until_ns() or 0),
        )

    def _beams(self) -> str:
        return f"strongest level {max(self._levels)}" if self._levels else "beam levels unknown"

    def _seconds_to(self, t_ns: int) -> int:
        return max(0, -((self._t_ns - t_ns) // SECOND))

    def _seconds_since(self, t_ns: int | None) -> int:
        return 0 if t_ns is None else (self._t_ns - t_ns) // SECOND

    # ------------------------------------------------------------------ states

    def _enter(self, state: State, deadline_ns: int | None) -> None:
        self.state = state
        self._deadline_ns = deadline_ns

    def _search(self, t_ns: int) -> None:
        self._probe.restart()
        self._enter(State.PROBING, t_ns)

    def _proceed(self, t_ns: int) -> None:
        """Card known, nothing in flight: on to the next request, or to why there is none."""
        if self._permit.silent:
            self._enter(State.SILENT, t_ns)
        elif not self._permit.granted:
            self._enter(State.SUPPRESSED, t_ns)
        else:
            self._beam_reads = 0
            self._enter(State.CHECKING, t_ns)

    def _abandon(self) -> None:
        """Stop waiting for the request in flight; the next keeps clear of its late answer."""
        if self.state in IN_FLIGHT and self._pace.requested_ns is not None:
            self._pace.not_before(self._pace.requested_ns + GIVE_UP_NS)

    def _gone_quiet(self, t_ns: int) -> bool:
        quiet_ns = int(self._options.timeout_s * SECOND)
        return self.state not in OFFLINE and t_ns - self._heard_ns >= quiet_ns

    # ------------------------------------------------------------------ deadlines

    def _read(self, kind: Callable[[int], Request], actions: list[Action]) -> None:
        if self.family is not None:
            user = self.identity.user if self.identity is not None else 0
            actions.append(Send(ENCODE[self.family](kind(user)), "read"))

    def _poll(self, t_ns: int, actions: list[Action]) -> None:
        polls = _POLLS if self._permit.granted else _BLOCKED_POLLS
        self._read(polls[self._polls % len(polls)], actions)
        self._polls += 1
        self._next_poll_ns = t_ns + POLL_NS
        self._quiet_until_ns = t_ns + POLL_REPLY_NS

    def _due_probing(self, t_ns: int, actions: list[Action]) -> None:
        actions += self._probe.next()
        self.counters["probes"] += 1
        self._deadline_ns = t_ns + PROBE_NS

    def _due_no_card(self, t_ns: int, actions: list[Action]) -> None:
        self._read(IdentityRequest, actions)
        self._deadline_ns = t_ns + POLL_NS

    def _due_beams(self, t_ns: int, actions: list[Action]) -> None:
        """CHECKING and NO_BEAM: read the beams until they allow a request."""
        if self._beam_reads >= BEAM_ATTEMPTS:
            self.counters["beams_unknown"] += 1
            self._levels, self._levels_ns = (), t_ns
            self._enter(State.READY, None)
            return
        self._beam_reads += 1
        self._read(BeamPowerRequest, actions)
        self._deadline_ns = t_ns + (PROBE_NS if self.state is State.CHECKING else BEAM_POLL_NS)

    def _due_ready(self, t_ns: int, actions: list[Action]) -> None:
        if t_ns >= self._next_poll_ns:
            self._poll(t_ns, actions)
        elif self._levels_ns is None or t_ns - self._levels_ns > BEAMS_STALE_NS:
            self._proceed(t_ns)
        else:
            self._request(t_ns, actions)

    def _due_feedback(self, t_ns: int, actions: list[Action]) -> None:
        self.counters["timeout_feedback"] += 1
        self._enter(State.AWAIT_FIX, (self._pace.requested_ns or t_ns) + GIVE_UP_NS)

    def _due_fix(self, t_ns: int, actions: list[Action]) -> None:
        self.counters["timeout_fix"] += 1
        self._timeouts += 1
        if self._timeouts == TIMEOUTS_ALARM:
            actions.append(
                Notice("rdss_no_fixes", f"{TIMEOUTS_ALARM} requests in a row brought no fix")
            )
        self._enter(State.READY, None)

    def _due_blocked(self, t_ns: int, actions: list[Action]) -> None:
        """HOLDING, SUPPRESSED and SILENT: reads only, until the hold is over if it has an end."""
        until = self._blocked_until_ns()
        if until is not None and t_ns >= until:
            if self.state is State.SUPPRESSED:
                self._permit.grant()
                actions.append(Notice("rdss_hold_over", "suppression never lifted: trying again"))
            self._proceed(t_ns)
            return
        if t_ns >= self._next_poll_ns:
            self._poll(t_ns, actions)
        self._deadline_ns = self._next_poll_ns if until is None else min(self._next_poll_ns, until)

    def _blocked_until_ns(self) -> int | None:
        match self.state:
            case State.HOLDING:
                return self._hold_until_ns
            case State.SUPPRESSED:
                return self._permit.suppressed_until_ns
            case _:
                return None

    # ------------------------------------------------------------------ requests

    def _request(self, t_ns: int, actions: list[Action]) -> None:
        if self.family is None or self.identity is None:
            self._search(t_ns)
            return
        try:
            data = ENCODE[self.family](self._height.request(self.identity.user, t_ns))
        except EncodeError as error:
            self._hold(t_ns, str(error))
            return
        actions.append(Send(data, "request"))
        self.counters["requested"] += 1
        self._pace.written(t_ns)
        self._answerable = True
        self._enter(State.AWAIT_FEEDBACK, t_ns + FEEDBACK_NS)

    def _hold(self, t_ns: int, why: str) -> None:
        self._hold_why, self._hold_until_ns = why, t_ns + HOLD_NS
        self._enter(State.HOLDING, t_ns)

    # ------------------------------------------------------------------ messages

    def _on_identity(
        self, card: Identity, t_ns: int, family: Family, actions: list[Action]
    ) -> None:
        before = self.identity
        probing = self.state is State.PROBING
        if probing:
            self.family = family
        if card.user == 0:
            self._on_no_card(t_ns, actions)
            return
        changed = before is not None and before.user != card.user
        if changed:
            self._permit.grant()
            self._answerable = False
            self._refused.clear()
        self.identity = card
        self._pace.service_s = card.service_frequency_s or DEFAULT_SERVICE_S
        arrived = probing or changed or self.state is State.NO_CARD
        if arrived or (before and before.service_frequency_s != card.service_frequency_s):
            actions.append(
                Notice(
                    "rdss_card",
                    f"family {family} at {self.baud} baud, card {card.user:07d}, "
                    f"service frequency {card.service_frequency_s} s",
                )
            )
        if arrived:
            self._abandon()
            self._next_poll_ns = t_ns
            self._proceed(t_ns)

    def _on_no_card(self, t_ns: int, actions: list[Action]) -> None:
        if self.state is not State.NO_CARD:
            self._abandon()
            self.counters["no_card"] += 1
            actions.append(Notice("rdss_no_card", "the terminal has no card"))
            self._enter(State.NO_CARD, t_ns + POLL_NS)

    def _on_levels(self, levels: tuple[int, ...], t_ns: int, actions: list[Action]) -> None:
        if not levels:
            return
        self._levels, self._levels_ns, self._beam_reads = levels, t_ns, 0
        usable = max(levels) >= USABLE_LEVEL
        if self.state is State.NO_BEAM and usable:
            actions.append(Notice("rdss_beam", f"beam found: {self._beams()}"))
            self._enter(State.READY, None)
        elif self.state is State.CHECKING and usable:
            self._enter(State.READY, None)
        elif self.state in (State.CHECKING, State.READY) and not usable:
            self.counters["no_beam"] += 1
            self._lose_beam(t_ns, actions)

    def _lose_beam(self, t_ns: int, actions: list[Action]) -> None:
        self._beam_reads = 0
        self._enter(State.NO_BEAM, t_ns + BEAM_POLL_NS)
        actions.append(Notice("rdss_no_beam", f"no beam to transmit on: {self._beams()}"))

    def _on_self_test(self, test: SelfTest, t_ns: int, actions: list[Action]) -> None:
        if test.faults != self._faults:
            self._faults = test.faults
            actions.append(Notice("rdss_self_test", f"faults: {', '.join(test.faults) or 'none'}"))
        if any(test.levels):  # all zero: not filled in, or no beam, which the next GLZK says
            self._on_levels(test.levels, t_ns, actions)
        if self._permit.lifted_by_self_test(test.inbound_state):
            self._lift(t_ns, actions)

    def _on_feedback(self, feedback: Feedback, t_ns: int, actions: list[Action]) -> None:
        outcome = feedback.outcome
        if self._permit.lifted_by_feedback(feedback, t_ns, self._pace.requested_ns):
            self._lift(t_ns, actions)
        elif outcome in ALWAYS:
            self._on_state_of_terminal(outcome, t_ns, actions)
        elif feedback.command not in POSITION_COMMANDS or self.state not in IN_FLIGHT:
            self.counters["feedback_unmatched"] += 1
            if outcome is Outcome.OK and feedback.command in INBOUND_COMMANDS:
                # Somebody else's message or request left the antenna: it uses up the spacing.
                self._pace.wait(t_ns, None)
        elif outcome is Outcome.OK:
            self.counters["accepted"] += 1
            self._refused.clear()
            self._permit.accepted()
            if self._pace.requested_ns is not None:
                self._enter(State.AWAIT_FIX, self._pace.requested_ns + GIVE_UP_NS)
        else:
            self._on_refusal(feedback, t_ns, actions)

    def _on_refusal(self, feedback: Feedback, t_ns: int, actions: list[Action]) -> None:
        outcome = feedback.outcome
        refusal = REFUSALS[outcome]
        self.counters[refusal.counter] += 1
        self._refused[outcome] += 1
        self._forget_refused()
        self._enter(State.READY, None)
        if outcome is Outcome.FREQUENCY:
            self._pace.wait(t_ns, feedback.wait_s)
        elif refusal.state is State.NO_BEAM:
            self._levels = ()
            self._lose_beam(t_ns, actions)
        elif refusal.retries is not None and self._refused[outcome] > refusal.retries:
            if self._refused[outcome] == refusal.retries + 1:
                actions.append(Notice(f"rdss_{refusal.counter}", refusal.text))
            self._hold(t_ns, refusal.text)

    def _forget_refused(self) -> None:
        """A request refused before it was accepted will have no fix."""
        if self.state is State.AWAIT_FEEDBACK:
            self._answerable = False

    def _on_state_of_terminal(self, outcome: Outcome, t_ns: int, actions: list[Action]) -> None:
        self._forget_refused()
        self._abandon()
        if outcome is Outcome.NO_CARD:
            self._on_no_card(t_ns, actions)
            return
        if outcome is Outcome.LOW_BATTERY:
            self.counters["low_battery"] += 1
            if self.state not in (State.SUPPRESSED, State.SILENT, State.NO_CARD):
                if self.state is not State.HOLDING:
                    actions.append(
                        Notice("rdss_low_battery", "battery low: transmission inhibited")
                    )
                self._hold(t_ns, "battery low")
            return
        if outcome is Outcome.SUPPRESSED:
            self.counters["suppressed"] += 1
            if self._permit.suppress(t_ns):
                actions.append(Notice("rdss_suppressed", "the system suppresses this user"))
        else:
            self.counters["silence"] += 1
            if self._permit.silence():
                actions.append(Notice("rdss_silence", "radio silence is set on the terminal"))
        if self.state is not State.NO_CARD:
            self._proceed(t_ns)

    def _lift(self, t_ns: int, actions: list[Action]) -> None:
        self._permit.grant()
        actions.append(Notice("rdss_lifted", "the terminal may transmit again"))
        if self.state in (State.SUPPRESSED, State.SILENT):
            self._proceed(t_ns)

    def _on_fix(self, fix: Fix, t_ns: int, actions: list[Action]) -> None:
        if fix.kind != "own" or self.identity is None or fix.user != self.identity.user:
            self.counters["foreign_fix"] += 1
            return
        if not self._answerable or self._pace.requested_ns is None:
            self.counters["unsolicited"] += 1
            return
        self._answerable = False
        self._timeouts = 0
        self._refused.clear()
        self.counters["fixes"] += 1
        if t_ns - self._pace.requested_ns > FIX_EXPECTED_NS:
            self.counters["slow_fix"] += 1
        if fix.multi_value:
            self.counters["multi_value"] += 1
        if self.state in IN_FLIGHT:
            self._enter(State.READY, None)
        else:
            self.counters["late_fix"] += 1
        time_of_day, uncertainty = fix.time_of_day_s, 0.005
        if fix.fraction is not None:
            part, uncertainty = self._fraction.read(fix.fraction)
            time_of_day += part
            if uncertainty >= 0.5:
                self.counters["bad_fraction"] += 1
        actions.append(FixReady(fix, time_of_day, uncertainty, self._pace.requested_ns))


_DUE: dict[State, Callable[[Terminal, int, list[Action]], None]] = {
    State.PROBING: Terminal._due_probing,
    State.NO_CARD: Terminal._due_no_card,
    State.CHECKING: Terminal._due_beams,
    State.READY: Terminal._due_ready,
    State.AWAIT_FEEDBACK: Terminal._due_feedback,
    State.AWAIT_FIX: Terminal._due_fix,
    State.NO_BEAM: Terminal._due_beams,
    State.HOLDING: Terminal._due_blocked,
    State.SUPPRESSED: Terminal._due_blocked,
    State.SILENT: Terminal._due_blocked,
}
"""What each state does when its deadline comes. CLOSED has none."""
