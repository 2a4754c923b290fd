"""Rate of a recorder's clock that is slewed while it records.

    s(k) = o + (1 + r) u(k) + delay(k),     0 <= delay(k) < LEAP_NS

s is the recorder's time without steps, u the UTC that a receiver on the bus reports. Offset o and
rate r are the clock's two states. A quartz keeps r within the configured drift; a program that
disciplines a clock changes r at once, holds it and moves it back: adjtimex(2) to 500 ppm by its
frequency and to 10 % by its tick, chrony to 8.3 % (`maxslewrate`), a bad oscillator to a percent
for good. Hence r is constant between the smallest number of changes that explains the reports:
while one line fits all reports of a stretch within their scatter, nothing has changed (the bounds
of the slope close like doors; Bristol, "Swinging door trending", ISA 1990).

A rate is used if it exceeds the drift and its effect exceeds any delay; the envelope of UTC
(fusiond.clock.utc_from_arrivals) follows the rest. The first and the last rate are extrapolated
before and after their reports, for as long as they were observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS
from fusiond.clock.recorder_clock import ENOUGH_REPORTS, LEAP_NS, Slew

SPACING_NS = SECOND_NS // 2
"""Between reports that are looked at: a change is followed within seconds, and a receiver that
tells whole seconds alone tells each at its beginning."""
FLOOR_NS = 2 * MILLISECOND_NS
"""Scatter of reports at the least: a CAN controller's queue."""
SCATTERS = 4.0
"""Largest deviation of a sound report from its line, in sigmas: one in 16,000 is larger."""
DAMAGED = 2
"""Reports off a line that may be damage: three are a change."""
FASTEST = 0.5
"""Largest rate of a clock: adjtimex(2) allows 0.1. Reports that stop or come at once show a fault
of the receiver."""


class _Line(NamedTuple):
    """Line through reports `first` to `last`: the recorder's lead at `middle_s`, and its slope."""

    first: int
    last: int
    middle_s: float
    lead_s: float
    slope: float


def slews(reports: Sequence[tuple[int, int]], drift_ppm: float) -> tuple[Slew, ...]:
    """Slews that the reports show: recorder's time without its steps and UTC, both in ns."""
    kept = _thinned(reports)
    if len(kept) < 2 * ENOUGH_REPORTS:
        return ()
    begin_ns, begin_utc_ns = kept[0]
    s = np.array([t_ns - begin_ns for t_ns, _ in kept]) * 1e-9
    lead = s - np.array([utc_ns - begin_utc_ns for _, utc_ns in kept]) * 1e-9
    if float(np.ptp(lead)) < LEAP_NS * 1e-9:
        return ()
    within = SCATTERS * _scatter_s(s, lead)
    lines = _joined(
        [_line(s, lead, *ends) for ends in _stretches(s, lead, within)], s, lead, within
    )
    if not lines:
        return ()
    before, after = (float(s[line.last] - s[line.first]) for line in (lines[0], lines[-1]))
    inner = (_edge(*pair, s) for pair in pairwise(lines))
    edges = [s[lines[0].first] - before, *inner, s[lines[-1].last] + after]
    delayed = {line for pair in pairwise(lines) if not _meet(*pair, s) for line in pair}
    found, gained_s = [], 0.0
    for line, begin, end in zip(lines, edges, edges[1:], strict=False):
        if line in delayed:
            continue
        first, last = float(s[line.first]), float(s[line.last])
        rate = line.slope / (1.0 - line.slope)  # a second of UTC for one of the recorder's
        if (
            abs(line.slope) <= drift_ppm * 1e-6 + 2.0 * within / (last - first)
            or abs(rate) > FASTEST
        ):
            continue
        begin_at, end_at = (begin_ns + round(at * SECOND_NS) for at in (begin, end))
        found.append(Slew(begin_at, end_at, rate))
        gained_s = max(gained_s, abs(line.slope) * (min(end, float(s[-1])) - max(begin, 0.0)))
    return tuple(found) if gained_s >= LEAP_NS * 1e-9 else ()


