"""Mapping of a device's counter to the host's monotonic clock, from delayed samples.

    d_i = t_seen_i - ticks_i = offset + delay_i,    delay_i >= its least value

The delay is one-sided, so the offset is the lower envelope of d: the minimum over a window, where
an old minimum may have moved by the allowed drift since (Moon, Skelly, Towsley, "Estimation and
removal of clock skew from network delay measurements", INFOCOM 1999, without the linear program).

Everything is integer nanoseconds. A pure function of its inputs.
"""

from __future__ import annotations

from collections import Counter, deque

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS

_BUCKETS = 16
_SLEW_DIVISOR = 100
"""Divisor of an upward correction: it stretches the spacing of samples by at most 1 %."""
_JITTER_NS = 50 * MILLISECOND_NS
"""Jitter limit: above the jitter of a serial line (1 to 16 ms for USB); 5000 ppm of drift over the
window."""
_DELAYED_FOR_NS = 120 * SECOND_NS
"""A busy host is late for seconds; what lasts for two minutes is the device's clock."""
_CONFIRM_SAMPLES = 3


class OffsetFilter:
    """Lower envelope of arrival minus source time, forgetting with the allowed drift.

    `offset_ns` (host minus source) is None before the first sample. It falls at once, because
    nothing is true after it has arrived, and rises smoothly, so that the spacing of mapped samples
    follows the source. Old minima expire after `window_s` of newer samples, not by age alone: a
    source with rare samples keeps its best ones. If all samples of a window are delayed beyond
    jitter and drift, the offset rises by the drift alone for two minutes; then it jumps (`snaps`).
    """

    def __init__(self, drift_ppm: float, window_s: float) -> None:
        self._ppb = round(drift_ppm * 1000)
        self._bucket_ns = max(1, round(window_s * SECOND_NS) // _BUCKETS)
        self._minima: deque[int] = deque(maxlen=_BUCKETS)
        self._bucket = -1
        self._t_seen_ns = 0
        self._delayed_since_ns: int | None = None
        self.offset_ns: int | None = None
        self.snaps = 0

    def update(self, t_source_ns: int, t_seen_ns: int) -> int:
        """Take one arrival in; the offset that holds now, never above this arrival's own."""
        d = t_seen_ns - t_source_ns
        leak = t_seen_ns * self._ppb // SECOND_NS
        bucket = t_seen_ns // self._bucket_ns
        if bucket > self._bucket or not self._minima:
            self._minima.append(d - leak)
            self._bucket = bucket
        else:
            self._minima[-1] = min(self._minima[-1], d - leak)
        envelope = min(self._minima) + leak
        offset = d if self.offset_ns is None else self.offset_ns
        rise = envelope - offset
        passed = max(0, t_seen_ns - self._t_seen_ns)
        if rise <= _JITTER_NS:
            self._delayed_since_ns = None
        elif self._delayed_since_ns is None:
            self._delayed_since_ns = t_seen_ns
        if self._delayed_since_ns is not None:
            if t_seen_ns - self._delayed_since_ns > _DELAYED_FOR_NS:
                self.snaps += 1
                offset = envelope
            else:
                offset += passed * self._ppb // SECOND_NS
        elif rise > 0:
            offset += min(rise, passed // _SLEW_DIVISOR)
        else:
            offset = envelope
        self._t_seen_ns = max(t_seen_ns, self._t_seen_ns)
        self.offset_ns = offset
        return offset


class DeviceClock:
    """A device's free-running counter on the host's monotonic clock.

    Mapped instants never run backwards while the counter does not, not even over a restart. A count
    that disagrees with its arrival is held back, and its sample stamped like its neighbours, by
    arrival. Three in a row that agree with each other mean that the clock has been set. Counters:
    `device_tick_odd`, `device_clock_restarted`, `device_clock_relearned` (all samples had been
    delayed for minutes).
    """

    _WINDOW_S = 10.0

    def __init__(self, drift_ppm: float, counters: Counter[str]) -> None:
        self._drift_ppm = drift_ppm
        self._counters = counters
        self._filter = OffsetFilter(drift_ppm, self._WINDOW_S)
        self._ticks_ns: int | None = None
        self._t_ns = 0
        self._lag_ns = 0
        self._odd: list[tuple[int, int]] = []

    def to_monotonic(self, ticks_ns: int, t_seen_ns: int) -> int:
        """Monotonic instant (ns) of `ticks_ns`, which arrived at `t_seen_ns`.

        Not after it, but for one nanosecond a sample where only that keeps them in order.
        """
        last = self._ticks_ns
        if last is not None and self._is_odd(ticks_ns, last, t_seen_ns):
            if not self._follow(ticks_ns, t_seen_ns):
                self._t_ns = max(t_seen_ns - self._lag_ns, self._t_ns + 1)
                return self._t_ns
            last = None
        else:
            self._odd.clear()
            snaps = self._filter.snaps
            self._filter.update(ticks_ns, t_seen_ns)
            self._counters["device_clock_relearned"] += self._filter.snaps - snaps
        assert self._filter.offset_ns is not None
        t_ns = ticks_ns + self._filter.offset_ns
        if last is not None and ticks_ns < last:
            return t_ns  # out of order on the line: true, and older than the one before
        # Two samples of one instant share it; a later one is later, if only by a nanosecond.
        t_ns = max(t_ns, self._t_ns + (ticks_ns != last))
        self._t_ns = t_ns
        self._ticks_ns = ticks_ns
        self._lag_ns = max(0, t_seen_ns - t_ns)
        return t_ns

    def _is_odd(self, ticks_ns: int, last_ns: int, t_seen_ns: int) -> bool:
        """True for a count after its own arrival, or before the last sample: no latency explains
        it."""
        assert self._filter.offset_ns is not None
        early_ns = ticks_ns + self._filter.offset_ns - t_seen_ns
        return early_ns > _JITTER_NS or ticks_ns < last_ns - _JITTER_NS

    def _follow(self, ticks_ns: int, t_seen_ns: int) -> bool:
        """True if the rejected counts and this one form the clock's new reading."""
        assert self._filter.offset_ns is not None
        self._counters["device_tick_odd"] += 1
        d = t_seen_ns - ticks_ns
        if self._odd and abs(d - (self._odd[-1][1] - self._odd[-1][0])) > _JITTER_NS:
            self._odd.clear()
        self._odd.append((ticks_ns, t_seen_ns))
        if len(self._odd) < _CONFIRM_SAMPLES:
            return False
        self._counters["device_clock_restarted"] += 1
        self._filter = OffsetFilter(self._drift_ppm, self._WINDOW_S)
        for ticks, seen in self._odd:
            self._filter.update(ticks, seen)
        self._odd.clear()
        return True
