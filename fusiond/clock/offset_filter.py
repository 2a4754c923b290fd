"""Mapping a remote clock to the host's monotonic clock from stamps that arrive late.

    d_i = t_seen_i - t_source_i = offset + delay_i,    delay_i >= its least value

The delay is one-sided, so the offset is the lower envelope of d: the minimum over a window, where
an old minimum may have moved by the allowed drift since (Moon, Skelly, Towsley, "Estimation and
removal of clock skew from network delay measurements", INFOCOM 1999, without the linear program).

Everything is integer nanoseconds: UTC in ns does not fit a double. A pure function of its inputs.
"""

from __future__ import annotations

from collections import Counter, deque

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
_BUCKETS = 16
_SLEW_DIVISOR = 100
"""An upward correction stretches the spacing of samples by at most 1 %."""
_SNAP_NS = 50 * MILLISECOND_NS
"""Beyond the jitter of a serial line (1 to 16 ms for USB) an upward error is a wrong minimum."""
_RESTART_NS = SECOND_NS
"""A device clock that moves by more than this against the host has been restarted."""
_LATER_NS = 500 * MILLISECOND_NS
"""UTC reports are at most 200 ms late on a serial line; 0.5 s more than usual is a jump of UTC."""
_EARLIER_NS = 1500 * MILLISECOND_NS
"""Whole-second reports scatter by 1 s; an envelope that falls by more is a jump of UTC."""
_AGREE_NS = 100 * MILLISECOND_NS
_CONFIRM_REPORTS = 3
_CONFIRM_SPAN_NS = SECOND_NS
"""A jump counts once three reports over a second agree; a burst of late lines does not."""


class OffsetFilter:
    """Lower envelope of arrival minus source time, forgetting with the allowed drift.

    `offset_ns` (host minus source) is None before the first sample. It falls at once, because
    nothing is true after it has arrived, and rises smoothly, so that the spacing of mapped
    samples follows the source. Old minima go when `window_s` of newer samples have come, not by
    age alone: a source that is heard rarely keeps its best samples.
    """

    def __init__(self, drift_ppm: float, window_s: float) -> None:
        self._ppb = round(drift_ppm * 1000)
        self._bucket_ns = max(1, round(window_s * SECOND_NS) // _BUCKETS)
        self._minima: deque[int] = deque(maxlen=_BUCKETS)
        self._bucket = -1
        self._t_seen_ns = 0
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
        if rise > _SNAP_NS:
            self.snaps += 1
            offset = envelope
        elif rise > 0:
            offset += min(rise, max(0, t_seen_ns - self._t_seen_ns) // _SLEW_DIVISOR)
        else:
            offset = envelope
        self._t_seen_ns = max(t_seen_ns, self._t_seen_ns)
        self.offset_ns = offset
        return offset


class DeviceClock:
    """A device's free-running counter on the host's monotonic clock.

    Mapped instants never run backwards while the counter does not, not even over a restart.
    Counters: `device_clock_restarted`, `device_clock_relearned` (the envelope was poisoned by a
    wrong stamp, and has recovered).
    """

    _WINDOW_S = 10.0

    def __init__(self, drift_ppm: float, counters: Counter[str]) -> None:
        self._drift_ppm = drift_ppm
        self._counters = counters
        self._filter = OffsetFilter(drift_ppm, self._WINDOW_S)
        self._ticks_ns: int | None = None
        self._t_ns = 0

    def to_monotonic(self, ticks_ns: int, t_seen_ns: int) -> int:
        """Monotonic instant (ns) of `ticks_ns`, which came in at `t_seen_ns`.

        Not after it, but for one nanosecond a sample where only that keeps them in order.
        """
        offset = self._filter.offset_ns
        last = self._ticks_ns
        if (
            last is not None
            and offset is not None
            and (ticks_ns < last - _RESTART_NS or ticks_ns + offset > t_seen_ns + _RESTART_NS)
        ):
            self._counters["device_clock_restarted"] += 1
            self._filter = OffsetFilter(self._drift_ppm, self._WINDOW_S)
            last = None
        snaps = self._filter.snaps
        t_ns = ticks_ns + self._filter.update(ticks_ns, t_seen_ns)
        self._counters["device_clock_relearned"] += self._filter.snaps - snaps
        if last is not None and ticks_ns < last:
            return t_ns  # out of order on the line: true, and older than the one before
        # Two samples of one instant share it; a later one is later, if only by a nanosecond.
        t_ns = max(t_ns, self._t_ns + (ticks_ns != last))
        self._t_ns = t_ns
        self._ticks_ns = ticks_ns
        return t_ns


class UtcEnvelope:
    """One source's UTC on the host's monotonic clock, learnt from when its reports arrive.

    A report that does not fit is held back. When enough of them agree with each other, UTC has
    jumped (leap second, leap seconds learnt after a cold start, a corrected receiver) and the
    mapping starts again from them. Counters: `utc_report_odd`, `utc_jump`.
    """

    _WINDOW_S = 30.0

    def __init__(self, drift_ppm: float, counters: Counter[str]) -> None:
        self._drift_ppm = drift_ppm
        self._counters = counters
        self._filter = OffsetFilter(drift_ppm, self._WINDOW_S)
        self._odd: list[tuple[int, int]] = []
        self.t_seen_ns = 0

    @property
    def offset_ns(self) -> int:
        """Host monotonic minus UTC, including the least delay of this source's reports."""
        assert self._filter.offset_ns is not None, "made from its first report"
        return self._filter.offset_ns

    @property
    def settled(self) -> bool:
        """False while reports contradict the mapping and it is not known which is right."""
        return not self._odd

    def update(self, utc_ns: int, t_seen_ns: int) -> None:
        """Take one report in."""
        self.t_seen_ns = t_seen_ns
        d = t_seen_ns - utc_ns
        known = self._filter.offset_ns
        if known is None or -_EARLIER_NS <= d - known <= _LATER_NS:
            self._odd.clear()
            self._filter.update(utc_ns, t_seen_ns)
            return
        self._counters["utc_report_odd"] += 1
        if self._odd:
            first_utc_ns, first_seen_ns = self._odd[0]
            if abs(d - (first_seen_ns - first_utc_ns)) > _AGREE_NS:
                self._odd.clear()
        if len(self._odd) < _BUCKETS * _BUCKETS:
            self._odd.append((utc_ns, t_seen_ns))
        if len(self._odd) >= _CONFIRM_REPORTS and t_seen_ns - self._odd[0][1] >= _CONFIRM_SPAN_NS:
            self._counters["utc_jump"] += 1
            self._filter = OffsetFilter(self._drift_ppm, self._WINDOW_S)
            for report in self._odd:
                self._filter.update(*report)
            self._odd.clear()
