"""Conversion of an NMEA epoch into fix, heading or UTC report, or the name of a refusal. No I/O, no
clock.

Solutions in receivers' own protocols are validated by `drivers.solution`; NMEA states quality, date
and height in several ways.
"""

from __future__ import annotations

import math
from collections import Counter
from datetime import date

from drivers.decoder_options import SolutionDecoding
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
from drivers.nmea.epoch_assembly import INTEGRATED, Epoch
from drivers.nmea.geoid_fallback import Geoid, states_geoid
from drivers.nmea.printed_velocity import VelocityReader
from drivers.nmea.reasons import Received, count_name
from drivers.nmea.time import SECOND_NS, Calendar, EpochOrder, TimeTrust, posix_ns
from drivers.plausible import SIGMA_M

PLAIN_AFTER = 2
"""Consecutive epochs with RMC or GLL but neither GGA nor GNS, after which their position is a fix:
a single GGA may be damaged, where not all epochs before were so. A GGA at an instant of its own
does not count (plotters take turns)."""
_QUALITIES = frozenset({1, 2, 3, 4, 5})
DATUMS = frozenset({"", "W84", "P90"})
"""Datums of DTM: WGS 84, and PZ-90, which agrees with it to some centimetres since 2007 (PZ-90.02);
others differ by up to hundreds of metres."""


class EpochConverter:
    """Converter of epochs in order. Its counters are those of `NmeaDecoder`."""

    def __init__(
        self, source: str, decoding: SolutionDecoding, counters: Counter[str], received: Received
    ) -> None:
        self.counters = counters
        self.refusal = ""
        """Reason why the last epoch was refused, by counter name; empty when it was not."""
        self._source = source
        self._decoding = decoding
        self._received = received
        self._calendar = Calendar(decoding.earliest_date, counters)
        self._order = EpochOrder(counters)
        self._trust = TimeTrust()
        self._geoid = Geoid()
        self._velocity = VelocityReader(counters)
        self._without_gga = 0
        """Consecutive epochs with RMC or GLL but neither GGA nor GNS."""
        self._talker = ""
        """Talker of the last position."""

    def in_two_parts(self) -> None:
        """Note that the last two epochs were parts of one, which does have a GGA."""
        self._without_gga = 0

    def epoch(self, epoch: Epoch, found: list[Measurement]) -> None:
        """Judge a closed epoch; add the results to `found`."""
        self.counters["epochs"] += 1
        if epoch.place is not None and epoch.talker != self._talker:
            self.counters["two_receivers"] += bool(self._talker)
            self._talker = epoch.talker
        if epoch.unknown_status:
            self.counters["unknown_status"] += 1
            count_name(self._received.statuses, epoch.unknown_status)
        if epoch.no_date:
            self.counters["bad_date"] += 1
            self._received.no_date = epoch.no_date
        if epoch.quality is None and epoch.place is not None:
            epoch.take_mode()
        if epoch.quality is None and epoch.plain_valid is not None:
            self._without_gga += 1
            if epoch.whole or self._without_gga >= PLAIN_AFTER:
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
        """Reason why this epoch gives no position; None if it gives one, or none is expected."""
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
        if self._received.datum not in DATUMS:
            return "datum_refused"
        simulated = self._decoding.allow_simulator and epoch.quality in (7, 8)
        if not (epoch.quality in _QUALITIES or simulated):
            return "unknown_quality"
        return epoch.implausible()

    def _date(self, epoch: Epoch, found: list[Measurement], *, valid: bool) -> date | None:
        """Date of the epoch, its own or the calendar's; an own date is also reported as time."""
        if epoch.time_of_day_ns is None:
            return None
        if epoch.day is not None and not self._calendar.plausible(epoch.day):
            self._received.implausible_date = epoch.day
            epoch.day = None
        if epoch.day is None:
            return self._calendar.date_of(epoch.time_of_day_ns, epoch.t_seen_ns)
        # RMC states whether its time is valid; for ZDA the epoch's position decides.
        valid_stated = epoch.plain_valid if epoch.quality is None else epoch.rmc_valid
        believed = valid and bool(epoch.quality) if valid_stated is None else valid_stated
        if believed:
            self._calendar.dated(epoch.day, epoch.time_of_day_ns, epoch.t_seen_ns)
        elif valid_stated is None and epoch.quality is None and self._received.used["RMC"]:
            return epoch.day  # a ZDA of another instant than RMC: some are seconds ahead of it
        utc_ns = posix_ns(epoch.day, epoch.time_of_day_ns)
        trusted = self._trust.report(utc_ns, epoch.t_day_seen_ns, valid=believed)
        if trusted is not None:
            found.append(TimeReport(self._source, epoch.t_day_seen_ns, utc_ns, trusted))
        return epoch.day

    def _heading_ok(self, epoch: Epoch, refusal: str | None) -> bool:
        """True for THS of mode A, and for HDT, which has no mode, if the position beside it is
        good."""
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
            if not states_geoid(separation):
                self.counters["height_above_sea"] += 1
        sd_ned_m = epoch.sd_ned_m
        if sd_ned_m is not None and min(sd_ned_m) < SIGMA_M[0]:
            self.counters["sigma_too_small"] += 1
            sd_ned_m = None
        v_ned_m_s, open_sd_m_s = self._velocity.velocity_of(epoch.speed)
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
            v_ned_m_s,
            rounding_sd_ned_m=epoch.rounding_sd_ned_m,
            rounding_sd_v_m_s=open_sd_m_s,
            geoid_sd_m=geoid_sd_m,
        )
