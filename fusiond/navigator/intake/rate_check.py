r"""Rate limits of sources: measurements faster than their kind allows are refused.

A bucket of tokens for a source and kind of measurement:

    tokens <- min(BURST, tokens + |t - t_before| rate) - 1

With less than none left the source is too fast: that measurement, and all from it until none was
too fast for `CALM_NS`, are `too_often`. Who sends false data at a high rate sends honest ones
between them: nobody can tell which, and the mean of repetitions has no smaller error than one.

t is the instant of validity, so that a backlog in which each has its own stamp is as good as one
that came in time; the sign of a difference is not looked at, since late ones come out of order.

A backlog that comes before the source's UTC is known has one instant, that of its arrival, and
stamps that advance as they should. Of which instants it is will never be known: what is beyond the
burst is refused as `backlog`, and the source is not too fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from drivers.measurements import (
    Attitude,
    Bearing,
    DelayedFix,
    Heading,
    Height,
    MagneticHeading,
    Measurement,
    PositionFix,
    TimeOfDayStamp,
    UtcStamp,
    WheelSpeed,
)
from drivers.raw.messages import RawGnssEpoch

RATES: Mapping[type, tuple[float, str]] = {
    # Receivers offer 10 to 25 Hz (u-blox ZED-F9P: 20 Hz), those for machines 50, and 100 only from
    # extrapolated phase: more than 50 in a second say nothing that the inertial unit does not.
    PositionFix: (50.0, "fixes"),
    RawGnssEpoch: (50.0, "epochs"),
    Heading: (50.0, "headings"),
    MagneticHeading: (50.0, "headings"),
    # The fastest cards may be asked once a second (docs/rdss-terminal.md).
    DelayedFix: (2.0, "fixes"),
    # CAN carries wheel speeds every 10 or 20 ms; attitude units and altimeters reach 200 Hz.
    WheelSpeed: (200.0, "speeds"),
    Attitude: (200.0, "attitudes"),
    Height: (200.0, "heights"),
    Bearing: (50.0, "bearings"),
}
"""Largest rate (measurements a second) and description of a source's kind."""
BURST = 5.0
"""Measurements allowed at once: arrival stamps jitter, and a line that paused delivers a burst."""
STAMPED = 0.99
"""Least advance of a device's own stamps in intervals of the rate; seconds since 1970 are known to
a quarter of a microsecond."""
CALM_NS = 1_000_000_000


class Pace:
    """The buckets. `report(code, text)` hears of a source that is too fast, once an episode."""

    def __init__(self, report: Callable[[str, str], None]) -> None:
        self._report = report
        self._buckets: dict[tuple[str, type], tuple[float, int, float]] = {}
        self._fast_ns: dict[tuple[str, type], int] = {}

    def refusal(self, m: Measurement | RawGnssEpoch, t_ns: int) -> str | None:
        """Refusal `too_often` or `backlog`, or None if `m`, valid at `t_ns`, respects its kind's
        rate."""
        kind = type(m)
        if kind not in RATES:
            return None
        rate_hz, what = RATES[kind]
        key = m.source, kind
        match getattr(m, "stamp", None):
            case UtcStamp(utc_ns):
                said_s = utc_ns * 1e-9
            case TimeOfDayStamp(time_of_day_s):
                said_s = time_of_day_s
            case _:
                said_s = math.inf
        tokens, before_ns, said_before_s = self._buckets.get(key, (BURST, t_ns, math.inf))
        tokens = min(BURST, tokens + abs(t_ns - before_ns) * 1e-9 * rate_hz) - 1.0
        self._buckets[key] = max(tokens, 0.0), t_ns, said_s
        fast_ns = self._fast_ns.get(key)
        advanced = math.isfinite(said_s) and (said_s - said_before_s) * rate_hz >= STAMPED
        if tokens < 0.0 and fast_ns is None and advanced:
            return "backlog"
        if tokens >= 0.0 and (fast_ns is None or abs(t_ns - fast_ns) >= CALM_NS):
            self._fast_ns.pop(key, None)
            return None
        if tokens < 0.0:
            self._fast_ns[key] = t_ns
            if fast_ns is None:
                self._report(
                    "source_too_fast",
                    f"{m.source} sends more than {rate_hz:g} {what} a second: it is left out until "
                    "it does not",
                )
        return "too_often"
