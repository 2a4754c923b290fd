"""UTC of one source on the host's monotonic clock, learnt from the arrival of its reports.

    d_i = t_seen_i - utc_i = offset + delay_i,    delay_i >= its least value

Delay is one-sided and monotonic time does not jump, so the offset is the lower envelope of d, which
rises by the allowed drift alone for any delay of reports:

    offset_i = min(d_i, offset_{i-1} + drift * (t_seen_i - t_seen_{i-1}))

Anything else is a change of the source's UTC, recognised in two ways:

* certain: a report before it was possible (UTC ahead); UTC that runs backwards or stands still in
  the source's own sequence (a serial line keeps its order, so no lateness does that); or a second
  that is missing where leap seconds are. Three agreeing reports over a second are followed at once,
  by whole seconds if they say so: the device's stamps have changed, and its measurements with them.
* possible: reports later than the envelope by whole seconds, after reports were missing (without
  that, the sequence shows that UTC went on). They are treated as delayed, with a sigma as large as
  the doubt, until it has lasted for two minutes.

UTC itself changes only after two minutes (`believed_offset_ns`): a receiver's mistake is no leap
second.

Dates that cannot be today's are mistakes, or GPS weeks that have rolled over: those from before the
last rollover of the ten-bit week are moved by 1024 weeks (IS-GPS-200, 20.3.3.3.1.1).

Everything is integer nanoseconds: UTC in ns does not fit a double. A pure function of its inputs.
"""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from math import hypot
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS

_EARLY_NS = 50 * MILLISECOND_NS
"""Lead from which an early report is held back: above a serial line's jitter (1 to 16 ms for USB).
"""
_DELAY_NS = 500 * MILLISECOND_NS
"""Largest delay of UTC reports on a healthy serial line."""
_YOUNG_REPORTS = 10
_YOUNG_EARLY_NS = 60 * SECOND_NS
"""Lead allowed for the first reports, which may all be delayed; a tty's queue holds less."""
_AGREE_NS = 100 * MILLISECOND_NS
_CONFIRM_REPORTS = 3
_CONFIRM_SPAN_NS = SECOND_NS
_BELIEVE_NS = 120 * SECOND_NS
_WHOLE_LOW_NS = 50 * MILLISECOND_NS
_WHOLE_HIGH_NS = 200 * MILLISECOND_NS
"""Excess over whole seconds that a jump may show: the envelope's own error and a report's delay."""
_SLEEP_ERROR_NS = 2 * SECOND_NS
"""Error of a sleep's length by a battery-backed clock of whole seconds, read before and after."""
_MAX_SPREAD_S = 1.0
"""Largest delay of reports in whole seconds."""
_SCATTER_NS = 500 * MILLISECOND_NS
"""Reports of a receiver that has jumped scatter like any; those of a busy host scatter more."""
_AFTER_LEAP_NS = 5 * SECOND_NS
_DAY_NS = 86400 * SECOND_NS

WEEKS_1024_NS = 1024 * 7 * 86400 * SECOND_NS
EARLIEST_UTC_NS = 1554595200 * SECOND_NS
"""2019-04-07, the last rollover of the ten-bit GPS week: earlier dates are mistakes."""
LATEST_UTC_NS = 1793491200 * SECOND_NS + WEEKS_1024_NS
"""Latest believable date: 1024 weeks (19.6 years) after this release, 2026-11-01. A later date is a
rollover corrected once too often, or beyond the service life of this code."""

SD_S = 3e-3
_UNKNOWN_S = 0.15
"""Sentences come 50 to 200 ms after their epoch."""


