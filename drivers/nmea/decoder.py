"""Bytes of a GNSS receiver in, measurements out: epochs grouped, dated, judged. No I/O, no clock.

An epoch closes when the time of day changes, when a sentence repeats, when its last one came, or
on `silence`. Which one is the last is configured, or learned, as is where a receiver pauses inside
an epoch (drivers.nmea.cycle).
"""

from __future__ import annotations

import math
from collections import Counter
from datetime import date
from typing import Literal

from drivers.decoding import SolutionDecoding
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
from drivers.nmea.cycle import Cycle
from drivers.nmea.epochs import (
    FORMATTERS,
    INTEGRATED,
    MAX_CYCLE,
    TALKERS,
    BadFieldError,
    Epoch,
    time_of_day_ns,
)
from drivers.nmea.framing import NmeaSplitter, Sentence, is_rdss_sentence
from drivers.nmea.geoid import Geoid
from drivers.nmea.reasons import (
    FULLER,
    OWN_SENTENCES,
    POSITIONS,
    Heard,
    cautions,
    no_fix,
    note,
    nothing_verified,
)
from drivers.nmea.time import (
    SECOND_NS,
    Calendar,
    EpochOrder,
    TimeTrust,
    one_time,
    posix_ns,
    time_step_ns,
)
from drivers.plausible import SIGMA_M

PLAIN_AFTER = 2
"""Epochs with RMC or GLL in a row that have neither GGA nor GNS, after which their position is a
fix: one may be damaged. A GGA at an instant of its own is none of these (plotters take turns)."""

_TIMELESS = frozenset({"GSA", "VTG"})
_QUALITIES = frozenset({1, 2, 3, 4, 5})
Formatter = Literal["GGA", "GNS", "RMC", "GLL", "VTG", "GSA", "GST", "ZDA", "HDT", "THS"]


class NmeaDecoding(SolutionDecoding):
    """Options of the decoder."""

    last_sentence: Formatter | None = None
    """The sentence that ends an epoch (one that is sent once an epoch); learned by default."""


