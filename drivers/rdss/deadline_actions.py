"""Actions of an RDSS terminal's states at their deadlines: reads, requests, messages.

`drivers.rdss.request_state_machine` describes the states. Only this module sends.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from drivers.rdss.messages import (
    BeamPowerRequest,
    EncodeError,
    Family,
    HeightMode,
    IdentityRequest,
    Request,
    SelfTestRequest,
    TextRequest,
    TimeRequest,
)
from drivers.rdss.outbox import Outgoing
from drivers.rdss.probe import ENCODE
from drivers.rdss.request_cycle_state import RequestCycleState
from drivers.rdss.request_height import HeightSource
from drivers.rdss.state_tables import (
    BEAM_ATTEMPTS,
    BEAM_POLL_NS,
    BEAMS_STALE_NS,
    FEEDBACK_NS,
    POLL_NS,
    POLL_REPLY_NS,
    PROBE_NS,
    TIMEOUTS_ALARM,
    Action,
    Notice,
    Send,
    State,
    TerminalOptions,
)

_POLLS: tuple[Callable[[int], Request], ...] = (
    SelfTestRequest,
    BeamPowerRequest,
    TimeRequest,
    BeamPowerRequest,
    IdentityRequest,
    BeamPowerRequest,
)
_BLOCKED_POLLS: tuple[Callable[[int], Request], ...] = (SelfTestRequest, BeamPowerRequest)
"""Reads during a transmission ban: the self test may show its end."""


class DeadlineActions:
    """Actions of one terminal. Its counters are those of `Terminal`."""

    def __init__(
        self,
        options: TerminalOptions,
        session: RequestCycleState,
        height: HeightSource,
        counters: Counter[str],
    ) -> None:
        self.counters = counters
        self.height = height
        self.quiet_until_ns = 0
        """Deadline of a poll's reply."""
        self._options = options
        self._session = session
        self._polls = 0

    def due(self, t_ns: int, actions: list[Action]) -> None:
        """Execute the state's action."""
        _DUE[self._session.state](self, t_ns, actions)

    def _read(self, kind: Callable[[int], Request], actions: list[Action]) -> None:
        session = self._session
        if session.family is not None:
            user = session.identity.user if session.identity is not None else 0
            actions.append(Send(ENCODE[session.family](kind(user)), "read"))

    def _poll(self, t_ns: int, actions: list[Action]) -> None:
        polls = _POLLS if self._session.permit.granted else _BLOCKED_POLLS
        self._read(polls[self._polls % len(polls)], actions)
        self._polls += 1
        self._session.next_poll_ns = t_ns + POLL_NS
        self.quiet_until_ns = t_ns + POLL_REPLY_NS

    def _due_probing(self, t_ns: int, actions: list[Action]) -> None:
        actions += self._session.probe.next()
        self.counters["probes"] += 1
        self._session.deadline_ns = t_ns + PROBE_NS

    def _due_no_card(self, t_ns: int, actions: list[Action]) -> None:
        self._read(IdentityRequest, actions)
        self._session.deadline_ns = t_ns + POLL_NS

    def _due_beams(self, t_ns: int, actions: list[Action]) -> None:
        """In CHECKING and NO_BEAM, read the beams until they allow a request."""
        session = self._session
        if session.beam_reads >= BEAM_ATTEMPTS:
            self.counters["beams_unknown"] += 1
            session.levels, session.levels_ns = (), t_ns
            session.enter(State.READY, None)
            return
        session.beam_reads += 1
        self._read(BeamPowerRequest, actions)
        session.deadline_ns = t_ns + (PROBE_NS if session.state is State.CHECKING else BEAM_POLL_NS)

    def _due_ready(self, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        if t_ns >= session.next_poll_ns:
            self._poll(t_ns, actions)
        elif not self._options.transmit:
            return
        elif session.levels_ns is None or t_ns - session.levels_ns > BEAMS_STALE_NS:
            session.proceed(t_ns)
        else:
            self._transmit(t_ns, actions)

    def _due_feedback(self, t_ns: int, actions: list[Action]) -> None:
        self.counters["timeout_feedback"] += 1
        self._session.await_fix()

    def _due_fix(self, t_ns: int, actions: list[Action]) -> None:
        """AWAIT_FIX: a message while the fix is overdue, then the fix's end."""
        session = self._session
        if session.deadline_ns is not None and t_ns < session.deadline_ns:
            self._transmit(t_ns, actions)
            return
        self.counters["timeout_fix"] += 1
        session.fix_awaited = False
        session.timeouts += 1
        if session.timeouts == TIMEOUTS_ALARM:
            actions.append(
                Notice("rdss_no_fixes", f"{TIMEOUTS_ALARM} requests in a row brought no fix")
            )
        session.enter(State.READY, None)

    def _due_message(self, t_ns: int, actions: list[Action]) -> None:
        self._session.outbox.unanswered()
        self._session.await_fix()

    def _due_blocked(self, t_ns: int, actions: list[Action]) -> None:
        """In HOLDING, SUPPRESSED and SILENT, only read until the hold is over, if it has an end."""
        session = self._session
        until = session.blocked_until_ns
        if until is not None and t_ns >= until:
            if session.state is State.SUPPRESSED:
                session.permit.grant()
                actions.append(Notice("rdss_hold_over", "Hold time over: requesting fixes again"))
            session.proceed(t_ns)
            return
        if t_ns >= session.next_poll_ns:
            self._poll(t_ns, actions)
        session.deadline_ns = (
            session.next_poll_ns if until is None else min(session.next_poll_ns, until)
        )

    # ------------------------------------------------------------------ requests and messages

    def _transmit(self, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        if session.family is None or session.identity is None:
            session.search(t_ns)
            return
        fix_due = not session.fix_awaited and t_ns >= session.pace.due_ns
        message = session.outbox.next(t_ns) if t_ns >= session.pace.free_ns else None
        user = session.identity.user
        if message is not None and (session.turns.message_first or not fix_due):
            if self._send(message, user, session.family, t_ns, actions):
                session.turns.took(message=True, other_waits=fix_due)
        elif fix_due:
            self._request(user, session.family, t_ns, actions)
            session.turns.took(message=False, other_waits=message is not None)

    def _send(
        self, message: Outgoing, user: int, family: Family, t_ns: int, actions: list[Action]
    ) -> bool:
        """Write a message; False, and the message ends, if this card cannot send it."""
        session = self._session
        wording = session.outbox.wording(message)
        if wording is None:
            return False
        text = TextRequest(
            message.receiver, wording.payload, wording.encoding, user, odd=wording.odd
        )
        try:
            data = ENCODE[family](text)
        except EncodeError as error:
            session.outbox.unsayable(message, str(error))
            return False
        actions.append(Send(data, "request"))
        session.pace.written(t_ns, len(data), session.probe.baud, fix=False)
        session.outbox.written(message)
        session.enter(State.AWAIT_MESSAGE, t_ns + FEEDBACK_NS)
        return True

    def _request(self, user: int, family: Family, t_ns: int, actions: list[Action]) -> None:
        session = self._session
        try:
            request = self.height.request(user, t_ns)
            data = ENCODE[family](request)
        except EncodeError as error:
            session.hold(t_ns, str(error))
            return
        actions.append(Send(data, "request"))
        self.counters["requested"] += 1
        session.pace.written(t_ns, len(data), session.probe.baud, fix=True)
        session.answerable = session.fix_awaited = True
        session.height_given = request.height_mode is not HeightMode.NONE
        session.height_sd_m = self.height.given_sd_m
        session.enter(State.AWAIT_FEEDBACK, t_ns + FEEDBACK_NS)


_DUE: dict[State, Callable[[DeadlineActions, int, list[Action]], None]] = {
    State.PROBING: DeadlineActions._due_probing,
    State.NO_CARD: DeadlineActions._due_no_card,
    State.CHECKING: DeadlineActions._due_beams,
    State.READY: DeadlineActions._due_ready,
    State.AWAIT_FEEDBACK: DeadlineActions._due_feedback,
    State.AWAIT_FIX: DeadlineActions._due_fix,
    State.AWAIT_MESSAGE: DeadlineActions._due_message,
    State.NO_BEAM: DeadlineActions._due_beams,
    State.HOLDING: DeadlineActions._due_blocked,
    State.SUPPRESSED: DeadlineActions._due_blocked,
    State.SILENT: DeadlineActions._due_blocked,
}
"""Action of each state at its deadline. CLOSED has none."""