@dataclass(frozen=True, slots=True, config=ConfigDict(strict=True, extra="forbid"))
class UtcKnown:
    """State of a source's UTC, for a later process on the same monotonic clock.

    `offset_ns` and `t_seen_ns` as of `UtcEnvelope`, `utc_ns` the UTC of its last report, `reports`
    their number. Raises pydantic's `ValidationError` for impossible values.
    """

    source: Annotated[str, Field(min_length=1, max_length=64)]
    offset_ns: Annotated[int, Field(gt=-(2**63), lt=2**63)]
    utc_ns: Annotated[int, Field(ge=0, lt=2**63)]
    t_seen_ns: Annotated[int, Field(ge=0, lt=2**63)]
    reports: Annotated[int, Field(ge=1, lt=2**63)]


class Stamped(NamedTuple):
    """Monotonic instant of a stamp (ns) and its sigma (s)."""

    t_ns: int
    sd_s: float


def plausible_date(utc_ns: int) -> bool:
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


def whole_seconds_ns(excess_ns: int, delay_ns: int = _WHOLE_HIGH_NS) -> int:
    """Jump by whole seconds that explains `excess_ns` with a delay up to `delay_ns`, else 0."""
    jump = (excess_ns + _WHOLE_LOW_NS) // SECOND_NS * SECOND_NS
    return jump if excess_ns - jump <= delay_ns else 0


