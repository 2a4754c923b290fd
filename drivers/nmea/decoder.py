"""Bytes of a GNSS receiver in, measurements out: epochs grouped, dated, judged. No I/O, no clock.

An epoch closes when the time of day changes, when a sentence repeats, when its last one came, or
on `silence`. Which one is the last is configured, or learned: the same cycle seen twice in a row.
"""

from __future__ import annotations

import math
from collections import Counter
from datetime import date
from typing import Literal

from drivers.base import DriverOptions
from drivers.measurements import (
    ArrivalStamp,
    Heading,
    Measurement,
    PositionFix,
    Stamp,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.epochs import (
    FORMATTERS,
    MAX_CYCLE,
    TALKERS,
    BadFieldError,
    Epoch,
    time_of_day_ns,
)
from drivers.nmea.framing import NmeaSplitter, Sentence, is_rdss_sentence
from drivers.nmea.time import SECOND_NS, Calendar, EpochOrder, TimeTrust, posix_ns
from drivers.plausible import SIGMA_M

BUILD_DATE = date(2026, 11, 20)
"""No receiver can truly report a date before this software was written."""
MAX_UNLEARNED = 8
"""Cycles remembered as too short; a receiver mixes at most a few output rates."""

_QUALITIES = frozenset({1, 2, 3, 4, 5})
Formatter = Literal["GGA", "GNS", "RMC", "VTG", "GSA", "GST", "ZDA", "HDT", "THS"]


class NmeaDecoding(DriverOptions):
    """What the decoder may be told."""

    last_sentence: Formatter | None = None
    """The sentence that ends an epoch (one that is sent once an epoch); learned by default."""
    heading_offset_deg: float = 0.0
    """Added to HDT and THS: from the antenna baseline to the vehicle's forward axis, clockwise."""
    earliest_date: date = BUILD_DATE
    """Dates before it are refused; set it back to read old logs."""
    allow_simulator: bool = False
    """Accept quality 7 (manual) and 8 (simulator)."""


class NmeaDecoder:
    """`feed` bytes, get measurements; `flush` at the end of the file.

    Counts, beside those of `NmeaSplitter`, `Calendar` and `EpochOrder`: `epochs`, `fixes`;
    refused sentences `other_talker`, `unused_sentence`, `rdss_sentence`, `bad_field`,
    `repeated_sentence`; noted `late_sentence`; refused epochs `no_fix`,
    `dead_reckoning_refused`, `manual_refused`, `simulator_refused`, `unknown_quality`,
    `height_implausible`, `speed_implausible`, `sigma_too_large`; within one `heading_mode_refused`,
    `height_not_measured`, `sigma_too_small`, `untimed_epoch`.
    """

    def __init__(
        self,
        source: str,
        decoding: NmeaDecoding | None = None,
        counters: Counter[str] | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self.refusal = ""
        """Why the last epoch was refused, by counter name; empty when it was not."""
        self.gga = b""
        """The last GGA with a position, without its line end; empty before one."""
        self._source = source
        self._decoding = decoding or NmeaDecoding()
        self._splitter = NmeaSplitter(self.counters)
        self._calendar = Calendar(self._decoding.earliest_date, self.counters)
        self._order = EpochOrder(self.counters)
        self._trust = TimeTrust()
        self._epoch: Epoch | None = None
        self._t_seen_ns = 0
        self._closed_ns: int | None = None
        self._closed_at_once = False
        self._last_cycle: tuple[str, ...] = ()
        self._learned: tuple[str, ...] = ()
        self._too_short: set[tuple[str, ...]] = set()

    @property
    def epoch_open(self) -> bool:
        """Whether `silence` would close an epoch."""
        return self._epoch is not None

    def feed(self, data: bytes, t_seen_ns: int) -> list[Measurement]:
        """The measurements that `data`, seen at `t_seen_ns`, completes."""
        found: list[Measurement] = []
        self._t_seen_ns = t_seen_ns
        for sentence in self._splitter.feed(data):
            self._take(sentence, t_seen_ns, found)
        return found

    def take(self, sentence: Sentence, t_seen_ns: int) -> list[Measurement]:
        """As `feed`, for a sentence that somebody else has verified."""
        found: list[Measurement] = []
        self._t_seen_ns = t_seen_ns
        self._take(sentence, t_seen_ns, found)
        return found

    def silence(self) -> list[Measurement]:
        """The line has been silent for longer than any receiver pauses inside an epoch (50 ms)."""
        found: list[Measurement] = []
        self._close(found, learn=True)
        return found

    def flush(self) -> list[Measurement]:
        """The stream ended, or broke: everything that can still be had from what came."""
        found: list[Measurement] = []
        for sentence in self._splitter.finish():
            self._take(sentence, self._t_seen_ns, found)
        self._close(found, learn=False)
        return found

    # ----------------------------------------------------------------- sentences to epochs

    def _take(self, sentence: Sentence, t_seen_ns: int, found: list[Measurement]) -> None:
        if is_rdss_sentence(sentence):
            self.counters["rdss_sentence"] += 1
            return
        if sentence.formatter not in FORMATTERS:
            self.counters["unused_sentence"] += 1
            return
        if sentence.talker not in TALKERS:
            self.counters["other_talker"] += 1
            return
        try:
            self._group(sentence, t_seen_ns, found)
        except BadFieldError:
            self.counters["bad_field"] += 1
            return
        if sentence.formatter == "GGA" and sentence.fields[5:6] not in ((), ("",), ("0",)):
            self.gga = sentence.raw

    def _group(self, sentence: Sentence, t_seen_ns: int, found: list[Measurement]) -> None:
        formatter, time_ns = sentence.formatter, time_of_day_ns(sentence)
        epoch = self._epoch
        if epoch is not None:
            again = formatter in epoch.cycle and formatter != "GSA"
            if (
                (time_ns is not None and epoch.time_of_day_ns not in (None, time_ns))
                or (again and sentence.address in epoch.addresses)
                or len(epoch.cycle) >= MAX_CYCLE
            ):
                self._close(found, learn=True)
            elif again:  # of another talker: the same fix by another name
                self.counters["repeated_sentence"] += 1
                return
        elif time_ns is None and self._closed_at_once and formatter not in self._last_cycle:
            self._late()
            return
        epoch = self._epoch or Epoch()
        epoch.take(sentence, t_seen_ns)
        self._epoch = epoch
        if epoch.time_of_day_ns is None and time_ns is not None:
            epoch.time_of_day_ns = time_ns
            if time_ns == self._closed_ns and formatter not in self._last_cycle:
                self._late()
        if formatter == self._decoding.last_sentence or (
            self._decoding.last_sentence is None and tuple(epoch.cycle) == self._learned
        ):
            self._close(found, learn=False)
            self._closed_at_once = True

    def _late(self) -> None:
        """More of an epoch that was closed at once: what was learned is too short."""
        self.counters["late_sentence"] += 1
        if self._learned and len(self._too_short) < MAX_UNLEARNED:
            self._too_short.add(self._learned)
        self._learned = self._last_cycle = ()

    def _close(self, found: list[Measurement], *, learn: bool) -> None:
        epoch, self._epoch = self._epoch, None
        if epoch is None:
            return
        cycle = tuple(epoch.cycle)
        if learn and cycle == self._last_cycle and cycle not in self._too_short:
            self._learned = cycle
        self._last_cycle = cycle
        self._closed_at_once = False
        self._closed_ns = epoch.time_of_day_ns
        self._judge(epoch, found)

    # ----------------------------------------------------------------- epochs to measurements

    def _judge(self, epoch: Epoch, found: list[Measurement]) -> None:
        self.counters["epochs"] += 1
        refusal = self._refusal(epoch)
        day = self._date(epoch, found, valid=refusal is None)
        self.refusal = refusal or ""
        if refusal is not None:
            self.counters[refusal] += 1
        position = epoch.position() if refusal is None else None
        heading_deg = epoch.heading_deg if self._heading_ok(epoch, refusal) else None
        if position is None and heading_deg is None:
            return
        stamp: Stamp
        if epoch.time_of_day_ns is None:
            self.counters["untimed_epoch"] += 1
            stamp, position = ArrivalStamp(), None
        elif not self._order.accept(day, epoch.time_of_day_ns):
            self.refusal = "duplicate_epoch"
            return
        elif day is not None:
            stamp = UtcStamp(posix_ns(day, epoch.time_of_day_ns))
        else:
            stamp = TimeOfDayStamp(epoch.time_of_day_ns / SECOND_NS)
        if position is not None:
            found.append(self._fix(epoch, stamp, *position))
        if heading_deg is not None:
            yaw = math.radians(heading_deg + self._decoding.heading_offset_deg)
            yaw = math.remainder(yaw, math.tau)
            found.append(Heading(self._source, epoch.t_seen_ns, stamp, yaw))

    def _refusal(self, epoch: Epoch) -> str | None:
        """Why this epoch gives no position; None when it does, or was never to give one."""
        if epoch.quality == 6 or "E" in epoch.modes:
            return "dead_reckoning_refused"
        if not self._decoding.allow_simulator:
            if epoch.quality == 7 or "M" in epoch.modes:
                return "manual_refused"
            if epoch.quality == 8 or "S" in epoch.modes:
                return "simulator_refused"
        if epoch.quality == 0 or epoch.rmc_valid is False:
            return "no_fix"
        if epoch.quality is None:
            return None
        if epoch.lat_deg is None:
            return "no_fix"
        simulated = self._decoding.allow_simulator and epoch.quality in (7, 8)
        if not (epoch.quality in _QUALITIES or simulated):
            return "unknown_quality"
        return epoch.implausible()

    def _date(self, epoch: Epoch, found: list[Measurement], *, valid: bool) -> date | None:
        """The epoch's date, its own or the calendar's; reports the time when it is its own."""
        if epoch.time_of_day_ns is None:
            return None
        if epoch.day is None or not self._calendar.plausible(epoch.day):
            return self._calendar.date_of(epoch.time_of_day_ns, epoch.t_seen_ns)
        # RMC says itself whether its time is valid; for ZDA the position of its epoch does.
        believed = valid and bool(epoch.quality) if epoch.rmc_valid is None else epoch.rmc_valid
        if believed:
            self._calendar.dated(epoch.day, epoch.time_of_day_ns, epoch.t_seen_ns)
        utc_ns = posix_ns(epoch.day, epoch.time_of_day_ns)
        trusted = self._trust.report(utc_ns, epoch.t_day_seen_ns, valid=believed)
        if trusted is not None:
            found.append(TimeReport(self._source, epoch.t_day_seen_ns, utc_ns, trusted))
        return epoch.day

    def _heading_ok(self, epoch: Epoch, refusal: str | None) -> bool:
        """THS mode A only; HDT has no mode and shares the fate of the position beside it."""
        if epoch.heading_deg is None or epoch.heading_mode == "A":
            return True
        if epoch.heading_mode is None and refusal is None:
            return True
        self.counters["heading_mode_refused"] += 1
        return False

    def _fix(
        self, epoch: Epoch, stamp: Stamp, lat_deg: float, lon_deg: float, quality: int
    ) -> PositionFix:
        self.counters["fixes"] += 1
        height = None
        if epoch.altitude_m is not None and epoch.separation_m is not None:
            height = epoch.altitude_m + epoch.separation_m
        if epoch.two_dimensional and height is not None:
            self.counters["height_not_measured"] += 1
            height = None
        sd_ned_m = epoch.sd_ned_m
        if sd_ned_m is not None and min(sd_ned_m) < SIGMA_M[0]:
            self.counters["sigma_too_small"] += 1
            sd_ned_m = None
        return PositionFix(
            self._source,
            epoch.t_seen_ns,
            stamp,
            math.radians(lat_deg),
            math.radians(lon_deg),
            height,
            quality,
            epoch.satellites,
            epoch.hdop,
            epoch.vdop,
            sd_ned_m,
            epoch.v_ned_m_s(),
        )
