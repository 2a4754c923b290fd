"""State of the terminal in the request cycle, and its transitions.

`message_effects` changes it by the terminal's messages, `request_state_machine` by deadlines.
"""

from __future__ import annotations

from collections import Counter

from drivers.rdss.messages import BeamPower, Family, Identity
from drivers.rdss.outbox import Outbox, StrideScheduler
from drivers.rdss.permit import TransmissionSpacing, TransmitPermit
from drivers.rdss.probe import Probe
from drivers.rdss.state_tables import (
    GIVE_UP_NS,
    HOLD_NS,
    OFFLINE,
    SECOND,
    State,
    TerminalOptions,
)


class RequestCycleState:
    """State with its deadline and data. Instants are monotonic ns.

    `levels` and `levels_ns`: beam levels and the instant of their reading; `beam_reads`: queries
    since then; `beams_said`: the last report of the beams. `answerable`: the last request may
    still bring a fix; `height_given`: it gave a height, of sigma `height_sd_m` (None: unknown).
    `fix_awaited`: it has neither brought one, nor been refused, nor been given up; a message may
    be under way meanwhile. `timeouts`: requests in a row without a fix. Spacing (`pace`),
    suppression and silence (`permit`) and messages (`outbox`) outlive the line.
    """

    def __init__(self, options: TerminalOptions, counters: Counter[str]) -> None:
        self.options = options
        self.counters = counters
        self.state = State.CLOSED
        self.deadline_ns: int | None = None
        self.received_ns = 0
        self.family: Family | None = None
        self.identity: Identity | None = None
        self.probe = Probe(options.bauds, options.families)
        self.next_poll_ns = 0
        self.levels: tuple[int, ...] = ()
        self.beams_said: BeamPower | None = None
        self.levels_ns: int | None = None
        self.beam_reads = 0
        self.answerable = False
        self.fix_awaited = False
        self.height_given = False
        self.height_sd_m: float | None = None
        self.timeouts = 0
        self.pace = TransmissionSpacing(options.request_interval_s)
        self.permit = TransmitPermit(options.suppression_hold_s)
        self.hold_why, self.hold_until_ns = "", 0
        expiry_ns = int(options.message_expiry_s * SECOND)
        self.outbox = Outbox(counters, expiry_ns, carriage=options.message_carriage)
        self.turns = StrideScheduler(options.message_share)

    @property
    def answered(self) -> bool:
        """True if a terminal of a known family has replied."""
        return self.state not in OFFLINE

    @property
    def beams(self) -> str:
        """Beams in words."""
        return f"strongest level {max(self.levels)}" if self.levels else "beam levels unknown"

    @property
    def blocked_until_ns(self) -> int | None:
        """End of HOLDING or SUPPRESSED; None in any other state."""
        match self.state:
            case State.HOLDING:
                return self.hold_until_ns
            case State.SUPPRESSED:
                return self.permit.suppressed_until_ns
            case _:
                return None

    # ------------------------------------------------------------------ transitions

    def enter(self, state: State, deadline_ns: int | None) -> None:
        """Enter `state`, with the next action at `deadline_ns`."""
        self.state = state
        self.deadline_ns = deadline_ns

    def search(self, t_ns: int) -> None:
        """Start the search for a terminal."""
        self.probe.restart()
        self.enter(State.PROBING, t_ns)

    def proceed(self, t_ns: int) -> None:
        """Continue to the next request or wait; the card is known and nothing is in flight."""
        if self.permit.silent:
            self.enter(State.SILENT, t_ns)
        elif not self.permit.granted:
            self.enter(State.SUPPRESSED, t_ns)
        else:
            self.beam_reads = 0
            self.enter(State.CHECKING, t_ns)

    def hold(self, t_ns: int, why: str) -> None:
        """Send no request for a while."""
        self.hold_why, self.hold_until_ns = why, t_ns + HOLD_NS
        self.enter(State.HOLDING, t_ns)

    def abandon(self) -> None:
        """Stop waiting for the request in flight or for the feedback on a message. The next request
        waits, to avoid a delayed reply."""
        if self.state is State.AWAIT_MESSAGE:
            self.outbox.unanswered()
        if self.fix_awaited and self.pace.requested_ns is not None:
            self.pace.not_before(self.pace.requested_ns + GIVE_UP_NS)
        self.fix_awaited = False

    def await_fix(self) -> None:
        """Wait for the fix of the last request until it is given up, or be ready without one."""
        if self.fix_awaited and self.pace.requested_ns is not None:
            self.enter(State.AWAIT_FIX, self.pace.requested_ns + GIVE_UP_NS)
        else:
            self.enter(State.READY, None)
