"""The host's clocks: effects of steps, slews and suspend.

    CLOCK_MONOTONIC_RAW   the quartz alone: never steps or slews, stands still in suspend
    CLOCK_MONOTONIC       the same, slewed with realtime (adjtimex(2): 10 % at most)
    CLOCK_BOOTTIME        CLOCK_MONOTONIC, but goes on in suspend (clock_gettime(2))
    CLOCK_REALTIME        follows UTC; slewed and stepped by any program that sets it

Instants are those of the first, *monotonic* here. If realtime gains on it by more than a
disciplined quartz does, the gain of CLOCK_MONOTONIC is a slew, the gain of boottime on that is
suspend, and the rest is a step. Host time is injected.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Literal, Protocol

from drivers.base import monotonic_ns

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
KERNEL_FUTURE_NS = MILLISECOND_NS
"""Bound on kernel stamps: no stamp lies further ahead than the two clocks' readings are apart."""

_STEP_NS = MILLISECOND_NS
"""A quartz is disciplined by 500 ppm at most (adjtimex(2)); what is beyond 1000 ppm and 1 ms is
looked into."""
_SLEW_PER_NS = 1000
_RATE_SPAN_NS = 100 * MILLISECOND_NS
"""Two readings this far apart, each to `_BRACKET_NS`, tell a rate to half of `_SLEW_PER_NS`."""
_BRACKET_NS = 50_000
"""Longest bracket of a realtime reading by two monotonic ones; a longer one was interrupted."""
_SLEPT_NS = 10 * MILLISECOND_NS
"""Boottime minus monotonic is constant while the host runs; reading both takes microseconds."""
_AFTER_STEP_NS = 2 * SECOND_NS
"""Time after a step of the system clock until no frame in the kernel's queue has an older stamp."""
_BELIEVE_STEP_NS = 120 * SECOND_NS
"""Time after which a step is believed; chrony reverts its own first step within two minutes."""

ReadClock = Literal["realtime", "boottime", "slewed"]


_KNOWN = (
    *("_sampled_ns", "offset_ns", "_boot_ns", "before_step_ns", "held_ns", "slept_ns", "changes"),
    *("last_step_ns", "_queued_ns", "_stepped_ns"),
)
"""The attributes that are a `SystemClock`'s state."""
_KNOWN_OF_SLEWS = ("_slewed_ns", "_unslewed_ns", "_rate_ppb", "_rated_ns", "_rated_offset_ns")
"""Those that logs of before 2026-11-28 do not hold: instants are of CLOCK_MONOTONIC there."""


class HostTime(Protocol):
    """The host's clocks, CLOCK_MONOTONIC_RAW, CLOCK_MONOTONIC (`slewed_ns`), CLOCK_REALTIME and
    CLOCK_BOOTTIME, in ns."""

    def monotonic_ns(self) -> int: ...
    def slewed_ns(self) -> int: ...
    def realtime_ns(self) -> int: ...
    def boottime_ns(self) -> int: ...


