"""Short messages of the RDSS terminals: queues, position reports and published results.

The queues belong to the drivers (drivers.rdss.outbox). This module fills them by operators'
commands and by `[position_reports]`, and builds `message` and `fleet` from the results. Like the
rest of the chain it depends only on the drivers' output, commands and ticks.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from math import atan2, degrees, hypot, isfinite
from typing import TYPE_CHECKING, Any

from drivers.rdss.mail import (
    FleetFix,
    Mail,
    MessageReceived,
    MessageRefusedError,
    MessageStage,
)
from drivers.rdss.position_report_coding import DAY_S, PositionReport
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Solution
from fusiond.outputs.commands import CommandRefusedError, SendMessage
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.fleet import FleetMessage, of_centre, of_report
from fusiond.outputs.messages.short_message import ShortMessage, of_received, of_stage
from fusiond.outputs.topics import MESSAGE, Topic, fleet

if TYPE_CHECKING:  # a vehicle without a terminal never loads them
    from drivers.rdss.driver import RdssDriver
    from fusiond.live.stored_messages import KeptMessages

MOST_UNCONFIRMED = 40
"""Most messages that wait for the broker's confirmation: the most that all cards can send in a
minute."""
MOST_CARDS = 256
"""Retained topics at the broker, one each; a command terminal lists 100 (ICXX)."""
AHEAD_NS = 60 * SECOND_NS
"""An undated report that is further ahead of our clock than this is from the day before."""


class Messaging:
    """Messaging of one vehicle. `revision` increases with every change that must be saved."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        drivers: Mapping[str, Any],
        on_event: Callable[[str, str, str], None],
    ) -> None:
        self._options = config.position_reports
        self._clock = clock
        self._on_event = on_event
        self._terminals: dict[str, RdssDriver] = {
            name: driver for name, driver in drivers.items() if hasattr(driver, "post_text")
        }
        if self._terminals:  # takes 10 ms: too long for the tick that handles the first message
            import fusiond.live.stored_messages  # noqa: F401, PLC0415
        self.waiting: deque[tuple[Topic, Message]] = deque()
        """Messages to publish."""
        self._unconfirmed: OrderedDict[int, ShortMessage] = OrderedDict()
        self._serial = 0
        self._reports = 0
        self._places: dict[int, int] = {}
        interval_s = self._options.interval_s
        self._interval = None if interval_s is None else Every(round(interval_s * SECOND_NS))
        self._report_due = ""
        self._refused: set[str] = set()
        self.revision = 0

    # ------------------------------------------------------------------ out

    def send(self, command: SendMessage, t_ns: int) -> str:
        """Queue an operator's message and describe the result. Raises `CommandRefusedError`."""
        name = self._terminal(command.source)
        try:
            self._terminals[name].post_text(
                command.id, command.card, command.text, command.receipt, t_ns
            )
        except MessageRefusedError as error:
            raise CommandRefusedError(str(error)) from error
        waiting = len(self._terminals[name].outbox.waiting)
        return f"queued for card {command.card:07d}, {waiting} waiting"

    def _terminal(self, wanted: str | None) -> str:
        names = ", ".join(self._terminals)
        if not self._terminals:
            raise CommandRefusedError("there is no RDSS terminal")
        if wanted is None:
            if len(self._terminals) > 1:
                raise CommandRefusedError(f"several terminals: name one as source: {names}")
            return next(iter(self._terminals))
        if wanted not in self._terminals:
            raise CommandRefusedError(f"no terminal {wanted!r}; there are {names}")
        return wanted

    def note_event(self, code: str) -> None:
        """Remember an event that asks for a position report."""
        if code in self._options.events:
            self._report_due = code

    def tick(self, t_ns: int, solution: Solution) -> None:
        """Send a position report, if due and a solution exists."""
        if self._options.card is None:
            return
        if self._interval is not None and self._interval.due(t_ns):
            self._report_due = self._report_due or "interval"
        if not self._report_due:
            return
        report = self._report(solution)
        if report is None:
            return
        self._report_due = ""
        try:
            name = self._terminal(self._options.source)
            key = f"report-{self._serial + 1}"
            self._terminals[name].post_report(key, self._options.card, report, t_ns)
            self._refused.clear()
        except (MessageRefusedError, CommandRefusedError) as error:
            if str(error) not in self._refused:  # reported once, until a report is queued again
                self._refused.add(str(error))
                self._on_event("position_reports", "report_refused", str(error))

    def _report(self, solution: Solution) -> PositionReport | None:
        """Position report of a solution; None without position or time."""
        utc_ns = self._clock.utc_ns(solution.t_ns)
        if utc_ns is None or not (isfinite(solution.lat_rad) and isfinite(solution.lon_rad)):
            return None
        north, east = solution.v_ned_m_s[:2]
        sd_n, sd_e, sd_d = (_known(sd) for sd in solution.sd_ned_m)
        return PositionReport(
            utc_ns * 1e-9,
            degrees(solution.lat_rad),
            degrees(solution.lon_rad),
            str(solution.mode),
            (sd_n, sd_e, sd_d),
            _known(solution.height_m),
            _known(hypot(north, east)),
            _known(degrees(atan2(east, north)) % 360.0),
        )

    # ------------------------------------------------------------------ in

    def receive(self, mail: Mail) -> None:
        """Receive mail of a driver."""
        utc_ns = self._clock.utc_ns(mail.t_seen_ns)
        match mail:
            case MessageStage():
                self._serial += 1
                self._queue(of_stage(mail, self._serial, utc_ns))
                if mail.over and mail.stage not in ("sent", "delivered", "superseded"):
                    text = f"to card {mail.receiver:07d}, {mail.key}: {mail.why or mail.stage}"
                    self._on_event(mail.source, f"message_{mail.stage}", text)
            case MessageReceived():
                self._serial += 1
                self._queue(of_received(mail, self._serial, utc_ns))
                if mail.fault:
                    text = f"from card {mail.sender:07d} for {mail.receiver:07d}: {mail.fault}"
                    self._on_event(mail.source, f"message_{mail.fault}", text)
                if mail.report is not None:
                    t_utc_ns = _utc_of(mail.report, utc_ns)
                    self._place(of_report(mail.report, mail.sender, mail.source, t_utc_ns, utc_ns))
            case FleetFix():
                self._place(of_centre(mail, utc_ns))

    def _queue(self, message: ShortMessage) -> None:
        self.revision += 1
        self._unconfirmed[message.serial] = message
        if len(self._unconfirmed) > MOST_UNCONFIRMED:
            self._unconfirmed.popitem(last=False)
            self._count(message.source, "message_untold")
        self.waiting.append((MESSAGE, message))

    def _place(self, message: FleetMessage) -> None:
        """Publish a card's place unless a later one is known: reports may overtake each other."""
        card, t_ms = message.card, message.t_ms
        if card not in self._places and len(self._places) >= MOST_CARDS:
            self._count(message.source, "fleet_full")
        elif t_ms is not None and t_ms < self._places.get(card, 0):
            self._count(message.source, "fleet_overtaken")
        else:
            self._places[card] = t_ms or 0
            self.waiting.append((fleet(card), message))

    def _count(self, source: str, counter: str) -> None:
        self._terminals[source].counters[counter] += 1

    # ------------------------------------------------------------------ published and stored

    def take_waiting(self) -> Iterator[tuple[Topic, Message]]:
        """Take the messages to publish that came since the last call."""
        while self.waiting:
            yield self.waiting.popleft()

    def confirm(self, message: object) -> None:
        """Note that a broker has confirmed a message, or that there is no broker to confirm it."""
        if isinstance(message, ShortMessage) and message.serial in self._unconfirmed:
            del self._unconfirmed[message.serial]
            self.revision += 1

    def state(self, t_ns: int) -> KeptMessages:
        """State that must outlive the process."""
        from fusiond.live.stored_messages import KeptMessages, kept_box  # noqa: PLC0415

        utc_ns = self._clock.utc_ns(t_ns)
        return KeptMessages(
            self._serial,
            {n: kept_box(d.outbox, d.inbox, t_ns) for n, d in self._terminals.items()},
            tuple(self._unconfirmed.values()),
            None if utc_ns is None else utc_ns * 1e-9,
        )

    def resume(self, kept: KeptMessages) -> None:
        """Resume with the last run's state, as of the instant of its restore."""
        from fusiond.live.stored_messages import restore  # noqa: PLC0415

        t_ns = kept.taken_up_ns or 0
        self._serial = max(self._serial, kept.serial)
        for message in kept.untold:
            self._unconfirmed[message.serial] = message
            self.waiting.append((MESSAGE, message))
        for name, box in kept.boxes.items():
            driver = self._terminals.get(name)
            if driver is not None:
                restore(box, driver.outbox, driver.inbox, t_ns)
                driver.report_stages(t_ns)
            elif box.waiting:
                text = f"no source {name!r} any more: {len(box.waiting)} messages are given up"
                self._on_event("messages", "message_failed", text)


def _known(value: float) -> float | None:
    return value if isfinite(value) else None


def _utc_of(report: PositionReport, seen_utc_ns: int | None) -> int | None:
    """UTC of a report's position (ns). A report without a date is from the last 24 hours."""
    if report.dated:
        return round(report.t_s * SECOND_NS)
    if seen_utc_ns is None:
        return None
    day_ns = DAY_S * SECOND_NS
    t_ns = seen_utc_ns // day_ns * day_ns + round(report.t_s * SECOND_NS)
    return t_ns if t_ns <= seen_utc_ns + AHEAD_NS else t_ns - day_ns
