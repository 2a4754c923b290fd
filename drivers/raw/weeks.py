"""Weeks, their rollovers, and UTC of GPS time.

    full week = the one nearest to a reference that equals the sent count modulo its range
    UTC       = 1980-01-06 + week * 604800 s + tow - leap seconds

The reference is the newest full instant: from the stream's RXM-RAWX, a 13-bit BeiDou or 12-bit
Galileo week (which do not roll over before 2163 and 2078), or from the caller.
"""

from __future__ import annotations

from datetime import date

WEEK_S = 604_800
HALF_WEEK_S = WEEK_S / 2
GPS_EPOCH_S = 315_964_800
"""1980-01-06 in POSIX seconds."""
BDT_WEEK = 1356
"""GPS week of 2006-01-01, BeiDou week 0."""
BDT_BEHIND_GPS_S = 14
GALILEO_WEEK = 1024
"""GPS week of 1999-08-22, Galileo week 0."""
LEAP_SECONDS = (
    (date(1999, 1, 1), 13),
    (date(2006, 1, 1), 14),
    (date(2009, 1, 1), 15),
    (date(2012, 7, 1), 16),
    (date(2015, 7, 1), 17),
    (date(2017, 1, 1), 18),
)
"""GPS time minus UTC from a date on (IERS Bulletin C), for receivers that do not state it."""
FIRST_RAWX_WEEK = 1773
"""Start of 2014. No receiver sent RXM-RAWX before; an earlier week is a clock never set."""
LAST_WEEK = 6260
"""The last that begins in 2099: the calendar of NMEA ends there too, with its two-digit years."""

_GPS_ORDINAL = date(1980, 1, 6).toordinal()


def week_of(day: date) -> int:
    """GPS week of a date."""
    return (day.toordinal() - _GPS_ORDINAL) // 7


def leap_seconds(week: int, tow_s: float = 0.0) -> int:
    """GPS time minus UTC at a GPS time, by the table; its first entry serves earlier times."""
    gps_s = week * WEEK_S + tow_s
    found = LEAP_SECONDS[0][1]
    for since, seconds in LEAP_SECONDS[1:]:
        if gps_s >= (since.toordinal() - _GPS_ORDINAL) * 86_400 + seconds:
            found = seconds
    return found


def utc_ns(week: int, tow_s: float, leap_seconds: int) -> int:
    """POSIX ns of GPS time."""
    return (GPS_EPOCH_S + week * WEEK_S - leap_seconds) * 1_000_000_000 + round(tow_s * 1e9)


def utc_as_reported(week: int, tow_s: float, leap: int | None) -> int:
    """UTC by the receiver's leap seconds, or by the table without them."""
    return utc_ns(week, tow_s, leap_seconds(week, tow_s) if leap is None else leap)


class WeekReference:
    """Newest full instant of GPS time, as a reference for shortened weeks.

    `earliest`: without a reference a 10-bit week is the first that is not before this date.
    """

    def __init__(self, earliest: date) -> None:
        self._earliest_week = week_of(earliest)
        self._gps_s: float | None = None
        self._assumed = False

    def note(self, week: int, tow_s: float) -> None:
        """Note a full GPS time of the stream."""
        self._gps_s = week * WEEK_S + tow_s
        self._assumed = False

    def note_tow(self, week: int, tow_s: float) -> None:
        """Note an instant with a week by `week_of_tow`, which is as good as the reference."""
        self._gps_s = week * WEEK_S + tow_s

    def note_utc(self, t_utc_ns: int, leap_s: int | None = None) -> None:
        """Note UTC from a trusted source."""
        utc_s = t_utc_ns * 1e-9 - GPS_EPOCH_S
        self.note(0, utc_s + (leap_seconds(0, utc_s) if leap_s is None else leap_s))

    def gps_week(self, count: int, tow_s: float) -> int:
        """Full week of GPS's ten bits, transmitted at about `tow_s`."""
        if self._gps_s is None or self._assumed:
            week = self._earliest_week + (count - self._earliest_week) % 1024
            self._gps_s, self._assumed = week * WEEK_S + tow_s, True
            return week
        return self._nearest(count, 1024, self._gps_s)

    def bdt_week(self, count: int, tow_s: float) -> int:
        """BeiDou week of D1's and D2's 13 bits, transmitted at about `tow_s` of BDT."""
        return self._wide(count, 8192, BDT_WEEK, tow_s)

    def galileo_week(self, count: int, tow_s: float) -> int:
        """GPS week of Galileo's twelve bits, transmitted at about `tow_s`."""
        return self._wide(count, 4096, GALILEO_WEEK, tow_s) + GALILEO_WEEK

    def week_of_tow(self, tow_s: float) -> int | None:
        """GPS week in which `tow_s` is nearest to the reference; None without one."""
        if self._gps_s is None:
            return None
        return round((self._gps_s - tow_s) / WEEK_S)

    def _wide(self, count: int, modulus: int, offset: int, tow_s: float) -> int:
        """Week of a long count, which becomes the reference if there is no better one."""
        if self._gps_s is None or self._assumed:
            self.note(count + offset, tow_s)
            return count
        return self._nearest(count, modulus, self._gps_s - offset * WEEK_S)

    @staticmethod
    def _nearest(count: int, modulus: int, near_s: float) -> int:
        near = int(near_s // WEEK_S)
        return near + (count - near + modulus // 2) % modulus - modulus // 2