class SystemTime:
    """Clocks of this computer."""

    monotonic_ns = staticmethod(monotonic_ns)

    @staticmethod
    def slewed_ns() -> int:
        return time.monotonic_ns()

    @staticmethod
    def realtime_ns() -> int:
        return time.time_ns()

    @staticmethod
    def boottime_ns() -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class Readings:
    """Lead of the host's other clocks over the monotonic one: `(t_ns, ahead_ns)` each.

    `on_reading(clock, t_ns, ahead_ns)` receives every reading, so that all input of a `Clock` from
    the host can be recorded.
    """

    def __init__(self, host: HostTime) -> None:
        self._host = host
        self.on_reading: Callable[[ReadClock, int, int], None] | None = None

    def realtime(self) -> tuple[int, int]:
        """CLOCK_REALTIME against the monotonic clock, ns."""
        return self._read("realtime", self._host.realtime_ns)

    def boottime(self) -> tuple[int, int]:
        """CLOCK_BOOTTIME against the monotonic clock, ns."""
        return self._read("boottime", self._host.boottime_ns)

    def slewed(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC against the monotonic clock, ns."""
        return self._read("slewed", self._host.slewed_ns)

    def _read(self, clock: ReadClock, other_ns: Callable[[], int]) -> tuple[int, int]:
        best: tuple[int, int, int] | None = None
        for _ in range(3):
            before = self._host.monotonic_ns()
            other = other_ns()
            after = self._host.monotonic_ns()
            middle = (before + after) // 2
            if best is None or after - before < best[0]:
                best = (after - before, middle, other - middle)
            if best[0] <= _BRACKET_NS:
                break
        assert best is not None
        if self.on_reading is not None:
            self.on_reading(clock, best[1], best[2])
        return best[1], best[2]


class SystemClock:
    """CLOCK_REALTIME minus monotonic time: as it is, before its last step, and as it is held.

    `held_ns` follows slews and sleep at once, a step only after two minutes: a step does not move
    the instants of measurements. Counters: `system_clock_stepped`.
    """

    def __init__(self, readings: Readings, counters: Counter[str]) -> None:
        self._readings = readings
        self._counters = counters
        self._sampled_ns, self.offset_ns = readings.realtime()
        self._slewed_ns = readings.slewed()[1]
        self._unslewed_ns = self.offset_ns - self._slewed_ns
        self._boot_ns = readings.boottime()[1] - self._slewed_ns
        self._rate_ppb = 0
        self._rated_ns, self._rated_offset_ns = self._sampled_ns, self.offset_ns
        self.before_step_ns: int | None = None
        self.held_ns = self.offset_ns
        self.slept_ns = 0
        self.changes = 0
        self.last_step_ns = 0
        self._queued_ns = self._stepped_ns = self._sampled_ns

    def sample(self) -> int:
        """Read the clock again, notice sleep and steps; realtime minus monotonic in ns.

        `slept_ns` is the sleep since this was made, `changes` the number of sleeps and steps,
        `last_step_ns` the step that was part of the last one.
        """
        now, offset = self._readings.realtime()
        slack = _STEP_NS + max(0, now - self._sampled_ns) // _SLEW_PER_NS
        change = offset - self.offset_ns
        slewed, change = (change, 0) if abs(change) <= slack else self._split(offset)
        self.held_ns += slewed
        if self.before_step_ns is not None:
            self.before_step_ns += slewed
        if abs(change) > slack:
            self.changes += 1
            self.last_step_ns = 0
            # Frames stamped before it may be in the kernel's queue.
            self.before_step_ns = self.offset_ns + slewed
            self._queued_ns = now
            self._rated_offset_ns += change
            slept = self._sleep()
            self.held_ns += slept
            change -= slept
        if abs(change) > slack:
            self._counters["system_clock_stepped"] += 1
            self._stepped_ns = now
            self.last_step_ns = change
        else:
            self.held_ns += change
        if now - self._queued_ns > _AFTER_STEP_NS:
            self.before_step_ns = None
        if now - self._stepped_ns > _BELIEVE_STEP_NS:
            self.held_ns = offset
        self._sampled_ns, self.offset_ns = now, offset
        if now - self._rated_ns >= _RATE_SPAN_NS:
            gained_ns = offset - self._rated_offset_ns
            self._rate_ppb = gained_ns * SECOND_NS // (now - self._rated_ns)
            self._rated_ns, self._rated_offset_ns = now, offset
        return offset

    def _split(self, offset_ns: int) -> tuple[int, int]:
        """Change of the offset since the last sample: slew, and the rest (ns)."""
        self._slewed_ns = self._readings.slewed()[1]
        before_ns, self._unslewed_ns = self._unslewed_ns, offset_ns - self._slewed_ns
        rest_ns = self._unslewed_ns - before_ns
        return offset_ns - self.offset_ns - rest_ns, rest_ns

    def monotonic_of(self, realtime_ns: int, t_seen_ns: int) -> int:
        """Monotonic instant (ns) of a frame with a kernel stamp, seen at `t_seen_ns`.

        After a step, frames stamped before it are still queued: of the two readings that one is
        right which is the younger without lying in the future. Counter: `kernel_stamp_remapped`.
        """
        t_ns = self._before_slew(realtime_ns - self.offset_ns)
        if self.before_step_ns is None:
            return t_ns
        t_before_ns = self._before_slew(realtime_ns - self.before_step_ns)
        ages = [(t_seen_ns - t, t) for t in (t_ns, t_before_ns)]
        possible = [age for age in ages if age[0] >= -KERNEL_FUTURE_NS]
        chosen = min(possible)[1] if possible else t_ns
        self._counters["kernel_stamp_remapped"] += chosen != t_ns
        return chosen

    def _before_slew(self, t_ns: int) -> int:
        """Instant of a stamp at `t_ns` by the offset of the last sample.

        While the system clock is slewed, the offset was different at that time: t = t_ns + r
        (sampled - t), r the clock's rate."""
        age_ns = self._sampled_ns - t_ns
        if age_ns <= 0 or abs(self._rate_ppb) * _SLEW_PER_NS <= SECOND_NS:
            return t_ns
        return t_ns + age_ns * self._rate_ppb // (SECOND_NS + self._rate_ppb)

    def state(self) -> dict[str, int | None]:
        """State for `restore`."""
        return {name: getattr(self, name) for name in (*_KNOWN, *_KNOWN_OF_SLEWS)}

    def restore(self, state: Mapping[str, int | None]) -> None:
        """Restore a state. Raises KeyError for an incomplete one."""
        for name in _KNOWN:
            setattr(self, name, state[name])
        self._slewed_ns = self._rate_ppb = 0
        self._rated_ns, self._rated_offset_ns = self._sampled_ns, self.offset_ns
        self._unslewed_ns = self.offset_ns
        for name in _KNOWN_OF_SLEWS:
            if name in state:
                setattr(self, name, state[name])

    def _sleep(self) -> int:
        """Gain of boottime over CLOCK_MONOTONIC since the last call, ns: 0 for no sleep."""
        boot_ns = self._readings.boottime()[1] - self._slewed_ns
        slept = boot_ns - self._boot_ns
        if slept < _SLEPT_NS:
            return 0
        self._boot_ns = boot_ns
        self.slept_ns += slept
        return slept
