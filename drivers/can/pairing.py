"""Assembly of an IMU's frames of one instant, with counts of missing ones. No I/O.

An IMU sends a sample in several messages. Two frames belong together if

* both carry the same counter, or the same time, of the device; or else * the second came less than
half a sample interval after the first, and its message is still
  missing. A message that carries only counter or time (Xsens 0x005/0x006, SBG 0x120) joins so too
  and lends its stamp to the whole sample.

The interval T is the median distance of one message's frames, by the device's time where there is
one, else by arrival. Lost samples: with a counter of
modulus M that advanced by c, the n = c (mod M) nearest to dt/T, minus one; without, the excess of
dt over T, rounded once a sample is on time again, so that jitter makes no losses.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.can.dbc import MessagePlan, Part
from drivers.can.device_time import DeviceTime

INTERVALS = 31
"""Distances of frames the median is taken of: outlives a burst of fifteen late frames."""
INTERVALS_NEEDED = 4
"""Fewest intervals that determine the frame interval; unstamped frames are not paired before
(`unpaired`)."""
OPEN_GROUPS = 4
"""Most incomplete samples at once; a device queues one or two."""


@dataclass(slots=True, eq=False)
class Group:
    """The frames of one sample; `realtime_ns` and `first_ns` are of the first frame."""

    realtime_ns: int | None
    first_ns: int
    """Arrival on the clock that pairs: the kernel's stamp, else the monotonic clock."""
    last_ns: int
    t_seen_ns: int
    values: list[float]
    missing: int
    """Bit for each message whose frame is missing."""
    counter: int | None = None
    ticks: int | None = None
    ticks_ns: int | None = None
    key: int | None = None
    frames: int = 0


@dataclass(slots=True)
class _Last:
    """Last frame of a message, to recognise a duplicate."""

    data: bytes = b""
    arrival_ns: int = 0
    ticks: int | None = None
    seen: bool = False


@dataclass(slots=True)
class _Losses:
    """State for counting losses."""

    at_ns: int | None = None
    counter: int | None = None
    excess: float = 0.0