class NmeaDecoder:
    """`feed` bytes, get measurements; `flush` at the end of the file.

    Counts, beside those of `NmeaSplitter`, `Calendar` and `EpochOrder`: `epochs`, `fixes`;
    refused sentences `other_talker`, `unused_sentence`, `rdss_sentence`, `bad_field`,
    `repeated_sentence`; noted `late_sentence`; refused epochs `no_fix`,
    `dead_reckoning_refused`, `manual_refused`, `simulator_refused`, `unknown_quality`,
    `height_implausible`, `speed_implausible`, `sigma_too_large`; within one `heading_mode_refused`,
    `height_not_measured`, `height_above_sea`, `rmc_alone`, `gll_alone`, `gga_awaited`,
    `integrated`, `unknown_status`, `sigma_too_small`, `untimed_epoch`.
    """

    def __init__(
        self,
        source: str,
        decoding: NmeaDecoding | None = None,
        counters: Counter[str] | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self.refusal = ""
        """Reason why the last epoch was refused, by counter name; empty when it was not."""
        self.gga = b""
        """The last GGA with a position, without its line end; empty before one."""
        self.heard = Heard()
        self._source = source
        self._decoding = decoding or NmeaDecoding()
        self._splitter = NmeaSplitter(self.counters)
        self._calendar = Calendar(self._decoding.earliest_date, self.counters)
        self._order = EpochOrder(self.counters)
        self._trust = TimeTrust()
        self._epoch: Epoch | None = None
        self._t_seen_ns = 0
        self._geoid = Geoid()
        self._cycle = Cycle()
        self._closed: Epoch | None = None
        """The epoch before."""
        self._closed_by = ""
        """Closing event: `last` sentence, `silence`, or what came then."""
        self._raw_before = b""
        """The sentence before."""
        self._doubling = False
        """True if that was said twice."""
        self._without_gga = 0
        """Epochs with RMC or GLL in a row that had neither GGA nor GNS."""

    @property
    def cautions(self) -> dict[str, str]:
        """By counter: what makes the fixes poorer than they could be, and what was done."""
        return cautions(self.counters, self.heard, self._decoding.earliest_date)

    @property
    def cause(self) -> str:
        """Reason why there is no fix, as a sentence; "" where bytes say nothing of why none
        verifies."""
        if not self.counters["sentences"]:
            return nothing_verified(self.counters, self._splitter.unread)
        return no_fix(self.counters, self.heard, self.refusal)

    @property
    def epoch_open(self) -> bool:
        """True if `silence` would close an epoch."""
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
        """The line has been silent for longer than most receivers pause inside an epoch (50 ms)."""
        found: list[Measurement] = []
        epoch = self._epoch
        if epoch is None or self._cycle.pauses(epoch.cycle) or _is_tail(epoch):
            return found
        self._close(found, learn=True, by="silence")
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
            own = sentence.talker == "P" or sentence.address in OWN_SENTENCES
            note(self.heard.unused, sentence.address if own else sentence.formatter)
            return
        if sentence.talker not in TALKERS:
            self.counters["other_talker"] += 1
            if sentence.formatter in POSITIONS:
                note(self.heard.talkers, sentence.talker)
            return
        try:
            self._group(sentence, t_seen_ns, found)
        except BadFieldError:
            self.counters["bad_field"] += 1
            return
        note(self.heard.used, sentence.formatter)
        if sentence.formatter == "GGA" and sentence.fields[5:6] not in ((), ("",), ("0",)):
            self.gga = sentence.raw

    def _group(self, sentence: Sentence, t_seen_ns: int, found: list[Measurement]) -> None:
        formatter, time_ns = sentence.formatter, time_of_day_ns(sentence)
        if self._doubled(sentence, time_ns):
            self.counters["repeated_sentence"] += 1
            return
        epoch = self._epoch
        if formatter == "GLL" and time_ns is not None and self._told_already(time_ns, sentence):
            self.counters["unused_sentence"] += 1
            return
        if epoch is not None and time_ns is not None and self._belongs_before(epoch, t_seen_ns):
            epoch = self._epoch = None
            self._late()
        if epoch is not None:
            again = formatter in epoch.cycle and formatter != "GSA"
            if (
                (time_ns is not None and not self._of_epoch(epoch, time_ns, sentence))
                or (again and sentence.address in epoch.addresses)
                or len(epoch.cycle) >= MAX_CYCLE
            ):
                self._close(found, learn=True)
            elif again:  # of another talker: the same fix by another name
                self.counters["repeated_sentence"] += 1
                return
        elif time_ns is None and self._closed_by == "last" and formatter not in self._cycle.last:
            self._late()
            return
        epoch = self._epoch or Epoch()
        epoch.take(sentence, t_seen_ns)
        self._epoch = epoch
        if epoch.time_of_day_ns is None and time_ns is not None:
            epoch.time_of_day_ns, epoch.time_step_ns = time_ns, time_step_ns(sentence)
            closed = self._closed
            if (
                closed is not None
                and closed.time_of_day_ns is not None
                and formatter not in self._cycle.last
                and self._of_epoch(closed, time_ns, sentence)
            ):
                self._late()
        elif time_ns is not None and time_step_ns(sentence) < epoch.time_step_ns:
            epoch.time_of_day_ns, epoch.time_step_ns = time_ns, time_step_ns(sentence)
        if formatter == self._decoding.last_sentence or (
            self._decoding.last_sentence is None and self._cycle.whole(epoch.cycle)
        ):
            self._close(found, learn=False, by="last")

    def _doubled(self, sentence: Sentence, time_ns: int | None) -> bool:
        """True if the line says each sentence twice, or each burst: two ports of a receiver in one
        log. The third time it is a receiver that repeats itself."""
        raw, before = sentence.raw, self._raw_before
        self._raw_before = raw
        epoch = self._epoch
        if epoch is None and self._closed_by == "last" and raw == before:
            epoch = self._closed
        if epoch is None or raw not in epoch.raws or epoch.time_of_day_ns is None:
            self._doubling = False
        else:
            self._doubling = time_ns is not None or self._doubling or raw == before
            if self._doubling:
                epoch.raws.discard(raw)
        return self._doubling

    def _of_epoch(self, epoch: Epoch, time_ns: int, sentence: Sentence) -> bool:
        """True if a sentence with a time is of an epoch, by that alone."""
        if epoch.time_of_day_ns is None:
            return True
        step_ns = time_step_ns(sentence)
        return one_time(epoch.time_of_day_ns, epoch.time_step_ns, time_ns, step_ns)

    def _told_already(self, time_ns: int, sentence: Sentence) -> bool:
        """True if the place at this instant came by a sentence that says more: many a burst ends
        with GLL, behind all GSV, and the epoch would wait for it."""
        epoch = self._epoch if self._epoch is not None else self._closed
        if epoch is None or epoch.time_of_day_ns is None or FULLER.isdisjoint(epoch.cycle):
            return False
        return self._of_epoch(epoch, time_ns, sentence)

    def _belongs_before(self, epoch: Epoch, t_seen_ns: int) -> bool:
        """True if what has no time of its own came sooner after the epoch that a silence closed
        than before the one that begins now."""
        closed = self._closed
        if closed is None or self._closed_by != "silence" or not _is_tail(epoch):
            return False
        return epoch.t_seen_ns - closed.t_seen_ns < t_seen_ns - epoch.t_seen_ns

    def _late(self) -> None:
        """More of an epoch that was closed: where it was closed is learned anew."""
        self.counters["late_sentence"] += 1
        self._without_gga = 0  # an epoch in two parts has what one of them lacked
        if self._closed_by == "silence":
            self._cycle.paused()
        else:
            self._cycle.too_short()

    def _close(self, found: list[Measurement], *, learn: bool, by: str = "") -> None:
        epoch, self._epoch = self._epoch, None
        if epoch is None:
            return
        self._cycle.ended(epoch.cycle, learn=learn)
        self._closed, self._closed_by = epoch, by
        self._judge(epoch, found)

    # ----------------------------------------------------------------- epochs to measurements

    def _judge(self, epoch: Epoch, found: list[Measurement]) -> None:
        self.counters["epochs"] += 1
        if epoch.unknown_status:
            self.counters["unknown_status"] += 1
            note(self.heard.statuses, epoch.unknown_status)
        if epoch.quality is None and epoch.plain_valid is not None:
            self._without_gga += 1
            if self._without_gga >= PLAIN_AFTER:
                epoch.take_plain()
            elif epoch.plain_valid:
                self.counters["gga_awaited"] += 1
        elif epoch.plain_valid is not None:
            self._without_gga = 0
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
        """Reason why this epoch gives no position; None when it does, or was never to give one."""
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
            return "no_fix" if epoch.plain_valid is False else None
        if epoch.place is None:
            return "no_fix"
        simulated = self._decoding.allow_simulator and epoch.quality in (7, 8)
        if not (epoch.quality in _QUALITIES or simulated):
            return "unknown_quality"
        return epoch.implausible()

    def _date(self, epoch: Epoch, found: list[Measurement], *, valid: bool) -> date | None:
        """The epoch's date, its own or the calendar's; reports the time when it is its own."""
        if epoch.time_of_day_ns is None:
            return None
        if epoch.day is not None and not self._calendar.plausible(epoch.day):
            self.heard.implausible_date = epoch.day
            epoch.day = None
        if epoch.day is None:
            return self._calendar.date_of(epoch.time_of_day_ns, epoch.t_seen_ns)
        # RMC says itself whether its time is valid; for ZDA the position of its epoch does.
        told = epoch.plain_valid if epoch.quality is None else epoch.rmc_valid
        believed = valid and bool(epoch.quality) if told is None else told
        if believed:
            self._calendar.dated(epoch.day, epoch.time_of_day_ns, epoch.t_seen_ns)
        elif told is None and epoch.quality is None and self.heard.used["RMC"]:
            return epoch.day  # a ZDA of another instant than RMC: some are seconds ahead of it
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
        if epoch.by_plain:
            self.counters["rmc_alone" if epoch.by_plain == "RMC" else "gll_alone"] += 1
        if not INTEGRATED.isdisjoint(address[:2] for address in epoch.addresses):
            self.counters["integrated"] += 1
        altitude, separation, height, geoid_sd_m = epoch.altitude_m, epoch.separation_m, None, 0.0
        if altitude is None:
            if not epoch.by_plain:
                self.counters["height_missing"] += 1
        elif epoch.two_dimensional:
            self.counters["height_not_measured"] += 1
        else:
            height, geoid_sd_m = self._geoid.height(altitude, separation, lat_deg, lon_deg)
            if separation is None:
                self.counters["height_above_sea"] += 1
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
            rounding_sd_ned_m=epoch.rounding_sd_ned_m,
            geoid_sd_m=geoid_sd_m,
        )


def _is_tail(epoch: Epoch) -> bool:
    """True if it has nothing but sentences that have no time and belong to another epoch."""
    return epoch.time_of_day_ns is None and _TIMELESS.issuperset(epoch.cycle)
