"""Options of any GNSS decoder."""

from __future__ import annotations

from datetime import date

from drivers.base import DriverOptions

BUILD_DATE = date(2026, 11, 20)
"""Build date of this software, before which no receiver's date is plausible."""


class SolutionDecoding(DriverOptions):
    """Options for a receiver's own solutions."""

    heading_offset_deg: float = 0.0
    """Added to headings: from the antenna baseline to the vehicle's forward axis, clockwise."""
    earliest_date: date = BUILD_DATE
    """Earliest accepted date; set it back to read old logs."""
    allow_simulator: bool = False
    """Accept simulated or manually entered positions (NMEA quality 7 and 8)."""
