"""GPS time and UTC.

GPS time started at 1980-01-06 and counts no leap seconds: GPST = UTC + 18 s since 2017-01-01. The
table holds the dates since which each offset is valid (IERS Bulletin C); the last entry serves
until a new one is announced.
"""

from __future__ import annotations

GPS_EPOCH_POSIX_S = 315964800
WEEK_S = 604800
# POSIX second from which GPST - UTC has this value; years before 2006 do not matter to a receiver.
LEAP_SECONDS = (
    (1136073600, 14),
    (1230768000, 15),
    (1341100800, 16),
    (1435708800, 17),
    (1483228800, 18),
)


def leap_seconds(utc_ns: int) -> int:
    """GPST - UTC in s at a POSIX instant in ns."""
    return next((n for since, n in reversed(LEAP_SECONDS) if utc_ns >= since * 1_000_000_000), 13)


def utc_ns_to_gps_week_seconds(utc_ns: int) -> float:
    """GPS second of week of a POSIX instant in ns."""
    return utc_ns_to_gps(utc_ns)[1]


def utc_ns_to_gps(utc_ns: int) -> tuple[int, float]:
    """GPS week and second of week of a POSIX instant in ns."""
    gps_ns = utc_ns + (leap_seconds(utc_ns) - GPS_EPOCH_POSIX_S) * 1_000_000_000
    week, rest = divmod(gps_ns, WEEK_S * 1_000_000_000)
    return week, rest * 1e-9
