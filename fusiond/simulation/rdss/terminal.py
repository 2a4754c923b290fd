"""Simulated RDSS user terminal, as seen by its host, in both wire families; no I/O and no clock.

`receive` takes the host's bytes, `read` returns the terminal's bytes up to an instant. A position
request that is accepted is answered by a feedback and, 0.6 to 5 s later, by the position that the
vehicle had when the terminal's burst left the antenna, with the time of day of that instant.
Failures are set by `RdssOptions` (probabilities) and by the terminal's public attributes, at any
time.

Source: the public interface documents as in `drivers.rdss`.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import count

import numpy as np

from drivers.rdss import binary_4_0, text_2_1
from drivers.rdss.messages import (
    BeamPower,
    BeamPowerRequest,
    Decoder,
    DeviceClock,
    EncodeError,
    Feedback,
    Fix,
    HeightMode,
    Identity,
    IdentityRequest,
    Message,
    Outcome,
    OutputRequest,
    PositionRequest,
    Reply,
    SelfTest,
    SelfTestRequest,
    StopRequest,
    Subordinates,
    Text,
    TextRequest,
    TimeRequest,
    Unknown,
    VersionRequest,
)
from drivers.rdss.text_coding import EncodedText, card_level_bits
from drivers.standard_atmosphere import pressure_height_m
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.rdss.centre import RdssCentre, RdssOptions

Carry = Callable[[int, TextRequest, float], None]
"""Callback for a message that has been sent: sender's card, message, instant (s)."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FOREIGN_USER = 242407
USABLE_BEAM_LEVEL = 2
"""Least level, 0 to 4, of the best beam with which a terminal can transmit."""
LOW_BATTERY_PERCENT = 10.0
_LOCKED = (0, 3, 4, 0, 2, 0)


