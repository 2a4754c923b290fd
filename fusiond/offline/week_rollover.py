"""Detection of fixes from a receiver after a rollover of its GPS week: dates 1024 weeks early.

The POSIX times of an IMU reveal fixes that are 1024 weeks off. GPS second of week cannot reveal it;
then only the leap seconds are wrong, since they are those of the wrong date.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import NamedTuple

from drivers.decoder_options import BUILD_DATE
from drivers.nmea.reasons import ROLLOVER
from fusiond.navigation.gps_time import utc_ns_to_gps_week_seconds

ROLLOVER_NS = ROLLOVER.days * 86_400 * 1_000_000_000


class Rollover(NamedTuple):
    """Correction of instants (ns), with a named text."""

    add_ns: int = 0
    said: tuple[tuple[str, str], ...] = ()


def rollover_of(utc_ns: Sequence[int], imu_s: tuple[float, float] | None) -> Rollover:
    """Find the rollover of fixes at `utc_ns` by an IMU's times (POSIX; None: not POSIX)."""
    if not utc_ns:
        return Rollover()
    first_ns, last_ns = min(utc_ns), max(utc_ns)
    first = _date(first_ns)
    if imu_s is None:
        if _date(first_ns + ROLLOVER_NS) > BUILD_DATE:
            return Rollover()
        now_s, later_s = (utc_ns_to_gps_week_seconds(first_ns + ns) for ns in (0, ROLLOVER_NS))
        text = (
            f"the fixes are of {first}, with the leap seconds of then: if they are of "
            f"{first + ROLLOVER}, the receiver's GPS week has rolled over, and their times are "
            f"{later_s - now_s:.0f} s too early"
        )
        return Rollover(0, (("old_date", text),))
    begin_ns, end_ns = (round(t_s * 1e9) for t_s in imu_s)
    turns = round((begin_ns - first_ns) / ROLLOVER_NS)
    add_ns = turns * ROLLOVER_NS
    if not turns or begin_ns > last_ns + add_ns or end_ns < first_ns + add_ns:
        return Rollover()
    text = (
        f"the fixes are of {first}, {abs(turns) * 1024} weeks off the IMU's time: the receiver's "
        "GPS week has rolled over, and its dates are corrected"
    )
    return Rollover(add_ns, (("week_rollover", text),))


def _date(utc_ns: int) -> date:
    return datetime.fromtimestamp(utc_ns * 1e-9, UTC).date()
