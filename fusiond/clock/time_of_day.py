"""Full UTC of a time of day without a date and perhaps without a zone.

    candidate(z, d) = midnight(r) + d days + T - z,   z in the possible zones, d in {-1, 0, +1}

r is UTC when the measurement came in, q when it was asked for. An RDSS terminal prints the instant
of its own answer burst: it lies between the request and the reply (the stamping rule of the
project's RDSS sheet, from the round-trip principle of the service). All instants here are UTC,
POSIX nanoseconds; T in a leap second (86400 or more) repeats the second before.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from math import sqrt
from statistics import median_low
from typing import NamedTuple

SECOND_NS = 1_000_000_000
HOUR_NS = 3600 * SECOND_NS
DAY_NS = 24 * HOUR_NS

_BEFORE_REQUEST_NS = SECOND_NS // 2
"""The printed field may be rounded, and the request stamped late: rule of the sheet."""
_UNASKED_NS = 10 * SECOND_NS
"""Longest delay of an unsolicited reply: rule of the sheet."""
_LOCK_AFTER = 3
_LEARN_FROM = 5
_CLOCK_ERROR_NS = 5 * SECOND_NS
"""Error of the daemon's clock beyond which the rule fails."""
FALLBACK_SD_S = 0.5
"""Sigma of an instant by an assumed latency: rule of the sheet."""


class Dated(NamedTuple):
    """UTC instant (ns), its sigma (s) and the name of the rule."""

    utc_ns: int
    sd_s: float
    how: str


def candidates(
    time_of_day_s: float, zones_h: tuple[int, ...], r_ns: int
) -> Iterator[tuple[int, int]]:
    """Zone (h) and UTC instant (ns) of every reading of the time of day around `r_ns`."""
    t_ns = round(time_of_day_s * 1e9)
    if t_ns >= DAY_NS:
        t_ns -= SECOND_NS
    midnight_ns = r_ns - r_ns % DAY_NS
    for zone_h in zones_h:
        for day in (-1, 0, 1):
            yield zone_h, midnight_ns + day * DAY_NS + t_ns - zone_h * HOUR_NS


def nearest(time_of_day_s: float, zones_h: tuple[int, ...], r_ns: int) -> int:
    """Reading nearest to `r_ns`, for a receiver whose fixes are at most seconds old."""
    return min(
        (c for _, c in candidates(time_of_day_s, zones_h, r_ns)), key=lambda c: abs(c - r_ns)
    )


class RdssTimeOfDay:
    """The stamping rule for one RDSS terminal: which instant a fix belongs to.

    After three equal accepted zones that zone is locked. While the daemon's clock is wrong by
    more than 5 s nothing fits; the error is then learnt as the median over fixes of
    r - latency - T (`clock_error_s`), and allowed for. Counters: `rdss_time_mismatch`,
    `rdss_zone_locked`, `rdss_clock_error_learned`.
    """

    def __init__(self, latency_s: float, counters: Counter[str]) -> None:
        self._latency_ns = round(latency_s * SECOND_NS)
        self._counters = counters
        self._zone_h: int | None = None
        self._last_zone_h: int | None = None
        self._equal = 0
        self._errors: deque[int] = deque(maxlen=_LEARN_FROM)
        self._error_ns = 0

    @property
    def zone_h(self) -> int | None:
        """The locked zone, hours ahead of UTC; None while it is open."""
        return self._zone_h

    @property
    def clock_error_s(self) -> float:
        """Daemon UTC minus terminal UTC as learnt from mismatches; 0 while the rule holds."""
        return self._error_ns / SECOND_NS

    def resolve(
        self,
        time_of_day_s: float,
        zones_h: tuple[int, ...],
        uncertainty_s: float,
        r_ns: int,
        q_ns: int | None,
    ) -> Dated:
        """UTC of a fix seen at `r_ns` and requested at `q_ns` (None: not requested)."""
        zones = zones_h if self._zone_h is None else (self._zone_h,)
        all_readings = list(candidates(time_of_day_s, zones, r_ns))
        unsure_ns = round(uncertainty_s * SECOND_NS)
        low = (r_ns - _UNASKED_NS if q_ns is None else q_ns - _BEFORE_REQUEST_NS) - unsure_ns
        high = r_ns + unsure_ns
        fitting = [(z, c) for z, c in all_readings if low <= c <= high]
        if len(fitting) == 1:
            zone_h, utc_ns = fitting[0]
            self._accept(zone_h)
            self._error_ns = 0
            return Dated(min(utc_ns, r_ns), uncertainty_s / sqrt(3.0), "time_of_day")
        if self._error_ns and not fitting:
            # The learnt error holds the spread of the latency too, hence the wider upper bound.
            shifted = [(z, c + self._error_ns) for z, c in all_readings]
            fitting = [(z, c) for z, c in shifted if low <= c <= high + _BEFORE_REQUEST_NS]
            if len(fitting) == 1:
                return Dated(min(fitting[0][1], r_ns), FALLBACK_SD_S, "time_of_day_corrected")
        assumed_ns = r_ns - self._latency_ns
        self._counters["rdss_time_mismatch"] += 1
        self._learn(min((assumed_ns - c for _, c in all_readings), key=abs))
        return Dated(assumed_ns, FALLBACK_SD_S, "assumed_latency")

    def _accept(self, zone_h: int) -> None:
        self._errors.clear()
        self._equal = self._equal + 1 if zone_h == self._last_zone_h else 1
        self._last_zone_h = zone_h
        if self._zone_h is None and self._equal >= _LOCK_AFTER:
            self._zone_h = zone_h
            self._counters["rdss_zone_locked"] += 1

    def _learn(self, error_ns: int) -> None:
        self._errors.append(error_ns)
        if len(self._errors) < _LEARN_FROM:
            return
        middle = median_low(self._errors)
        if abs(middle) > _CLOCK_ERROR_NS and all(
            abs(e - middle) <= _CLOCK_ERROR_NS for e in self._errors
        ):
            self._error_ns = middle
            self._errors.clear()
            self._counters["rdss_clock_error_learned"] += 1