def _after_leap(utc_ns: int) -> bool:
    """True at the start of a month, before which leap seconds come (ITU-R TF.460-6, annex 1)."""
    if utc_ns % _DAY_NS > _AFTER_LEAP_NS:
        return False
    return datetime.fromtimestamp(utc_ns // SECOND_NS, UTC).day == 1


class UtcEnvelope:
    """The lower envelope of one source. Made empty; `update` takes its reports.

    Counters: `utc_report_odd` (held back), `utc_report_late` (beyond 0.5 s), `utc_jump` (the
    source's UTC changed), `utc_relearned` (all reports before had been late).
    """

    def __init__(self, drift_ppm: float, counters: Counter[str]) -> None:
        self._ppb = round(drift_ppm * 1000)
        self._counters = counters
        self._offset_ns: int | None = None
        self._utc_ns = 0
        self._delay_ns = 0
        self._interval_ns: int | None = None
        self._turned_back = False
        self._reports = 0
        self._spread_s = _UNKNOWN_S
        self._odd: list[int] = []
        self._odd_since_ns = 0
        self._unsupported: _Unsupported | None = None
        self._supported_ns = 0
        self._unbelieved_ns = 0
        self._jumped_ns = 0
        self._woke = False
        self.t_seen_ns = 0
        self.plausible = True

    def known(self, source: str) -> UtcKnown | None:
        """State for another process; None while there is a doubt."""
        if self._offset_ns is None or not (self.settled and self.plausible):
            return None
        return UtcKnown(source, self._offset_ns, self._utc_ns, self.t_seen_ns, self._reports)

    def resume(self, known: UtcKnown) -> None:
        """Resume with the state of another process."""
        self._offset_ns = known.offset_ns
        self._supported_ns = known.t_seen_ns
        self._accept(known.utc_ns, known.t_seen_ns - known.utc_ns, known.t_seen_ns)
        self._reports = known.reports

    @property
    def offset_ns(self) -> int:
        """Host monotonic time minus the source's present UTC, at its least delay."""
        assert self._offset_ns is not None, "made from its first report"
        return self._offset_ns

    @property
    def believed_offset_ns(self) -> int:
        """Host monotonic time minus believed UTC, which ignores changes of the last two minutes."""
        return self.offset_ns - self._unbelieved_ns

    @property
    def open(self) -> bool:
        """True while the held reports show an unidentified change."""
        return bool(self._odd)

    @property
    def settled(self) -> bool:
        """True unless reports and believed UTC disagree without a decision."""
        return not (self._odd or self._unbelieved_ns or self._doubt_ns)

    @property
    def _doubt_ns(self) -> int:
        """Possible jump of UTC during missing reports (ns)."""
        run = self._unsupported
        return whole_seconds_ns(run.least_ns) if run is not None and run.after_gap else 0

    @property
    def sd_s(self) -> float:
        """Sigma of the offset (s): the least of n delays lies spread / n above the true least."""
        unsupported_ns = max(0, self.t_seen_ns - self._supported_ns)
        drift_s = unsupported_ns * self._ppb / SECOND_NS / SECOND_NS
        return hypot(max(SD_S, self._spread_s / (self._reports + 1)), drift_s)

    def stamp(self, utc_ns: int, t_seen_ns: int) -> Stamped:
        """Instant of the source's own stamp `utc_ns`, less its least delay.

        A late one keeps its age; if a jump of UTC would explain that, sigma is the jump.
        """
        excess_ns = t_seen_ns - utc_ns - self.offset_ns
        doubt_s = 0.0
        if excess_ns > _DELAY_NS and (
            self._doubt_ns or self._missed(utc_ns) or self._turns_back(utc_ns, t_seen_ns)
        ):
            doubt_s = whole_seconds_ns(excess_ns) / SECOND_NS
        return Stamped(utc_ns + self.offset_ns, hypot(self.sd_s, doubt_s))

    def _missed(self, utc_ns: int) -> bool:
        """True if reports are missing before `utc_ns`: a jump of UTC may hide there."""
        if self._interval_ns is None:
            return True
        return 2 * (utc_ns - self._utc_ns) > 3 * self._interval_ns

    def _turns_back(self, utc_ns: int, t_seen_ns: int) -> bool:
        """True if UTC stands still or goes back at `utc_ns`, other than by a second reading."""
        return utc_ns <= self._utc_ns and t_seen_ns - utc_ns > self._delay_ns + _DELAY_NS

    def untrusted(self, utc_ns: int, t_seen_ns: int) -> None:
        """Process a report that the device does not trust: it can only show that UTC turned
        back."""
        if self._offset_ns is not None and self._turns_back(utc_ns, t_seen_ns):
            self._turned_back = True

    def slept(self, slept_ns: int) -> None:
        """Account for a suspend: monotonic time stopped, UTC did not.

        A hardware clock counts suspend in whole seconds, so the offset is learnt again from the
        next reports.
        """
        if self._offset_ns is None:
            return
        self._offset_ns -= slept_ns
        self._odd.clear()
        self._unsupported = None
        self._reports = 0
        self._spread_s = _MAX_SPREAD_S
        self._woke = True

    def update(self, utc_ns: int, t_seen_ns: int, *, plausible: bool = True) -> int:
        """Add a report; return the jump of `believed_offset_ns`, in ns.

        UTC with an implausible date maps the source's own stamps and never changes
        `believed_offset_ns`.
        """
        d = t_seen_ns - utc_ns
        self.plausible = plausible
        if self._offset_ns is None or (self._woke and abs(d - self._offset_ns) < _SLEEP_ERROR_NS):
            self._woke = False
            self._offset_ns = d
            self._supported_ns = t_seen_ns
            self._accept(utc_ns, d, t_seen_ns)
            return 0
        drifted = self._offset_ns + max(0, t_seen_ns - self.t_seen_ns) * self._ppb // SECOND_NS
        self._offset_ns = drifted
        excess_ns = d - drifted
        early_from = _YOUNG_EARLY_NS if self._reports < _YOUNG_REPORTS else _EARLY_NS
        backward = self._turned_back or self._turns_back(utc_ns, t_seen_ns)
        repeated = plausible and whole_seconds_ns(excess_ns) == SECOND_NS and _after_leap(utc_ns)
        if excess_ns < -early_from or (
            excess_ns > _DELAY_NS and (backward or repeated or self._odd)
        ):
            self.t_seen_ns = max(t_seen_ns, self.t_seen_ns)
            self._hold(d, excess_ns, utc_ns, t_seen_ns)
            return self._believe()
        self._odd.clear()
        if excess_ns < -_EARLY_NS:
            self._spread_s = min(_MAX_SPREAD_S, max(self._spread_s, -excess_ns / SECOND_NS))
            self._reports = 0
        self._offset_ns = min(d, drifted)
        if excess_ns <= _DELAY_NS:
            self._unsupported = None
            self._supported_ns = t_seen_ns
        else:
            self._counters["utc_report_late"] += 1
            run, missed = self._unsupported, self._missed(utc_ns)
            if run is None or not run.take(excess_ns):
                missed = missed or (run is not None and run.after_gap)
                run = self._unsupported = _Unsupported(t_seen_ns, excess_ns)
            run.after_gap = run.after_gap or missed
        self._accept(utc_ns, d, t_seen_ns)
        return self._outlasted() or self._believe()

    def _accept(self, utc_ns: int, d: int, t_seen_ns: int) -> None:
        if self._reports and utc_ns > self._utc_ns:
            self._interval_ns = utc_ns - self._utc_ns
        self._turned_back = False
        self._utc_ns = utc_ns
        self._delay_ns = d
        self._reports += 1
        self.t_seen_ns = max(t_seen_ns, self.t_seen_ns)

    def _hold(self, d: int, excess_ns: int, utc_ns: int, t_seen_ns: int) -> None:
        """Hold a report that no latency explains: a wrong report, or a change of UTC once three
        agree."""
        self._counters["utc_report_odd"] += 1
        if self._odd and abs(d - self._odd[0]) > max(_AGREE_NS, round(self._spread_s * SECOND_NS)):
            self._odd.clear()
        if not self._odd:
            self._odd_since_ns = t_seen_ns
        self._odd.append(d)
        if len(self._odd) < _CONFIRM_REPORTS or t_seen_ns - self._odd_since_ns < _CONFIRM_SPAN_NS:
            return
        least = min(self._odd) - self.offset_ns
        jump = whole_seconds_ns(least, _AGREE_NS)
        if jump == 0 and -_YOUNG_EARLY_NS < least < 0:
            self._counters["utc_relearned"] += 1
        else:
            self._counters["utc_jump"] += 1
            self._unbelieved_ns += jump or least
            self._jumped_ns = t_seen_ns
        self._offset_ns = min(self._odd)
        self._reports = 0
        self._spread_s = _UNKNOWN_S
        self._odd.clear()
        self._unsupported = None
        self._supported_ns = t_seen_ns
        self._accept(utc_ns, d, t_seen_ns)

    def _outlasted(self) -> int:
        """Reports late by the same whole seconds for minutes: UTC has jumped back by them."""
        excess_ns = self._unsupported
        if excess_ns is None or self.t_seen_ns - excess_ns.since_ns < _BELIEVE_NS:
            return 0
        jump = self._doubt_ns
        if jump == 0 or excess_ns.reports < _YOUNG_REPORTS or not self.plausible:
            return 0
        self._counters["utc_jump"] += 1
        self._offset_ns = self.offset_ns + excess_ns.least_ns
        self._unsupported = None
        self._supported_ns = self.t_seen_ns
        return jump

    def _believe(self) -> int:
        lasted = self.t_seen_ns - self._jumped_ns >= _BELIEVE_NS
        if not (self._unbelieved_ns and lasted and self.plausible) or self._odd:
            return 0
        if self._unsupported is not None:
            return 0
        change, self._unbelieved_ns = self._unbelieved_ns, 0
        return change


class _Unsupported:
    """Reports that have been late since the last one that was not."""

    def __init__(self, since_ns: int, excess_ns: int) -> None:
        self.since_ns = since_ns
        self.least_ns = excess_ns
        self.reports = 1
        self.after_gap = False

    def take(self, excess_ns: int) -> bool:
        """Add another report; False if it does not fit and starts a new run."""
        if not -_AGREE_NS <= excess_ns - self.least_ns <= _SCATTER_NS:
            return False
        self.least_ns = min(self.least_ns, excess_ns)
        self.reports += 1
        return True
