"""Solution of a receiver's epoch, as in its protocol, and its validation.

UBX-NAV, the BESTPOS family and SBF fill a `Solution`. `SolutionJudge` makes of it what
`drivers.nmea.decoder` makes of an epoch's sentences: a fix, a heading, a report of UTC, or the
counter's name of a refusal. No I/O, no clock.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor

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
    Vector3,
)
from drivers.nmea.time import DAY_NS, Calendar, EpochOrder, TimeTrust
from drivers.plausible import HEIGHT_M, SIGMA_M, SPEED_M_S, within

REFUSALS = {
    "no_fix": "the receiver has no fix",
    "dead_reckoning_refused": "only the receiver's own dead reckoning, which is not fused",
    "time_only_refused": "the receiver repeats a surveyed place and gives the time alone: switch "
    "its time mode off",
    "limits_exceeded": "the receiver does not stand by its fixes, which are beyond its limits of "
    "DOP and accuracy: give the antenna more sky",
    "inertial_refused": "the receiver's own inertial solution, which is not fused",
    "manual_refused": "the receiver repeats a position that was put in by hand",
    "simulator_refused": "the receiver simulates: allow_simulator would accept it",
    "datum_refused": "the receiver's positions are not on WGS 84: set its datum",
    "status_missing": "positions arrive without the receiver's own judgement of them",
    "untimed_epoch": "the receiver does not know the time yet",
    "duplicate_epoch": "the receiver repeats an epoch or goes back in time",
    "position_implausible": "the receiver states a place that is none",
    "height_implausible": "the receiver states a height at which no vehicle can be",
    "speed_implausible": "the receiver states a speed that no vehicle has",
    "sigma_too_large": "the receiver states that it does not know where it is",
}
"""Texts of refusals for `status`, by counter."""


@dataclass(slots=True)
class Solution:
    """Solution of an epoch: rad, m, m/s, NED, POSIX ns. None if not stated.

    `refusal`: reason against the position, by counter. `utc_known`: the receiver trusts its UTC.
    `hdop` and `vdop` are without unit.
    """

    t_seen_ns: int
    utc_ns: int | None = None
    utc_known: bool = False
    refusal: str | None = None
    quality: int = 1
    lat_rad: float | None = None
    lon_rad: float | None = None
    height_m: float | None = None
    sd_ned_m: Vector3 | None = None
    v_ned_m_s: tuple[float, float, float | None] | None = None
    sd_v_ned_m_s: tuple[float, float, float | None] | None = None
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None


def day_of(utc_ns: int) -> date:
    return datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).date()


class SolutionJudge:
    """Judge of solutions in order.

    Counts `epochs`, `fixes`, the names of `REFUSALS`, and within a fix `sigma_too_small`,
    `height_not_measured`, `velocity_not_finite`, `velocity_unknown`; of headings
    `headings`, `heading_implausible`.
    """

    def __init__(self, source: str, decoding: SolutionDecoding, counters: Counter[str]) -> None:
        self.counters = counters
        self.refusal = ""
        """Reason why the last epoch was refused, by counter name; empty when it was not."""
        self.implausible_date: date | None = None
        """The last date that no receiver can truly report."""
        self.gga = b""
        """Last fix as a GGA, for a caster that needs the position; empty before one."""
        self._source = source
        self._decoding = decoding
        self._calendar = Calendar(decoding.earliest_date, counters)
        self._order = EpochOrder(counters)
        self._trust = TimeTrust()

    def epoch(self, s: Solution) -> list[Measurement]:
        """Fix and time report of a solution."""
        found: list[Measurement] = []
        self.counters["epochs"] += 1
        stamp = self._stamp(s, found)
        # A fault of the position is reported before one of the time.
        self.refusal = s.refusal or _implausible(s) or ("" if stamp else "untimed_epoch")
        if self.refusal:
            self.counters[self.refusal] += 1
            return found
        assert stamp is not None
        assert s.utc_ns is not None
        day = day_of(s.utc_ns) if isinstance(stamp, UtcStamp) else None
        if not self._order.accept(day, s.utc_ns % DAY_NS):
            self.refusal = "duplicate_epoch"
            return found
        fix = self._fix(s, stamp)
        self.gga = _gga(fix, s.utc_ns)
        found.append(fix)
        return found

    def heading(
        self, t_seen_ns: int, utc_ns: int | None, heading_rad: float, sd_rad: float | None
    ) -> list[Measurement]:
        """Heading (rad, from north, clockwise) of two antennas' baseline. Without UTC it is stamped
        with its arrival."""
        stamp: Stamp = ArrivalStamp() if utc_ns is None else self._stamp_of(utc_ns)
        good = abs(heading_rad) <= 2.0 * math.tau and (sd_rad is None or 0.0 <= sd_rad < math.pi)
        if not good:
            self.counters["heading_implausible"] += 1
            return []
        self.counters["headings"] += 1
        yaw = heading_rad + math.radians(self._decoding.heading_offset_deg)
        sd = sd_rad or None
        return [Heading(self._source, t_seen_ns, stamp, math.remainder(yaw, math.tau), sd)]

    def _stamp(self, s: Solution, found: list[Measurement]) -> Stamp | None:
        """Stamp of the solution, None without an instant; a trusted time is also reported."""
        if s.utc_ns is None:
            return None
        stamp = self._stamp_of(s.utc_ns)
        if isinstance(stamp, UtcStamp):
            trusted = self._trust.report(s.utc_ns, s.t_seen_ns, valid=s.utc_known)
            if trusted is not None:
                found.append(TimeReport(self._source, s.t_seen_ns, s.utc_ns, trusted))
        return stamp

    def _stamp_of(self, utc_ns: int) -> Stamp:
        """Stamp of an instant. An impossible date is ignored, as after a mistaken week; the time of
        day is still right."""
        if self._calendar.plausible(day_of(utc_ns)):
            return UtcStamp(utc_ns)
        self.implausible_date = day_of(utc_ns)
        return TimeOfDayStamp(utc_ns % DAY_NS * 1e-9)

    def _fix(self, s: Solution, stamp: Stamp) -> PositionFix:
        assert s.lat_rad is not None
        assert s.lon_rad is not None
        self.counters["fixes"] += 1
        sd, v, sd_v = s.sd_ned_m, s.v_ned_m_s, s.sd_v_ned_m_s
        if s.height_m is None:
            self.counters["height_not_measured"] += 1
        if sd is not None and min(sd) < SIGMA_M[0]:
            self.counters["sigma_too_small"] += 1
            sd = None
        if sd_v is not None and any(x is not None and x > SPEED_M_S for x in sd_v):
            self.counters["velocity_unknown"] += 1
            v = None  # a sigma above any speed: use the position alone
        if sd_v is not None and not all(x is None or 0.0 < x < math.inf for x in sd_v):
            sd_v = None
        if v is not None and not all(x is None or math.isfinite(x) for x in v):
            self.counters["velocity_not_finite"] += 1
            v = sd_v = None
        return PositionFix(
            self._source,
            s.t_seen_ns,
            stamp,
            s.lat_rad,
            s.lon_rad,
            s.height_m,
            s.quality,
            s.satellites,
            s.hdop,
            s.vdop,
            sd,
            v,
            sd_v if v is not None else None,
        )


def _gga(fix: PositionFix, utc_ns: int) -> bytes:
    """GGA of NMEA 0183 without its line end; the height is ellipsoidal, separation 0."""
    time = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC)
    lat, lon = abs(math.degrees(fix.lat_rad)), abs(math.degrees(fix.lon_rad))
    body = (
        f"GNGGA,{time:%H%M%S}.00,{_minutes(lat, 2)},{'NS'[fix.lat_rad < 0]},{_minutes(lon, 3)},"
        f"{'EW'[fix.lon_rad < 0]},{fix.quality},{fix.satellites or 4:02d},{fix.hdop or 1.0:.2f},"
        f"{fix.height_m or 0.0:.3f},M,0.0,M,,"
    ).encode()
    return b"$%b*%02X" % (body, reduce(xor, body))


def _minutes(degrees: float, digits: int) -> str:
    """Degrees and minutes of an angle in one number; a minute is never printed as 60."""
    tenths = round(degrees * 60e5)
    return f"{tenths // 6_000_000:0{digits}d}{tenths % 6_000_000 / 1e5:08.5f}"


def _implausible(s: Solution) -> str | None:
    """Counter of an implausible value."""
    if s.lat_rad is None or s.lon_rad is None:
        return "no_fix"
    if not (abs(s.lat_rad) <= math.pi / 2 and abs(s.lon_rad) <= math.pi):
        return "position_implausible"
    if s.height_m is not None and not within(s.height_m, HEIGHT_M):
        return "height_implausible"
    # Comparisons with NaN are false; it is checked where the fix is made.
    if s.v_ned_m_s is not None and math.hypot(*s.v_ned_m_s[:2]) > SPEED_M_S:
        return "speed_implausible"
    if s.sd_ned_m is not None and not max(s.sd_ned_m) <= SIGMA_M[1]:
        return "sigma_too_large"
    return None
