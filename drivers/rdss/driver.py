"""Driver of a BeiDou RDSS user terminal on a serial line, family 4.0 or 2.1.

It connects the codecs and the request cycle to a `SerialLine`, and emits `DelayedFix` for every own
fix, `TimeReport` for the terminal's clock, `Mail` for short messages and other cards' places, and
`DeviceEvent` for the operator.
"""

from __future__ import annotations

import asyncio
import calendar
import logging
from collections import Counter
from math import radians
from typing import Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat

from drivers.base import DriverOptions, DriverStatus, Emit, Now, State, state_event
from drivers.external_inputs import Inputs
from drivers.measurements import DelayedFix, DeviceEvent, TimeOfDayStamp, TimeReport
from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.binary_4_0_encode import MAX_ORDINARY_ANTENNA_M, MAX_ORDINARY_HEIGHT_M
from drivers.rdss.inbox import Inbox
from drivers.rdss.mail import MessageStage
from drivers.rdss.messages import BeamPower, Decoder, DeviceClock, Family, Message, Unknown
from drivers.rdss.outbox import Outbox
from drivers.rdss.position_report_coding import PositionReport
from drivers.rdss.reply_time_fraction import FractionUnit
from drivers.rdss.request_state_machine import Terminal
from drivers.rdss.state_tables import (
    BITS_A_BYTE,
    PROBE_BAUDS,
    SECOND,
    Action,
    FixReady,
    MailReady,
    Notice,
    Send,
    SetBaud,
    TerminalOptions,
)
from drivers.rdss.vehicle_message_envelope import Carriage
from drivers.reconnecting_line import SerialLine

log = logging.getLogger(__name__)

ZONES_H = (0, 8)
"""T is UTC or Beijing time, by vendor; whoever holds the clock finds out which."""
FRAME_SLACK_NS = SECOND // 2
"""Time beyond a frame's own length on the wire after which it is overdue (PROTOCOLS 1.2)."""
NAMES_LOGGED = 32
STATUS_S = 1.0
"""The status counts down in whole seconds."""


class RdssOptions(DriverOptions):
    """Keys of an RDSS source. Heights in metres."""

    port: str
    baud: Literal["auto"] | Annotated[int, Field(ge=1200, le=4_000_000)] = "auto"
    family: Literal["auto", "4.0", "2.1"] = "auto"
    t_fraction: FractionUnit = "auto"
    """Unit of the last byte of T in family 4.0."""
    antenna_height_m: Annotated[float, Field(ge=0.0, lt=MAX_ORDINARY_ANTENNA_M)] = 0.0
    """Above the ground; goes into a request without a height."""
    height_m: (
        Annotated[float, Field(gt=-MAX_ORDINARY_HEIGHT_M, lt=MAX_ORDINARY_HEIGHT_M)] | None
    ) = None
    """Ellipsoidal height of the antenna, if known and constant (a ship)."""
    use_solution_height: bool = True
    """Send the navigation solution's height to the centre while it is better than the centre's: its
    sigma is below the `height_sd_m` of the source's `aiding`."""
    use_barometer: bool = False
    """Send the pressure of the vehicle's barometer when no height is available."""
    pressure_unit: Literal["Pa", "0.1 Pa"] = "Pa"
    """Unit of the pressure in a request: public sources disagree."""
    request_interval_s: PositiveFloat | None = None
    """Wanted spacing of requests; the card's service frequency is never undercut."""
    suppression_hold_s: Annotated[float, Field(ge=60.0)] = 600.0
    """Time after an unlifted suppression until the next attempt."""
    transmit: bool = True
    """False: the terminal is only read and never asked for a fix, which makes it transmit."""
    message_share: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Share of the card's transmissions for messages while fixes wait, too."""
    message_expiry_s: PositiveFloat = 3600.0
    """Time after which an unsent or unconfirmed message is given up."""
    message_carriage: Carriage = "binary"
    """Encoding of reports, receipts and texts that ask for one: `binary`, `ascii` where only
    printable characters pass, `bcd` where only digits do."""
    timeout_s: Annotated[float, Field(ge=20.0)] = 30.0
    """Time without intelligible input after which the terminal is searched again. Reads go out
    every 10 s."""


def _utc_ns(clock: DeviceClock) -> int:
    """POSIX ns of a device's clock, taken as UTC; a leap second repeats the previous second's
    count."""
    time_of_day_s = clock.time_of_day_s - (clock.time_of_day_s >= 86400)
    midnight = calendar.timegm((clock.year, clock.month, clock.day, 0, 0, 0))
    return midnight * SECOND + round(time_of_day_s * SECOND)


