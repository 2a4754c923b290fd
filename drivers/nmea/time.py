"""Instant of an NMEA epoch: time of day, date, order, and trust in the receiver's time.

A sentence carries `hhmmss.ss` and rarely a date. Instants here are integers in ns: time of day up
to 86401 s (23:59:60 is the leap second), and POSIX time, in which a leap second repeats the
previous second's count.
"""

from __future__ import annotations

import re
from collections import Counter
from datetime import date

from drivers.nmea.mixed_framing import Sentence

ROUNDED_NS = 10_000_000
"""A time with fewer decimals than two is cut: rounded, it would be that of another epoch."""
SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
MAX_STEP_NS = 10 * SECOND_NS
"""Longest interval of two time reports that tests the clock's rate."""
STEP_TOLERANCE_NS = SECOND_NS // 2
"""Tolerance of a step against the host's clock: serial jitter of two reports (0.05 to 0.2 s)."""
TRUSTED_STEPS = 2
"""Even steps in a row before the receiver's UTC is believed: it may jump by up to 18 s when it
learns the leap seconds after a cold start."""
BACKWARD_EPOCHS = 3
"""Backward epochs in a row after which the receiver's clock was set back for good."""
LATEST = date(2099, 12, 31)
"""No two-digit year of RMC can say more."""

_TIME_AT = {**dict.fromkeys(("GSA", "VTG", "HDT", "THS"), -1), "GLL": 4}
"""Field of the time, where not the first; -1: none."""
_TIME = re.compile(r"(\d\d)(\d\d)(\d\d)(?:\.(\d{1,9}))?\Z")
_EPOCH_ORDINAL = date(1970, 1, 1).toordinal()


def parse_time_of_day(text: str) -> int | None:
    """`hhmmss.ss` in ns of the day; None when empty. 235960 is a leap second. ValueError if bad."""
    if not text:
        return None
    match = _TIME.match(text)
    if match is None:
        raise ValueError(f"not a time of day: {text!r}")
    hour, minute, second = (int(part) for part in match.groups()[:3])
    leap = (hour, minute, second) == (23, 59, 60)
    if hour > 23 or minute > 59 or (second > 59 and not leap):
        raise ValueError(f"no such time of day: {text!r}")
    fraction_ns = int((match.group(4) or "0").ljust(9, "0"))
    return (hour * 3600 + minute * 60 + second) * SECOND_NS + fraction_ns


def same_printed_time(a_ns: int, a_step_ns: int, b_ns: int, b_step_ns: int) -> bool:
    """True if two printed times may be the same instant: receivers cut it to 0, 1, 2 or 3 decimals,
    or round it to two."""
    if a_step_ns == b_step_ns:
        return a_ns == b_ns
    step_ns, beyond = max((a_step_ns, b_ns - a_ns), (b_step_ns, a_ns - b_ns))
    return 0 <= beyond < step_ns or (step_ns <= ROUNDED_NS and 2 * abs(beyond) <= step_ns)


def printed_time(sentence: Sentence) -> str:
    """Printed time of a sentence; empty without one."""
    at = _TIME_AT.get(sentence.formatter, 0)
    return sentence.fields[at] if 0 <= at < len(sentence.fields) else ""


def time_step_ns(sentence: Sentence) -> int:
    """Step of the last digit of a sentence's time."""
    return int(10 ** (9 - min(9, len(printed_time(sentence).partition(".")[2]))))


def posix_ns(day: date, time_of_day_ns: int) -> int:
    """POSIX time of a UTC date and time of day, ns; a leap second repeats the last second."""
    if time_of_day_ns >= DAY_NS:
        time_of_day_ns -= SECOND_NS
    return (day.toordinal() - _EPOCH_ORDINAL) * DAY_NS + time_of_day_ns


class Calendar:
    """Calendar that dates undated epochs nearest to the last dated one.

    Dates before `earliest` are refused, since an old receiver is 1024 weeks behind after a rollover
    of the GPS week; so are dates after `LATEST`. Counts `implausible_date`.
    """

    def __init__(self, earliest: date, counters: Counter[str]) -> None:
        self._earliest = earliest
        self._counters = counters
        self._utc_ns = 0
        self._t_seen_ns: int | None = None

    def plausible(self, day: date) -> bool:
        if self._earliest <= day <= LATEST:
            return True
        self._counters["implausible_date"] += 1
        return False

    def dated(self, day: date, time_of_day_ns: int, t_seen_ns: int) -> None:
        """Note a plausible date with this time of day."""
        self._utc_ns = posix_ns(day, time_of_day_ns)
        self._t_seen_ns = t_seen_ns

    def date_of(self, time_of_day_ns: int, t_seen_ns: int) -> date | None:
        """Date of an undated epoch; None before any date was seen."""
        if self._t_seen_ns is None:
            return None
        expected = self._utc_ns + t_seen_ns - self._t_seen_ns
        days = (expected - time_of_day_ns + DAY_NS // 2) // DAY_NS
        return date.fromordinal(_EPOCH_ORDINAL + days)


class EpochOrder:
    """Filter of repeated and backward epochs: counts `duplicate_epoch`, `backward_epoch`.

    If a receiver continues from an earlier instant (`time_set_back`), its epochs are accepted again
    after `BACKWARD_EPOCHS`.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._last: tuple[date | None, int] | None = None
        self._backward: list[int] = []

    def accept(self, day: date | None, time_of_day_ns: int) -> bool:
        """True if this epoch is later than every one before it."""
        if self._last is not None:
            step = _step_ns(self._last, (day, time_of_day_ns))
            if step == 0:
                self._counters["duplicate_epoch"] += 1
                return False
            if step < 0 and not self._set_back(time_of_day_ns):
                self._counters["backward_epoch"] += 1
                return False
        self._backward.clear()
        self._last = (day, time_of_day_ns)
        return True

    def _set_back(self, time_of_day_ns: int) -> bool:
        if self._backward and time_of_day_ns <= self._backward[-1]:
            self._backward.clear()
        self._backward.append(time_of_day_ns)
        if len(self._backward) < BACKWARD_EPOCHS:
            return False
        self._counters["time_set_back"] += 1
        return True


def _step_ns(before: tuple[date | None, int], after: tuple[date | None, int]) -> int:
    step = after[1] - before[1]
    if before[0] is not None and after[0] is not None:
        length = DAY_NS + (SECOND_NS if max(before[1], after[1]) >= DAY_NS else 0)
        return step + (after[0] - before[0]).days * length
    if step <= -DAY_NS // 2:
        return step + DAY_NS + (SECOND_NS if before[1] >= DAY_NS else 0)
    if step > DAY_NS // 2:
        return step - DAY_NS
    return step


class TimeTrust:
    """Trust in a receiver's UTC after a valid status and even steps."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self._step_ns = 0
        self._even = 0

    def report(self, utc_ns: int, t_seen_ns: int, *, valid: bool) -> bool | None:
        """True if this time is trusted; None for a repeated report."""
        if self._last is not None:
            step, elapsed = utc_ns - self._last[0], t_seen_ns - self._last[1]
            if step == 0 and elapsed < STEP_TOLERANCE_NS:
                return None  # another sentence of the epoch, or UTC was set back
            even = step == self._step_ns or abs(step - elapsed) < STEP_TOLERANCE_NS
            good = valid and even and 0 < step <= MAX_STEP_NS
            self._even = self._even + 1 if good else 0
            self._step_ns = step
        self._last = (utc_ns, t_seen_ns)
        return self._even >= TRUSTED_STEPS