class Pairing:
    """Assembler of samples from the parts in their frames.

    `counters`: `lost_samples`, `unpaired` (frames whose partners never came), `duplicates`,
    `time_backward` (device time that stood still or went back), `device_restarts`.
    """

    def __init__(
        self,
        plans: Sequence[MessagePlan],
        constants: Sequence[float],
        counters: Counter[str],
    ) -> None:
        self._plans = list(plans)
        self._constants = list(constants)
        self._counters = counters
        self._by_counter = sum(plan.counter is not None for plan in plans) > 1
        self._by_time = not self._by_counter and sum(p.time is not None for p in plans) > 1
        timed = [i for i, plan in enumerate(plans) if plan.time]
        self._lead = timed[0] if timed else next(i for i, p in enumerate(plans) if p.axes)
        self._counter_modulus = next((p.counter.modulus for p in plans if p.counter), 0)
        time = next((p.time for p in plans if p.time), None)
        self.device_time = DeviceTime(time.modulus, time.tick_ns) if time else None
        self.interval_ns: int | None = None
        self._intervals_ns: deque[int] = deque()
        self._sorted_ns: list[int] = []
        self._open: list[Group] = []
        self._all = (1 << len(self._plans)) - 1
        self._stamped = [p.counter is not None or p.time is not None for p in self._plans]
        self._last = [_Last() for _ in self._plans]
        self._losses = _Losses()

    def reset(self) -> None:
        """Give up the open groups before a pause."""
        self._make_room(0)

    def feed(
        self, index: int, part: Part, data: bytes, t_seen_ns: int, realtime_ns: int | None
    ) -> Group | None:
        """Add a part of message `index`; return the sample that it completes, if any."""
        arrival_ns = t_seen_ns if realtime_ns is None else realtime_ns
        key = self._key(part)
        last = self._last[index]
        if data == last.data and last.seen and self._is_duplicate(index, arrival_ns):
            self._counters["duplicates"] += 1
            return None
        if index == self._lead:
            self._learn_interval(index, part.ticks, arrival_ns)
        last.data, last.arrival_ns, last.ticks, last.seen = data, arrival_ns, part.ticks, True
        alone = self._all == 1  # one message is a whole sample: no group is open
        group = None if alone else self._group(1 << index, key, arrival_ns)
        if group is None:
            values = self._constants.copy()
            group = Group(realtime_ns, arrival_ns, arrival_ns, t_seen_ns, values, self._all)
            if not alone:
                self._make_room(OPEN_GROUPS - 1 if key is not None else 0)
                self._open.append(group)
        group.key = key if key is not None else group.key
        for slot, value in part.values:
            group.values[slot] = value
        group.counter = part.counter if part.counter is not None else group.counter
        group.ticks = part.ticks if part.ticks is not None else group.ticks
        group.missing &= ~(1 << index)
        group.last_ns, group.t_seen_ns = arrival_ns, t_seen_ns
        group.frames += 1
        if group.missing:
            return None
        if not alone:
            self._close(group)
        return self._finish(group)

    # ----------------------------------------------------------------- which group

    def _key(self, part: Part) -> int | None:
        """Stamp to pair by, if several messages carry one."""
        if self._by_counter:
            return part.counter
        return part.ticks if self._by_time else None

    def _is_duplicate(self, index: int, arrival_ns: int) -> bool:
        """True for a repeated frame: the same inner stamp, or too early for a new sample."""
        if self._stamped[index]:
            return True
        interval_ns = self.interval_ns
        distance_ns = abs(arrival_ns - self._last[index].arrival_ns)
        return interval_ns is not None and distance_ns < interval_ns / 2

    def _learn_interval(self, index: int, ticks: int | None, arrival_ns: int) -> None:
        last, time = self._last[index], self._plans[index].time
        distance_ns = arrival_ns - last.arrival_ns
        if time is not None and ticks is not None and last.ticks is not None:
            tick_ns = time.tick_ns
            passed = (ticks - last.ticks) % time.modulus
            distance_ns = passed * tick_ns.numerator // tick_ns.denominator
        if last.seen and distance_ns > 0:
            recent, ordered = self._intervals_ns, self._sorted_ns
            recent.append(distance_ns)
            insort(ordered, distance_ns)
            count = len(recent)
            if count > INTERVALS:
                del ordered[bisect_left(ordered, recent.popleft())]
                count = INTERVALS
            if count >= INTERVALS_NEEDED:
                self.interval_ns = (ordered[(count - 1) // 2] + ordered[count // 2]) // 2

    def _group(self, bit: int, key: int | None, arrival_ns: int) -> Group | None:
        for group in reversed(self._open):
            if not group.missing & bit:
                continue
            if key is not None and group.key is not None:
                if key == group.key:
                    return group
            elif self._near(group, arrival_ns):
                return group
        return None

    def _near(self, group: Group, arrival_ns: int) -> bool:
        """True within half an interval after the group's last frame.

        While the interval is unknown, true for a group that has a stamp.
        """
        if self.interval_ns is None:
            return group.counter is not None or group.ticks is not None
        return abs(arrival_ns - group.last_ns) < self.interval_ns / 2

    def _make_room(self, keep: int) -> None:
        """Give up the oldest open groups: one stays open at a time unless keys tell them apart."""
        while len(self._open) > keep:
            self._counters["unpaired"] += self._open.pop(0).frames

    # ----------------------------------------------------------------- complete

    def _close(self, group: Group) -> None:
        """Close a complete group and give up incomplete earlier ones."""
        position = self._open.index(group)
        for older in self._open[:position]:
            self._counters["unpaired"] += older.frames
        del self._open[: position + 1]

    def _finish(self, group: Group) -> Group | None:
        at_ns = group.first_ns
        if self.device_time is not None and group.ticks is not None:
            restarts = self.device_time.restarts
            arrivals_ns = group.first_ns, group.t_seen_ns
            ticks_ns = self.device_time.unwrap(group.ticks, arrivals_ns)
            if ticks_ns is None:
                self._counters["time_backward"] += 1
                return None
            if self.device_time.restarts != restarts:
                self._counters["device_restarts"] += 1
                self._losses.at_ns = None
            group.ticks_ns = at_ns = ticks_ns
        self._count_losses(group, at_ns)
        return group

    def _count_losses(self, group: Group, at_ns: int) -> None:
        losses, interval_ns = self._losses, self.interval_ns
        before_ns, losses.at_ns = losses.at_ns, at_ns
        counter, losses.counter = losses.counter, group.counter
        if before_ns is None:
            losses.excess = 0.0
            return
        steps = (at_ns - before_ns) / interval_ns if interval_ns else 1.0
        if counter is not None and group.counter is not None:
            advance = (group.counter - counter) % self._counter_modulus
            wraps = max(0, round((steps - advance) / self._counter_modulus))
            lost = advance + wraps * self._counter_modulus - 1
            self._counters["lost_samples"] += max(0, lost)
            return
        losses.excess += steps - 1.0
        if 0.5 <= steps <= 1.5:
            self._counters["lost_samples"] += max(0, round(losses.excess))
            losses.excess = 0.0
        elif steps <= 0.0:
            losses.excess = 0.0  # the clock of the stamps was set
