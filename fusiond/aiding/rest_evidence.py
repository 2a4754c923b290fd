r"""Evidence for or against rest beside a quiet IMU: measured speeds, and quiet while driving.

    m = sum(v_k) / n,   s = max(sd / sqrt(n), s_0),   contradicts rest if m^2 / s^2 > chi2(0.999)

over the velocities v_k (north, east, or a wheel's speed) of one kind in a span of time. n fixes
average: 0.2 m/s is seen by five fixes of 0.1 m/s. s_0 is what does not average: multipath, and the
rounding of a speed that stays the same. A wheel's drift by sd_d, a process of first order of time
T, averages by what fits into the span of x T: it is sure with

    s = max(sqrt(sd^2 / n + a sd_d^2), s_0),   a = max(2 (x - 1 + exp(-x)) / x^2, 1 / n)

Source: Groves, 2nd ed., section 9.4.3 for Doppler velocity, section 15.3 for zero-velocity
measurements; Gelb, Applied Optimal Estimation, chapter 3, for the process; a is its mean's variance
by double integration of exp(-|t - s| / T).
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import defaultdict, deque
from collections.abc import Sequence
from typing import NamedTuple

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.initialisation_candidates import STEADY, SpeedCandidate, VelocityCandidate

# What remains of an averaged velocity (m/s): multipath moves a receiver's Doppler by a centimetre
# or two a second, for seconds alike.
LEAST_SD_M_S = 0.02
# A test of rest refuses a vehicle at rest once in a thousand windows: it loses one measurement of
# many. Quantiles of chi-square of one and two degrees of freedom.
CONTRADICTION = (10.83, 13.82)
# Kept longer than any history: a rewind asks again.
KEEP_NS = 700_000_000_000
# Measurements that may wait to be taken in: a tick's, and those of minutes where no sample comes.
MOST_WAITING = 4096
# Spans of which sums are kept: that of the standstill so far, and those of windows in it.
MOST_SUMS = 8
# Spans of which it is kept what they say, two a window: those of two minutes. A rewind asks for
# those within the history again.
MOST_SPANS = 256
# A ride is smooth if this many windows of this time were quiet at a speed that is no rest: chance
# makes one or two where driving shakes the vehicle.
SMOOTH_WINDOWS, SMOOTH_NS = 3, 300_000_000_000


class Measured(NamedTuple):
    """Result of the measured speeds of a span: contradiction of rest, sigma (m/s) of the best mean
    (infinite without one), and `surely`: contradiction beyond their drift. A claim of rest uses the
    first, a test of the gyros the last: a drift of a wheel is no reason to trust a gyro."""

    contradicts: bool
    sd: float
    surely: bool


class _Speed(NamedTuple):
    """Velocity or speed (m/s) with its sigma, its part that does not average out, and its drift:
    sigma (m/s) and time constant (s)."""

    t_ns: int
    v: tuple[float, ...]
    sd: float
    rounding: float
    drifts: tuple[float, float]


class _Sum(NamedTuple):
    """Sums over the first `number` speeds of a span: variances and axes; the largest part that does
    not average out."""

    number: int
    variance: float
    v: tuple[float, ...]
    rounding: float

    def of(self, rows: Sequence[_Speed]) -> _Sum:
        """Sums with further rows in order, bit for bit as computed at once."""
        variance, total, rounding = self.variance, list(self.v), self.rounding
        for row in rows:
            variance += row.sd * row.sd
            rounding = max(rounding, row.rounding)
            for axis in range(len(total)):
                total[axis] += row.v[axis]
        return _Sum(self.number + len(rows), variance, tuple(total), rounding)


def _drifted(first: _Speed, last: _Speed, number: int) -> float:
    """Variance (m/s)^2 of the mean drift of so many speeds from `first` to `last`."""
    sd, time_s = last.drifts
    if not sd:
        return 0.0
    x = (last.t_ns - first.t_ns) * 1e-9 / time_s
    # Below 1e-3 the series is 1 - x / 3, and the difference has no digits left.
    alike = 2.0 * (x - 1.0 + math.exp(-x)) / (x * x) if x > 1e-3 else 1.0 - x / 3.0
    return sd * sd * max(alike, 1.0 / number)


class RestEvidence:
    """Measured speeds, and the quiet windows that were not rest."""

    def __init__(self) -> None:
        self.waiting: deque[AidingMeasurement] = deque(maxlen=MOST_WAITING)
        """Measurements that have come and are taken in when somebody asks."""
        self._speeds: defaultdict[str, list[_Speed]] = defaultdict(list)
        self._at_speed: list[int] = []
        self._by_span: dict[tuple[int, int], Measured] = {}
        """Results of `measured` by span, requested at every tick and after each rewind; dropped
        when a speed arrives in the span."""
        self._by_span_until_ns = 0
        """Latest end of the cached spans."""
        self._sums: dict[tuple[str, int], _Sum] = {}
        """Sums by source and start of a span; a standstill of minutes is tested with each speed."""

    def receive(self, measurements: Sequence[AidingMeasurement]) -> None:
        """Receive a measurement. Raw epochs are left to the filter, which uses the rates of all
        satellites: their own velocity would be costly."""
        for measurement in measurements:
            if measurement.screened or measurement.locates:
                continue
            for candidate in measurement.candidates():
                match candidate:
                    case VelocityCandidate():
                        speed = _Speed(
                            candidate.t_ns, candidate.v_ned[:2], max(candidate.sd[:2]), 0.0, STEADY
                        )
                    case SpeedCandidate():
                        own = candidate.sd_m_s, candidate.rounding_sd_m_s, candidate.drifts
                        speed = _Speed(candidate.t_ns, (candidate.speed_m_s,), *own)
                    case _:
                        continue
                if speed.t_ns <= self._by_span_until_ns:
                    self._by_span.clear()
                    self._by_span_until_ns = 0
                speeds = self._speeds[measurement.source]
                if speeds and speed < speeds[-1]:
                    self._sums.clear()
                    insort(speeds, speed)
                else:
                    speeds.append(speed)
                if speeds[0][0] < speeds[-1][0] - 2 * KEEP_NS:
                    self._sums.clear()
                    self._by_span.clear()
                    del speeds[: bisect_left(speeds, (speeds[-1][0] - KEEP_NS,))]

    def catch_up(self) -> None:
        """Process waiting speeds."""
        if self.waiting:
            waiting = tuple(self.waiting)
            self.waiting.clear()
            self.receive(waiting)

    def measured(self, begin_ns: int, end_ns: int) -> Measured:
        """Speeds measured from `begin_ns` to `end_ns`, both included."""
        self.catch_up()
        span = begin_ns, end_ns
        found = self._by_span.get(span)
        if found is None:
            if len(self._by_span) >= MOST_SPANS:
                self._by_span.clear()
            found = self._by_span[span] = self._measured(begin_ns, end_ns)
            self._by_span_until_ns = max(self._by_span_until_ns, end_ns)
        return found

    def _measured(self, begin_ns: int, end_ns: int) -> Measured:
        contradicts, best, surely = False, math.inf, False
        for source, speeds in self._speeds.items():
            first, last = bisect_left(speeds, (begin_ns,)), bisect_left(speeds, (end_ns + 1,))
            if first >= last:
                continue
            found = self._sum(source, speeds, first, last, begin_ns)
            least, variance = found.rounding**2, found.variance / found.number**2
            square = sum((total / found.number) ** 2 for total in found.v)
            square /= CONTRADICTION[len(found.v) - 1]
            contradicts |= square > max(variance, least)
            variance += _drifted(speeds[first], speeds[last - 1], found.number)
            surely |= square > max(variance, least)
            best = min(best, max(variance, least))
        return Measured(contradicts, math.sqrt(best), surely)

    def _sum(self, source: str, speeds: list[_Speed], first: int, last: int, begin_ns: int) -> _Sum:
        """Sum over a source's speeds `first` to `last`-1, continued from that of a shorter span."""
        known = self._sums.get((source, begin_ns))
        if known is None or known.number > last - first:
            known = _Sum(0, 0.0, (0.0,) * len(speeds[first].v), LEAST_SD_M_S)
        found = known.of(speeds[first + known.number : last])
        if len(self._sums) >= MOST_SUMS:
            self._sums.clear()
        self._sums[source, begin_ns] = found
        return found

    def velocity(self, begin_ns: int, end_ns: int) -> tuple[float, float, float] | None:
        """Mean velocity north, east (m/s) of one source, and the sigma of one of its measurements.

        From `begin_ns` to `end_ns`, both included; the source is the one with the most
        measurements."""
        self.catch_up()
        found: list[_Speed] = []
        for speeds in self._speeds.values():
            rows = speeds[bisect_left(speeds, (begin_ns,)) : bisect_left(speeds, (end_ns + 1,))]
            if len(rows) > len(found) and len(rows[0].v) == 2:
                found = rows
        if not found:
            return None
        north, east = (sum(row.v[axis] for row in found) / len(found) for axis in range(2))
        return north, east, max(row.sd for row in found)

    def quiet_at_speed(self, t_ns: int, at_speed: bool) -> None:
        """True if the quiet window that ended at `t_ns` was at speed; a rewind may change the
        result."""
        row = bisect_left(self._at_speed, t_ns)
        known = row < len(self._at_speed) and self._at_speed[row] == t_ns
        if at_speed and not known:
            self._at_speed.insert(row, t_ns)
            if self._at_speed[0] < self._at_speed[-1] - 2 * KEEP_NS:
                del self._at_speed[: bisect_left(self._at_speed, self._at_speed[-1] - KEEP_NS)]
        elif known and not at_speed:
            del self._at_speed[row]

    def smooth_ride(self, t_ns: int) -> bool:
        """True if, before `t_ns`, the vehicle was as quiet at speed as at rest, so that quiet
        proves nothing."""
        first = bisect_right(self._at_speed, t_ns - SMOOTH_NS)
        return bisect_left(self._at_speed, t_ns) - first >= SMOOTH_WINDOWS