class RdssTerminal:
    """The terminal. Times are seconds of the trajectory; `utc_start_ns` is UTC at its 0.

    `beam_levels`, `battery_percent`, `suppressed`, `silent` and `utc_start_ns` may be set from
    outside; `lift` ends a suppression or a silence as a terminal does, with a notice. Counters: the
    name of every request class, `fixes`, `foreign`, `dropped`, `muted`, `texts` (handed over),
    `unsayable` (the family has no such message), `refused_<outcome>`, `too_early` (transmissions
    asked for within the card's spacing). `bursts_s` are the instants of all transmissions.
    """

    def __init__(
        self, truth: Truth, options: RdssOptions, rng: np.random.Generator, utc_start_ns: int
    ) -> None:
        self.options = options
        self.beam_levels: tuple[int, ...] = _LOCKED
        self.battery_percent = 100.0
        self.suppressed = False
        self.silent = False
        self.counters: Counter[str] = Counter()
        self._centre = RdssCentre(truth, options, rng)
        self.utc_start_ns = utc_start_ns
        binary = options.family == "4.0"
        self._decoder: Decoder = binary_4_0.Decoder() if binary else text_2_1.Decoder()
        self._encode = binary_4_0.encode if binary else text_2_1.encode
        self.carry: Carry = lambda card, message, t_s: None
        self.bursts_s: list[float] = []
        self._last_burst_s = -math.inf
        self._queue: list[tuple[float, int, bytes]] = []
        self._order = count()
        self._periodic: dict[str, tuple[float, float, Callable[[float], None]]] = {}

    # ------------------------------------------------------------------ bytes and instants

    def receive(self, data: bytes, t_s: float) -> None:
        """Receive the host's bytes up to the instant `t_s`."""
        for message in self._decoder.feed(data):
            self.counters[type(message).__name__] += 1
            self._answer(message, t_s)

    @property
    def next_s(self) -> float:
        """Next instant of the terminal; infinity for never."""
        replies = self._queue[0][0] if self._queue else math.inf
        return min([replies, *(due for due, _, _ in self._periodic.values())])

    def read(self, t_s: float) -> bytes:
        """Bytes sent by the terminal until `t_s`, in order."""
        for name, (first, period, action) in list(self._periodic.items()):
            due = first
            while due <= t_s:
                action(due)
                due += period
            self._periodic[name] = (due, period, action)
        said = b""
        while self._queue and self._queue[0][0] <= t_s:
            said += heapq.heappop(self._queue)[2]
        return said

    def lift(self, t_s: float) -> None:
        """End suppression and silence at `t_s` and send the unsolicited feedback on it.

        Family 4.0: flag 8, as the one vendor has it that documents a notice. Family 2.1: inhibit 0.
        """
        self.suppressed = self.silent = False
        binary = self.options.family == "4.0"
        notice = Feedback(
            Outcome.SILENCE_OR_LIFTED if binary else Outcome.OK,
            command="DWSQ" if binary else "DWA",
            user=self.options.user,
        )
        self._say(t_s + self.options.reply_s, notice)

    def hand_over(self, text: Text, due_s: float) -> None:
        """Deliver a message for this card; it is printed with the centre's time."""
        local = self._local(due_s, self.options.zone_h)
        self.counters["texts"] += 1
        self._say(due_s, replace(text, minute_of_day=local.hour * 60 + local.minute))

    def _say(self, due_s: float, message: Reply | Unknown) -> None:
        try:
            heapq.heappush(self._queue, (due_s, next(self._order), self._encode(message)))
        except EncodeError:
            self.counters["unsayable"] += 1

    def _repeat(
        self, name: str, t_s: float, period_s: int, action: Callable[[float], None]
    ) -> None:
        """Execute an action now and, with a period, repeatedly."""
        self._periodic.pop(name, None)
        action(t_s)
        if period_s > 0:
            self._periodic[name] = (t_s + period_s, float(period_s), action)

    # ------------------------------------------------------------------ requests

    def _answer(self, message: Message, t_s: float) -> None:
        o = self.options
        match message:
            case IdentityRequest(index=0):
                identity = Identity(
                    o.user, o.service_frequency_s, 11, 6, o.comm_level, serial=o.user
                )
                self._say(t_s + o.reply_s, identity)
            case IdentityRequest():
                self._say(t_s + o.reply_s, Subordinates(o.user, message.index, ()))
            case BeamPowerRequest():
                self._repeat("GLJC", t_s, message.period_s, self._say_beams)
            case SelfTestRequest():
                self._repeat("XTZJ", t_s, message.period_s, self._say_state)
            case TimeRequest():
                self._repeat("SJSC", t_s, message.period_s, self._say_time)
            case VersionRequest():
                self._say(t_s + o.reply_s, Unknown("BBXX", b"fusiond simulation", o.user))
            case StopRequest():
                self._periodic.pop(message.command, None)
            case OutputRequest(mode=1 | 3):
                for name in _SENTENCES.get(message.sentence, tuple(self._periodic)):
                    self._periodic.pop(name, None)
            case PositionRequest():
                self._repeat(
                    "DWSQ", t_s, message.period_s, lambda due: self._position(message, due)
                )
            case TextRequest():
                wording = EncodedText(message.payload, message.encoding, message.odd)
                fits = wording.bits <= card_level_bits(o.comm_level)
                if self._transmit("TXSQ", "TXA", t_s, None if fits else Outcome.FAILED):
                    self.carry(o.user, message, t_s)

    def _say_beams(self, t_s: float) -> None:
        o = self.options
        levels = self.beam_levels if o.family == "4.0" else (*self.beam_levels, 0, 0, 0, 0)[:10]
        best = max(range(len(levels)), key=levels.__getitem__) + 1
        self._say(t_s + o.reply_s, BeamPower(levels, o.user, best, 0))

    def _say_state(self, t_s: float) -> None:
        o = self.options
        state = self.suppressed << 7 | self.silent << 6
        test = SelfTest(
            self.battery_percent,
            user=o.user,
            inbound_state=state,
            levels=self.beam_levels,
            remaining_min=240,
        )
        self._say(t_s + o.reply_s, test)

    def _say_time(self, t_s: float) -> None:
        o = self.options
        due = t_s + o.reply_s
        local = self._local(due, o.zone_h if o.family == "4.0" else 0)
        midnight = local.replace(hour=0, minute=0, second=0, microsecond=0)
        clock = DeviceClock(
            local.year,
            local.month,
            local.day,
            (local - midnight).total_seconds(),
            user=o.user,
            zone_h=-o.zone_h,
            locked=max(self.beam_levels) > 0,
        )
        self._say(due, clock)

    def _local(self, t_s: float, zone_h: int) -> datetime:
        """The time in a zone, to 10 ms."""
        hundredths = round((self.utc_start_ns + t_s * 1e9) / 1e7) + zone_h * 360_000
        return _EPOCH + timedelta(milliseconds=10 * hundredths)

    def _refusal(self, t_s: float) -> tuple[Outcome, float | None] | None:
        """Reason why nothing can be sent, in the terminal's order of checks."""
        binary = self.options.family == "4.0"
        if self.silent:
            return (Outcome.SILENCE_OR_LIFTED if binary else Outcome.SILENCE), None
        if self.suppressed:
            return Outcome.SUPPRESSED, None
        if self.battery_percent < LOW_BATTERY_PERCENT:
            return Outcome.LOW_BATTERY, None
        no_beam = Outcome.NOT_LOCKED if binary else Outcome.NOT_SENT
        if max(self.beam_levels) < USABLE_BEAM_LEVEL:
            return no_beam, None
        spacing = self.options.service_frequency_s
        wait = self._last_burst_s + spacing - t_s
        if wait > 0.0:
            self.counters["too_early"] += 1
            return Outcome.FREQUENCY, float(math.ceil(wait))
        match self._centre.refused():
            case "no_beam":
                return no_beam, None
            case "other_host":
                self._last_burst_s = self._centre.other_burst_s(t_s)
                return Outcome.FREQUENCY, float(round(self._last_burst_s + spacing - t_s))
        return None

    def _transmit(
        self, command_4_0: str, command_2_1: str, t_s: float, wrong: Outcome | None = None
    ) -> bool:
        """Send the feedback and return True if a burst left the antenna. `wrong` is the defect of
        the request, if any."""
        o = self.options
        if self._centre.mute():
            self.counters["muted"] += 1
            return False
        refusal = self._refusal(t_s) if wrong is None else (wrong, None)
        outcome, wait = refusal or (Outcome.OK, None)
        if refusal is None:
            self._last_burst_s = t_s
            self.bursts_s.append(t_s)
        else:
            self.counters[f"refused_{outcome}"] += 1
        local = self._local(t_s, o.zone_h)
        printed = local.hour * 3600 + local.minute * 60 + local.second
        feedback = Feedback(
            outcome,
            command=command_4_0 if o.family == "4.0" else command_2_1,
            wait_s=wait,
            user=o.user,
            time_of_day_s=printed if o.bds3_feedback else None,
        )
        self._say(t_s + o.reply_s, feedback)
        return refusal is None

    def _position(self, request: PositionRequest, t_s: float) -> None:
        o = self.options
        if not self._transmit("DWSQ", "DWA", t_s):
            return
        if self._centre.dropped():
            self.counters["dropped"] += 1
            return
        given = request.height_m if request.height_mode is HeightMode.GIVEN else None
        if request.height_mode is HeightMode.ALTIMETER_1 and request.pressure_pa:
            given = pressure_height_m(request.pressure_pa)  # the weather is the standard's
        fix = self._centre.fix(t_s + o.response_s, given)
        local = self._local(fix.t_s, o.zone_h)
        seconds = local.hour * 3600 + local.minute * 60 + local.second
        fraction = local.microsecond * 1e-6
        message = Fix(
            user=o.user,
            time_of_day_s=seconds + fraction,
            lat_deg=fix.lat_deg,
            lon_deg=fix.lon_deg,
            height_m=fix.height_m,
            height_anomaly_m=o.height_anomaly_m,
            precision_class_m=fix.precision_class_m,
            fraction=int(fraction / o.fraction_s + 1e-6) if o.family == "4.0" else None,
            multi_value=fix.multi_value,
            emergency=request.emergency,
        )
        self._say(fix.t_arrival_s, message)
        self.counters["fixes"] += 1
        if self._centre.foreign():
            self._say(fix.t_arrival_s - 0.1, self._foreign(message))
            self.counters["foreign"] += 1

    def _foreign(self, own: Fix) -> Fix:
        """The result of somebody's query of another user, 0.1 deg away."""
        return Fix(
            user=self.options.user if self.options.family == "4.0" else _FOREIGN_USER,
            time_of_day_s=own.time_of_day_s,
            lat_deg=own.lat_deg + 0.1,
            lon_deg=own.lon_deg,
            height_m=own.height_m,
            kind="query",
            queried=_FOREIGN_USER if self.options.family == "4.0" else 0,
            fraction=own.fraction,
        )


_SENTENCES = {"BSI": ("GLJC",), "ZTI": ("XTZJ",), "ZDA": ("SJSC",), "DWR": ("DWSQ",)}