class RdssDriver:
    """Driver of a terminal. `counters` joins those of line, codec and request cycle."""

    Options: ClassVar[type[DriverOptions]] = RdssOptions

    def __init__(self, name: str, options: RdssOptions, emit: Emit, now_ns: Now) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self.status = DriverStatus()
        self._emit = emit
        self.inputs = Inputs(now_ns)
        self.inputs.on("read", self._on_bytes)
        self.inputs.on("open", self._on_open)
        self.inputs.on("close", self._on_close)
        self.inputs.on("due", self._on_due)
        self._now_ns = self.inputs.now_ns
        self._open = False
        self._why_closed = ""
        bauds = PROBE_BAUDS if options.baud == "auto" else (options.baud,)
        families: tuple[Family, ...] = (
            ("4.0", "2.1") if options.family == "auto" else (options.family,)
        )
        self._terminal = Terminal(
            TerminalOptions(
                bauds=bauds,
                families=families,
                t_fraction=options.t_fraction,
                antenna_height_m=options.antenna_height_m,
                height_m=options.height_m,
                use_solution_height=options.use_solution_height,
                use_barometer=options.use_barometer,
                pressure_unit_pa=1.0 if options.pressure_unit == "Pa" else 0.1,
                request_interval_s=options.request_interval_s,
                suppression_hold_s=options.suppression_hold_s,
                timeout_s=options.timeout_s,
                transmit=options.transmit,
                message_share=options.message_share,
                message_expiry_s=options.message_expiry_s,
                message_carriage=options.message_carriage,
                source=name,
            ),
            self.counters,
        )
        self._families = families
        self._decoders: dict[Family, Decoder] = {}
        self._overdue_ns: int | None = None
        self._logged: set[str] = set()
        self._wake = asyncio.Event()
        self._line = SerialLine(options.port, bauds[0], now_ns)
        self._line.counters = self.counters

    async def run(self) -> None:
        """Serve the terminal until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            take = self.inputs.take
            serve = self._line.run(
                lambda data, t_ns: take("read", data, t_ns),
                lambda: take("open"),
                lambda why: take("close", why),
            )
            tasks.create_task(serve)
            tasks.create_task(self._keep_time())

    def height_hint(
        self, height_m: float, sd_m: float, t_ns: int, centre_sd_m: float | None = None
    ) -> None:
        """Set the antenna's ellipsoidal height by the solution at `t_ns`, with one sigma;
        `centre_sd_m` is the sigma of the centre's own height, if known."""
        self._terminal.height.hint(height_m, sd_m, t_ns, centre_sd_m)

    def pressure_hint(self, pressure_pa: float, t_ns: int) -> None:
        """Set the pressure of the vehicle's own barometer."""
        self._terminal.height.pressure(pressure_pa, t_ns)

    def request_now(self, t_ns: int) -> str:
        """Request a fix as soon as the card's spacing allows; return when, or why not, in words."""
        text = self._terminal.request_now(t_ns).text
        self._wake.set()
        return text

    # ------------------------------------------------------------------ short messages

    def post_text(self, key: str, receiver: int, text: str, receipt: bool, t_ns: int) -> None:
        """Queue a text for a card under the sender's key.

        Raises `MessageRefusedError`.
        """
        self._terminal.post_text(key, receiver, text, receipt, t_ns)
        self._posted(t_ns)

    def post_report(self, key: str, receiver: int, report: PositionReport, t_ns: int) -> None:
        """Queue a position report, in place of a waiting one. Raises `MessageRefusedError`."""
        self._terminal.post_report(key, receiver, report, t_ns)
        self._posted(t_ns)

    @property
    def outbox(self) -> Outbox:
        """Waiting messages, for storage."""
        return self._terminal.outbox

    @property
    def inbox(self) -> Inbox:
        """Inbox of received messages, for storage."""
        return self._terminal.inbox

    @property
    def card(self) -> int | None:
        """Number of the card, once known."""
        identity = self._terminal.identity
        return None if identity is None else identity.user or None

    @property
    def beams(self) -> BeamPower | None:
        """Last beams of the terminal."""
        return self._terminal.beams

    def _posted(self, t_ns: int) -> None:
        self.report_stages(t_ns)
        self._wake.set()

    def report_stages(self, t_ns: int) -> None:
        """Report the stages of messages that have progressed."""
        for change in self.outbox.take_changes():
            m = change.message
            wording = m.wordings[0]
            self._emit(
                MessageStage(
                    self.name,
                    t_ns,
                    m.key,
                    m.receiver,
                    m.kind,
                    wording.payload,
                    m.text,
                    change.stage,
                    change.why,
                    m.attempts,
                    m.receipted is not None,
                )
            )

    # ------------------------------------------------------------------ line

    def _on_open(self, _: None, t_ns: int) -> None:
        self._open = True
        self._listen()
        self._perform(self._terminal.opened(t_ns), 0)
        self._wake.set()

    def _on_close(self, why: str, t_ns: int) -> None:
        self._open, self._why_closed = False, why
        self._perform(self._terminal.closed(t_ns), t_ns)
        self._notify(t_ns, "rdss_closed", why)
        self._wake.set()

    def _on_bytes(self, data: bytes, t_ns: int) -> None:
        for family, decoder in tuple(self._decoders.items()):
            self._take(family, decoder.feed(data), t_ns)
        awaited = max((d.awaited_bytes for d in self._decoders.values()), default=0)
        if awaited:
            wire_ns = awaited * BITS_A_BYTE * SECOND // self._terminal.baud
            self._overdue_ns = t_ns + wire_ns + FRAME_SLACK_NS
        else:
            self._overdue_ns = None
        self._wake.set()

    async def _keep_time(self) -> None:
        """Call the state machine when due, and give up overdue frames."""
        while True:
            self._wake.clear()
            self.inputs.take("due")
            due = [d for d in (self._terminal.next_deadline_ns, self._overdue_ns) if d is not None]
            wait_s = STATUS_S
            if due:
                wait_s = min(wait_s, max(0.0, (min(due) - self._now_ns()) / SECOND))
            try:
                async with asyncio.timeout(wait_s):
                    await self._wake.wait()
            except TimeoutError:
                continue

    def _on_due(self, _: None, t_ns: int) -> None:
        if self._overdue_ns is not None and t_ns >= self._overdue_ns:
            self._give_up_frames(t_ns)
        self._perform(self._terminal.tick(t_ns), t_ns)
        if not self._terminal.answered and len(self._decoders) < len(self._families):
            self._listen()
        self._say_status()

    def _say_status(self) -> None:
        """Set the state to `silent` once every baud rate was probed without a reply, or replies
        have ended."""
        state: State = "starting"
        absent = self._line.detail or self._why_closed
        if not self._open:
            state = "absent" if absent else "starting"
        elif self._terminal.answered:
            state = "running"
        elif self._terminal.unanswered_round or self.status.state in ("running", "silent"):
            state = "silent"
        changed = state != self.status.state
        self.status.state = state
        self.status.detail = self._terminal.detail if self._open else absent
        if changed and state != "starting":
            self._emit(state_event(self.name, self._now_ns(), self._line.port, self.status))

    def _give_up_frames(self, t_ns: int) -> None:
        self._overdue_ns = None
        for family, decoder in tuple(self._decoders.items()):
            while decoder.awaited_bytes:
                self._take(family, decoder.expire(), t_ns)

    # ------------------------------------------------------------------ messages and actions

    def _decoder(self, family: Family) -> Decoder:
        """Decoder of a family; until the family is known, its counters are not published."""
        counters = self.counters if len(self._families) == 1 else None
        return binary_4_0.Decoder(counters) if family == "4.0" else text_2_1.Decoder(counters)

    def _take(self, family: Family, messages: list[Message], t_ns: int) -> None:
        for message in messages:
            if family not in self._decoders:
                return
            if isinstance(message, Unknown):
                self._log_once(message.name)
            elif isinstance(message, DeviceClock) and self._terminal.answered:
                self._report_time(message, t_ns)
            self._perform(self._terminal.received(message, t_ns, family), t_ns)
            if self._terminal.answered:
                self._settle_family()

    def _settle_family(self) -> None:
        """Restrict decoding to the terminal's family, once identified."""
        family = self._terminal.family
        if len(self._decoders) > 1 and family is not None:
            decoder = self._decoders[family]
            self.counters.update(decoder.counters)
            decoder.counters = self.counters
            self._decoders = {family: decoder}

    def _perform(self, actions: list[Action], t_ns: int) -> None:
        for action in actions:
            match action:
                case Send():
                    self.inputs.sent(action.data)
                    self._line.write(action.data)
                case SetBaud():
                    self._line.set_baud(action.baud)
                    self._listen()
                case FixReady():
                    self._emit(self._delayed_fix(action, t_ns))
                case MailReady():
                    self._emit(action.mail)
                case Notice():
                    self._notify(t_ns, action.code, action.text)
        self.report_stages(t_ns)

    def _listen(self) -> None:
        """Restart the decoders of all families, and forget earlier input."""
        self._decoders = {family: self._decoder(family) for family in self._families}
        self._overdue_ns = None

    def _delayed_fix(self, ready: FixReady, t_ns: int) -> DelayedFix:
        fix = ready.fix
        stamp = TimeOfDayStamp(
            ready.time_of_day_s, ZONES_H, ready.requested_ns, ready.uncertainty_s
        )
        return DelayedFix(
            self.name,
            t_ns,
            stamp,
            radians(fix.lat_deg),
            radians(fix.lon_deg),
            fix.height_m,
            float(fix.precision_class_m),
            fix.multi_value,
            ready.height_given,
            ready.height_sd_m,
        )

    def _report_time(self, clock: DeviceClock, t_ns: int) -> None:
        """Report the terminal's time. SJXX states neither zone nor lock, so it is never trusted.
        BDZDA has UTC, like ZDA of NMEA 0183, and is trusted while it states a lock."""
        self.counters["time_reports"] += 1
        self._emit(TimeReport(self.name, t_ns, _utc_ns(clock), trusted=clock.locked is True))

    def _notify(self, t_ns: int, code: str, text: str) -> None:
        self._emit(DeviceEvent(self.name, t_ns, code, text))

    def _log_once(self, name: str) -> None:
        if name not in self._logged and len(self._logged) < NAMES_LOGGED:
            self._logged.add(name)
            log.info("%s: the terminal sends %s, which is not read", self.name, name)