def _thinned(reports: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Reports at least `SPACING_NS` apart, without repetitions."""
    kept: list[tuple[int, int]] = []
    for t_ns, utc_ns in reports:
        if not kept or (utc_ns - kept[-1][1] >= SPACING_NS and t_ns > kept[-1][0]):
            kept.append((t_ns, utc_ns))
    return kept


def _scatter_s(s: np.ndarray, lead: np.ndarray) -> float:
    """Sigma of a report, from its distance to the line between its neighbours."""
    share = (s[1:-1] - s[:-2]) / (s[2:] - s[:-2])
    off = lead[1:-1] - lead[:-2] - share * (lead[2:] - lead[:-2])
    sigma = float(np.median(np.abs(off))) / 0.6745 / 1.5**0.5  # of three independent ones
    return float(np.clip(sigma, FLOOR_NS * 1e-9, LEAP_NS * 1e-9 / SCATTERS))


def _stretches(s: np.ndarray, lead: np.ndarray, within: float) -> list[tuple[int, int]]:
    """First and last report of each stretch that one line fits. A single report that no neighbour
    agrees with is damage, not a stretch."""
    found, first = [], 0
    while first < len(s) - 1:
        least, most, last = -np.inf, np.inf, first
        for k in range(first + 1, len(s)):
            passed = s[k] - s[first]
            low, high = (lead[k] - lead[first] + by for by in (-2.0 * within, 2.0 * within))
            if max(least, low / passed) > min(most, high / passed):
                break
            least, most, last = max(least, low / passed), min(most, high / passed), k
        found.append((first, last))
        first = last + 1
    return [(a, b) for a, b in found if b - a + 1 >= ENOUGH_REPORTS]


def _line(s: np.ndarray, lead: np.ndarray, first: int, last: int) -> _Line:
    """Robust line through the reports of a stretch (Theil and Sen, by halves)."""
    at, y = s[first : last + 1], lead[first : last + 1]
    half = (len(at) + 1) // 2
    slope = median((y[half:] - y[: len(y) - half]) / (at[half:] - at[: len(at) - half]))
    middle_s = float(at.mean())
    return _Line(first, last, middle_s, float(np.median(y - slope * (at - middle_s))), float(slope))


def _joined(lines: list[_Line], s: np.ndarray, lead: np.ndarray, within: float) -> list[_Line]:
    """Stretches, neighbours merged if one line fits both."""
    found: list[_Line] = []
    for line in lines:
        found.append(line)
        while len(found) > 1:
            both = _line(s, lead, found[-2].first, found[-1].last)
            at, y = s[both.first : both.last + 1], lead[both.first : both.last + 1]
            off = np.abs(y - both.lead_s - both.slope * (at - both.middle_s))
            if int((off > within).sum()) > DAMAGED:
                break
            found[-2:] = [both]
    return found


def _meet(one: _Line, other: _Line, s: np.ndarray) -> bool:
    """True if a clock can continue from one line to the next without a jump. Delayed reports of a
    queue jump when the queue builds up or ends."""
    last, first = float(s[one.last]), float(s[other.first])
    middle = (last + first) / 2.0
    ends = (line.lead_s + line.slope * (middle - line.middle_s) for line in (one, other))
    steepest = max(abs(one.slope), abs(other.slope))
    return abs(next(ends) - next(ends)) < LEAP_NS * 1e-9 + steepest * (first - last)


def _edge(one: _Line, other: _Line, s: np.ndarray) -> float:
    """Time at which a line gives way to the next: their intersection, if between their middles."""
    between = float(s[one.last] + s[other.first]) / 2.0
    turn = one.slope - other.slope
    if not turn:
        return between
    of_one, of_other = (line.lead_s - line.slope * line.middle_s for line in (one, other))
    meet = (of_other - of_one) / turn
    return meet if one.middle_s < meet < other.middle_s else between
