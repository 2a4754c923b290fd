"""Tables of the request cycle: states, time-outs, actions, and consequences of refusals.

Figures are from PROTOCOLS 1.1 and 1.5 unless another source is named.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from drivers.rdss.mail import Mail
from drivers.rdss.messages import Family, Fix, Outcome
from drivers.rdss.reply_time_fraction import FractionUnit
from drivers.rdss.vehicle_message_envelope import Carriage

SECOND = 1_000_000_000
NEVER_NS = 2**63 - 1
PROBE_BAUDS = (115200, 19200, 9600)
PROBE_NS = 3 * SECOND
"""Wait for the answer to a harmless read (PROTOCOLS 1.1)."""
FEEDBACK_NS = 3 * SECOND
FIX_EXPECTED_NS = 5 * SECOND
GIVE_UP_NS = 10 * SECOND
"""Timeouts after the request was written; all three PROTOCOLS 1.5."""
LEAST_MARGIN_NS = SECOND // 10
"""Least margin over the service interval, which the terminal's clock counts: a delayed wake-up of
either side (our choice). It doubles with each refusal for the spacing."""
MOST_MARGIN_NS = SECOND
"""The margin of PROTOCOLS 1.5."""
WAIT_MARGIN_NS = SECOND
"""Over a wait that is stated in whole seconds (PROTOCOLS 1.5)."""
BITS_A_BYTE = 10
"""Bits of a byte on the wire: start, eight, stop."""
BEAM_POLL_NS = 5 * SECOND
USABLE_LEVEL = 2
"""Least beam level that carries a transmission (PROTOCOLS 1.2, ZJXX)."""
HOLD_NS = 60 * SECOND
"""Low battery (PROTOCOLS 1.5); also after an alarm that a retry did not clear (our choice)."""
DEFAULT_SERVICE_S = 60
"""Service interval for a card that states 0: the most common one in the field."""
POLL_NS = 10 * SECOND
"""Interval of reads between requests, which reveal a dead terminal (our choice)."""
POLL_REPLY_NS = SECOND
"""Wait of a request behind a read, so that replies do not interleave (our choice)."""
BEAMS_STALE_NS = 30 * SECOND
"""Age of beam levels from which they are read again before a request (our choice)."""
BEAM_ATTEMPTS = 3
"""Unanswered beam reads after which the terminal is assumed not to support them."""
HINT_SD_M = 10.0
"""Largest height sigma that is given to the centre, if the centre's own is unknown: a 10 m
horizontal result needs it (1.5)."""
HINT_AGE_NS = 5 * SECOND
"""Longest age of a height: a 10 % grade at 72 km/h changes it by 10 m."""
TIMEOUTS_ALARM = 3
"""Requests in a row without a fix from which an event is reported (our choice)."""


class State(StrEnum):
    CLOSED = "closed"
    PROBING = "probing"
    NO_CARD = "no_card"
    CHECKING = "checking"
    READY = "ready"
    AWAIT_FEEDBACK = "await_feedback"
    AWAIT_FIX = "await_fix"
    AWAIT_MESSAGE = "await_message"
    NO_BEAM = "no_beam"
    HOLDING = "holding"
    SUPPRESSED = "suppressed"
    SILENT = "silent"


IN_FLIGHT = frozenset({State.AWAIT_FEEDBACK, State.AWAIT_FIX})
"""A request for a fix."""
OFFLINE = frozenset({State.CLOSED, State.PROBING})

SendKind = Literal["read", "request"]


@dataclass(frozen=True, slots=True)
class Send:
    """Action: write bytes; a `request` makes the terminal transmit, a `read` does not."""

    data: bytes
    kind: SendKind


@dataclass(frozen=True, slots=True)
class SetBaud:
    baud: int


@dataclass(frozen=True, slots=True)
class FixReady:
    """Own fix: time of day (s, zone unknown) with the bound of its error (s), instant at which the
    request was written, whether the request gave a height or pressure, and that height's sigma if
    known."""

    fix: Fix
    time_of_day_s: float
    uncertainty_s: float
    requested_ns: int
    height_given: bool
    height_sd_m: float | None = None


@dataclass(frozen=True, slots=True)
class MailReady:
    """Received short message, or another card's place."""

    mail: Mail


