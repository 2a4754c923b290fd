"""Effects of the terminal's messages on the request cycle.

The table `REFUSALS` has the consequence of each refusal. Suppression, silence, a low battery and a
missing card take effect whenever reported. A fix belongs to the last request written, and counts
once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from drivers.plausible import HEIGHT_M, within
from drivers.rdss.inbox import Inbox
from drivers.rdss.messages import (
    BeamPower,
    Family,
    Feedback,
    Fix,
    Identity,
    Message,
    Outcome,
    Request,
    SelfTest,
    Text,
    Unknown,
)
from drivers.rdss.reply_time_fraction import FractionReader
from drivers.rdss.request_cycle_state import RequestCycleState
from drivers.rdss.state_tables import (
    ALWAYS,
    BEAM_POLL_NS,
    DEFAULT_SERVICE_S,
    FIX_EXPECTED_NS,
    IN_FLIGHT,
    INBOUND_COMMANDS,
    MESSAGE_COMMANDS,
    POLL_NS,
    POSITION_COMMANDS,
    REFUSALS,
    USABLE_LEVEL,
    Action,
    FixReady,
    Notice,
    State,
)


class MessageEffects:
    """Changes of a `RequestCycleState` by messages; `Terminal` lists the counters."""

    def __init__(self, session: RequestCycleState) -> None:
        self._session = session
        self.inbox = Inbox(session)
        self._fraction = FractionReader(session.options.t_fraction)
        self._faults: tuple[str, ...] = ()
        self._refused: Counter[Outcome] = Counter()

    def take(self, message: Message, t_ns: int, family: Family) -> list[Action]:
        """Process a message that the codec of `family` decoded."""
        actions: list[Action] = []
        session = self._session
        if isinstance(message, Unknown) or session.state is State.CLOSED:
            return actions
        if isinstance(message, Request):
            session.counters["echo"] += 1
            return actions
        if session.state is State.PROBING and not isinstance(message, Identity):
            session.counters["before_identity"] += 1
            return actions
        session.received_ns = t_ns
        match message:
            case Identity():
                self._on_identity(message, t_ns, family, actions)
            case BeamPower():
                session.beams_said = message
                self._on_levels(message.levels, t_ns, actions)
            case SelfTest():
                self._on_self_test(message, t_ns, actions)
            case Feedback():
                self._on_feedback(message, t_ns, actions)
            case Fix():
                self._on_fix(message, t_ns, actions)
            case Text():
                actions.append(self.inbox.mail_of(message, t_ns))
            case _:
                pass
        return actions

    def _on_identity(
        self, card: Identity, t_ns: int, family: Family, actions: list[Action]
    ) -> None:
        session = self._session
        before = session.identity
        probing = session.state is State.PROBING
        if probing:
            session.family = family
        if card.user == 0:
            self._on_no_card(t_ns, actions)
            return
        changed = before is not None and before.user != card.user
        if changed:
            session.permit.grant()
            session.answerable = False
            self._refused.clear()
        session.identity = card
        session.pace.service_s = card.service_frequency_s or DEFAULT_SERVICE_S
        session.outbox.comm_level = card.comm_level
        session.outbox.spacing_ns = session.pace.spacing_ns
        arrived = probing or changed or session.state is State.NO_CARD
        if arrived or (before and before.service_frequency_s != card.service_frequency_s):
            actions.append(
                Notice(
                    "rdss_card",
                    f"family {family} at {session.probe.baud} baud, card {card.user:07d}, "
                    f"service frequency {card.service_frequency_s} s",
                )
            )
        if arrived:
            session.abandon()
            session.next_poll_ns = t_ns
            session.proceed(t_ns)

    def _on_no_card(self, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        if session.state is not State.NO_CARD:
            session.abandon()
            session.counters["no_card"] += 1
            actions.append(Notice("rdss_no_card", "No card in the terminal"))
            session.enter(State.NO_CARD, t_ns + POLL_NS)

    def _on_levels(self, levels: tuple[int, ...], t_ns: int, actions: list[Action]) -> None:
        session = self._session
        if not levels:
            return
        session.levels, session.levels_ns, session.beam_reads = levels, t_ns, 0
        usable = max(levels) >= USABLE_LEVEL
        if session.state is State.NO_BEAM and usable:
            actions.append(Notice("rdss_beam", f"Beam found: {session.beams}"))
            session.enter(State.READY, None)
        elif session.state is State.CHECKING and usable:
            session.enter(State.READY, None)
        elif session.state in (State.CHECKING, State.READY) and not usable:
            session.counters["no_beam"] += 1
            self._lose_beam(t_ns, actions)

    def _lose_beam(self, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        session.abandon()
        session.beam_reads = 0
        session.enter(State.NO_BEAM, t_ns + BEAM_POLL_NS)
        actions.append(Notice("rdss_no_beam", f"No beam to transmit on: {session.beams}"))

    def _on_self_test(self, test: SelfTest, t_ns: int, actions: list[Action]) -> None:
        if test.faults != self._faults:
            self._faults = test.faults
            actions.append(Notice("rdss_self_test", f"faults: {', '.join(test.faults) or 'none'}"))
        if any(test.levels):  # all zero: not filled in, or no beam; the next GLZK decides
            said = self._session.beams_said or BeamPower(())
            self._session.beams_said = replace(said, levels=test.levels)
            self._on_levels(test.levels, t_ns, actions)
        if self._session.permit.lifted_by_self_test(test.inbound_state):
            self._lift(t_ns, actions)

    def _on_feedback(self, feedback: Feedback, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        outcome = feedback.outcome
        if session.permit.lifted_by_feedback(feedback, t_ns, session.pace.written_ns):
            self._lift(t_ns, actions)
        elif outcome in ALWAYS:
            self._on_state_of_terminal(outcome, t_ns, actions)
        elif self._on_message(feedback, t_ns, actions):
            pass
        elif feedback.command not in POSITION_COMMANDS or session.state not in IN_FLIGHT:
            session.counters["feedback_unmatched"] += 1
            if outcome is Outcome.OK and feedback.command in INBOUND_COMMANDS:
                # Another program's message or request was transmitted, so the spacing starts again.
                session.pace.wait(t_ns, None)
        elif outcome is Outcome.OK:
            session.counters["accepted"] += 1
            self._refused.clear()
            session.permit.accepted()
            session.await_fix()
        else:
            self._on_refusal(feedback, t_ns, actions)

    def _on_message(self, feedback: Feedback, t_ns: int, actions: list[Action]) -> bool:
        """Apply the feedback on a message of ours; False if it is not."""
        session = self._session
        awaited = session.state is State.AWAIT_MESSAGE
        outcome = feedback.outcome
        if not (awaited and feedback.command is None) and feedback.command not in MESSAGE_COMMANDS:
            return False
        if not awaited:
            was_doubtful = session.outbox.doubtful is not None and outcome is Outcome.OK
            if was_doubtful:
                session.counters["late_feedback"] += 1
                session.outbox.accepted(t_ns)
            return was_doubtful
        session.await_fix()
        if outcome is Outcome.OK:
            self._refused.clear()
            session.permit.accepted()
            session.outbox.accepted(t_ns)
            return True
        session.outbox.refused(outcome, t_ns)
        session.counters[REFUSALS[outcome].counter] += 1
        if outcome is Outcome.FREQUENCY:
            session.pace.too_early(t_ns, feedback.wait_s)
        elif REFUSALS[outcome].state is State.NO_BEAM:
            session.levels = ()
            self._lose_beam(t_ns, actions)
        return True

    def _on_refusal(self, feedback: Feedback, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        outcome = feedback.outcome
        refusal = REFUSALS[outcome]
        session.counters[refusal.counter] += 1
        self._refused[outcome] += 1
        self._forget_refused()
        session.fix_awaited = False
        session.enter(State.READY, None)
        if outcome is Outcome.FREQUENCY:
            session.pace.too_early(t_ns, feedback.wait_s)
        elif refusal.state is State.NO_BEAM:
            session.levels = ()
            self._lose_beam(t_ns, actions)
        elif refusal.retries is not None and self._refused[outcome] > refusal.retries:
            if self._refused[outcome] == refusal.retries + 1:
                actions.append(Notice(f"rdss_{refusal.counter}", refusal.text))
            session.hold(t_ns, refusal.text)

    def _forget_refused(self) -> None:
        """Forget a request that was refused before acceptance, and so brings no fix."""
        if self._session.state is State.AWAIT_FEEDBACK:
            self._session.answerable = False

    def _on_state_of_terminal(self, outcome: Outcome, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        self._forget_refused()
        if session.state is State.AWAIT_MESSAGE:
            session.outbox.refused(outcome, t_ns)
        session.abandon()
        if outcome is Outcome.NO_CARD:
            self._on_no_card(t_ns, actions)
            return
        if outcome is Outcome.LOW_BATTERY:
            session.counters["low_battery"] += 1
            if session.state not in (State.SUPPRESSED, State.SILENT, State.NO_CARD):
                if session.state is not State.HOLDING:
                    actions.append(
                        Notice("rdss_low_battery", "Battery low: the terminal does not transmit")
                    )
                session.hold(t_ns, "battery low")
            return
        if outcome is Outcome.SUPPRESSED:
            session.counters["suppressed"] += 1
            if session.permit.suppress(t_ns):
                actions.append(Notice("rdss_suppressed", "The RDSS centre suppresses this card"))
        else:
            session.counters["silence"] += 1
            if session.permit.silence():
                actions.append(Notice("rdss_silence", "Radio silence is set at the terminal"))
        if session.state is not State.NO_CARD:
            session.proceed(t_ns)

    def _lift(self, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        session.permit.grant()
        actions.append(Notice("rdss_lifted", "The terminal may transmit again"))
        if session.state in (State.SUPPRESSED, State.SILENT):
            session.proceed(t_ns)

    def _on_fix(self, fix: Fix, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        if fix.kind != "own" or session.identity is None or fix.user != session.identity.user:
            session.counters["foreign_fix"] += 1
            other = self.inbox.place(fix, t_ns)
            if other is not None:
                actions.append(other)
            return
        if not session.answerable or session.pace.requested_ns is None:
            session.counters["unsolicited"] += 1
            return
        if not within(fix.height_m + fix.height_anomaly_m, HEIGHT_M):
            session.counters["height_implausible"] += 1
            return
        session.answerable = False
        session.timeouts = 0
        self._refused.clear()
        session.counters["fixes"] += 1
        if t_ns - session.pace.requested_ns > FIX_EXPECTED_NS:
            session.counters["slow_fix"] += 1
        if fix.multi_value:
            session.counters["multi_value"] += 1
        if not session.fix_awaited:
            session.counters["late_fix"] += 1
        session.fix_awaited = False
        if session.state in IN_FLIGHT:
            session.enter(State.READY, None)
        time_of_day, uncertainty = fix.time_of_day_s, 0.005
        if fix.fraction is not None:
            part, uncertainty = self._fraction.read(fix.fraction)
            time_of_day += part
            if uncertainty >= 0.5:
                session.counters["bad_fraction"] += 1
        actions.append(
            FixReady(
                fix,
                time_of_day,
                uncertainty,
                session.pace.requested_ns,
                session.height_given,
                session.height_sd_m,
            )
        )
