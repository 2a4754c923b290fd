"""Plausible dates of UTC: others are mistakes, or GPS weeks that have rolled over.

Dates from before the last rollover of the ten-bit GPS week are moved by 1024 weeks (IS-GPS-200,
20.3.3.3.1.1).
"""

from __future__ import annotations

import numpy as np

from fusiond.clock.host import SECOND_NS

WEEKS_1024_NS = 1024 * 7 * 86400 * SECOND_NS
EARLIEST_UTC_NS = 1554595200 * SECOND_NS
"""2019-04-07, the last rollover of the ten-bit GPS week: earlier dates are mistakes."""
LATEST_UTC_NS = 1793491200 * SECOND_NS + WEEKS_1024_NS
"""Latest believable date: 1024 weeks (19.6 years) after this release, 2026-11-01. A later date is a
rollover corrected once too often, or beyond the service life of this code."""


def plausible(utc_ns: int) -> bool:
    """True if a date can be today's."""
    return EARLIEST_UTC_NS <= utc_ns < LATEST_UTC_NS


def year(utc_ns: int) -> int:
    """Gregorian year of any date."""
    return int(np.datetime64(utc_ns // SECOND_NS, "s").astype("datetime64[Y]").astype(int)) + 1970


def rolled_over(utc_ns: int) -> int:
    """Date moved by 1024 weeks if it lies before the last rollover and the result does not."""
    if utc_ns < EARLIEST_UTC_NS <= utc_ns + WEEKS_1024_NS:
        return utc_ns + WEEKS_1024_NS
    return utc_ns