@dataclass(frozen=True, slots=True)
class Notice:
    """Notice for the operator."""

    code: str
    text: str


Action = Send | SetBaud | FixReady | MailReady | Notice


@dataclass(frozen=True, slots=True)
class TerminalOptions:
    """Options of a terminal. `bauds` and `families` are tried in order; None: not given, or no own
    limit. `source` is the driver's name."""

    bauds: tuple[int, ...] = PROBE_BAUDS
    families: tuple[Family, ...] = ("4.0", "2.1")
    t_fraction: FractionUnit = "auto"
    antenna_height_m: float = 0.0
    height_m: float | None = None
    use_solution_height: bool = True
    use_barometer: bool = False
    pressure_unit_pa: float = 1.0
    request_interval_s: float | None = None
    suppression_hold_s: float = 600.0
    timeout_s: float = 30.0
    transmit: bool = True
    message_share: float = 0.5
    message_expiry_s: float = 3600.0
    message_carriage: Carriage = "binary"
    source: str = ""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Consequence of a refused request. `notice` is reported once until a request is accepted;
    after `retries` in a row the state becomes HOLDING."""

    counter: str
    state: State
    text: str = ""
    retries: int | None = None


REFUSALS = {
    Outcome.FAILED: Refusal("refused", State.READY),
    Outcome.OTHER: Refusal("refused_other", State.READY),
    Outcome.FREQUENCY: Refusal("refused_frequency", State.READY),
    Outcome.NOT_LOCKED: Refusal("no_beam", State.NO_BEAM),
    Outcome.NOT_SENT: Refusal("not_sent", State.NO_BEAM),
    Outcome.ENCRYPTION: Refusal(
        "encryption_error", State.READY, "the card's encryption failed twice", retries=1
    ),
    Outcome.CRC: Refusal("crc_error", State.READY, "requests arrive damaged: CRC", retries=1),
    Outcome.NO_PERMISSION: Refusal(
        "no_permission", State.READY, "the card has no permission to ask for positions", retries=0
    ),
}
"""Refusals of a request of ours in flight. The outcomes below count at any time."""
ALWAYS = frozenset(
    {
        Outcome.LOW_BATTERY,
        Outcome.SUPPRESSED,
        Outcome.SILENCE,
        Outcome.SILENCE_OR_LIFTED,
        Outcome.NO_CARD,
    }
)
POSITION_COMMANDS = frozenset({None, "DWSQ", "DWA"})
MESSAGE_COMMANDS = frozenset({"TXSQ", "TXA", "TCQ"})
INBOUND_COMMANDS = MESSAGE_COMMANDS | {"DWSQ", "DWA", "WAA", "WBA"}

DETAIL = {
    State.CLOSED: "line closed",
    State.PROBING: "Looking for the terminal at {baud} baud (family {families})",
    State.NO_CARD: f"No card in the terminal; asking again every {POLL_NS // SECOND} s",
    State.CHECKING: "Reading beam power",
    State.READY: "card {card}, {service} s: next request in {due} s, {beams}{waiting}",
    State.AWAIT_FEEDBACK: "Fix requested; waiting for feedback",
    State.AWAIT_FIX: "Fix requested {age} s ago; waiting",
    State.AWAIT_MESSAGE: "Message sent; waiting for feedback{waiting}",
    State.NO_BEAM: f"No beam ({{beams}}); asking again every {BEAM_POLL_NS // SECOND} s",
    State.HOLDING: "{why}: next attempt in {hold} s",
    State.SUPPRESSED: "Suppressed by the RDSS centre; transmits again in {hold} s, or when lifted",
    State.SILENT: "Radio silence set at the terminal; lift it there",
}
"""Texts of states for the operator."""
READ_ONLY_DETAIL = "card {card}, {service} s: read only, no fix is requested; {beams}"
"""READY without the option `transmit`."""
