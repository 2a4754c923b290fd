"""Host clocks of a replay, which return the recorded readings."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from fusiond.clock.host import Readings
from fusiond.recording.records import BOOTTIME, REALTIME, SLEWED, Reading


class RecordedTime:
    """`HostTime` that stands at `t_ns` until it is moved."""

    def __init__(self, t_ns: int) -> None:
        self.t_ns = t_ns

    def monotonic_ns(self) -> int:
        return self.t_ns

    def realtime_ns(self) -> int:
        raise AssertionError("read by RecordedReadings")

    boottime_ns = slewed_ns = realtime_ns


class RecordedReadings(Readings):
    """Clock readings of the daemon, in the same order.

    A filter with other events reads the clocks more or less often: a reading that is missing in the
    log repeats the last one, a surplus one is ignored (`pending`).
    """

    def __init__(self, time: RecordedTime, system_clock: Mapping[str, int | None]) -> None:
        super().__init__(time)
        self._time = time
        slewed_ns = int(system_clock.get("_slewed_ns") or 0)
        self._last = {
            REALTIME: int(system_clock["offset_ns"] or 0),
            BOOTTIME: int(system_clock["_boot_ns"] or 0) + slewed_ns,
            SLEWED: slewed_ns,
        }
        self._readings: deque[Reading] = deque()

    @property
    def pending(self) -> bool:
        return bool(self._readings)

    def give(self, readings: Sequence[Reading]) -> None:
        """Store the clock readings of the record that is handled next."""
        self._readings = deque(readings)

    def realtime(self) -> tuple[int, int]:
        return self._next(REALTIME)

    def boottime(self) -> tuple[int, int]:
        return self._next(BOOTTIME)

    def slewed(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC: the recorded reading, or the last one in logs without such readings."""
        if self._readings and self._readings[0][0] == SLEWED:
            return self._next(SLEWED)
        return self._time.t_ns, self._last[SLEWED]

    def _next(self, clock: int) -> tuple[int, int]:
        while self._readings:
            found, t_ns, ahead_ns = self._readings.popleft()
            self._last[found] = ahead_ns
            if found == clock:
                return t_ns, ahead_ns
        return self._time.t_ns, self._last[clock]
