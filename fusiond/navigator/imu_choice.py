"""Choice of the inertial unit: the first, or the spare that takes over.

The spare is used once it sends and no sample of the unit in use has been accepted for `gap_s`: the
unit is silent, or its samples are invalid (stuck, saturated, dead:
fusiond.navigator.imu_screening). The spare's samples of that time are stored, so that navigation
continues without a gap. The spare stays in use until the daemon restarts: a unit that has failed is
not trusted before a person has checked it, and two failing units must not alternate.

The choice is made in ticks and depends on arrivals alone, so a replay repeats it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import ImuSample
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import sensor_to_body

Array = NDArray[np.float64]
Row = tuple[int, tuple[float, ...]]

# Samples that may wait for a tick: 2 s at 1 kHz. A tick comes every 10 ms; a full queue means that
# the loop stood still, and the newest samples are the ones worth keeping.
IMU_QUEUE = 2000


class ImuChoice:
    """Samples of all units until a tick, and the choice between them. `on_event(source, code,
    text)` receives a change."""

    def __init__(self, imu: Imu, on_event: Callable[[str, str, str], None]) -> None:
        self._spare, self._gap_ns = imu.spare, round(imu.gap_s * 1e9)
        self._event = on_event
        self.used: str | None = None
        """Source whose samples are used; None before the first."""
        self.counters: Counter[str] = Counter()
        self.has_spare = imu.spare is not None
        self.waiting: deque[Row] = deque(maxlen=IMU_QUEUE)
        """Samples until the next tick that takes them."""
        self._standby: deque[Row] = deque(maxlen=IMU_QUEUE)
        self._standby_since_ns: int | None = None
        self._taken_ns = self._offered_ns = 0
        self._failed_before = False
        self._turn = np.eye(3)
        if imu.spare is not None:
            own = imu.model_copy(update=imu.spare.mounted)
            self._turn = sensor_to_body(imu).T @ sensor_to_body(own)

    def take(self, item: ImuSample, t_valid_ns: int) -> None:
        """Receive a sample."""
        row: Row = t_valid_ns, (*item.gyro_rad_s, *item.accel_m_s2)
        if self._spare is not None and item.source == self._spare.source:
            row = t_valid_ns, self._turned(row[1])
            if self.used != item.source:
                self._standby.append(row)
                if self._standby_since_ns is None:
                    self._standby_since_ns = item.t_seen_ns
                return
        self.used = self.used or item.source
        if item.source != self.used:
            self.counters["second_imu"] += 1
            return
        if len(self.waiting) == IMU_QUEUE:
            self.counters["imu_queue_overflow"] += 1
        self.waiting.append(row)

    def _turned(self, sample: tuple[float, ...]) -> tuple[float, ...]:
        """Rotate a sample from the spare's axes to those of the first unit."""
        both = np.reshape(sample, (2, 3)) @ self._turn.T
        return tuple(both.ravel().tolist())

    def changes(self, t_ns: int, taken_ns: int | None) -> bool:
        """True if the spare takes over in the tick at `t_ns`; `taken_ns` is the instant of the
        navigator's newest accepted sample, None without one.

        Two ticks in a row are required: after a stall of the host the first tick may precede the
        waiting frames.
        """
        if taken_ns is not None:
            self._taken_ns = max(self._taken_ns, taken_ns)
        if self._spare is None or self.used == self._spare.source or not self._standby:
            return False
        since_ns = max(self._taken_ns, self._standby_since_ns or 0)
        refused = self._offered_ns - since_ns > self._gap_ns
        silent = not self.waiting and t_ns - since_ns > self._gap_ns
        failed = (refused or silent) and t_ns - self._standby[-1][0] <= self._gap_ns
        if not (failed and self._failed_before):
            self._failed_before = failed
            return False
        silent_ns = t_ns - since_ns
        before, self.used = self.used or "the first IMU", self._spare.source
        self.waiting = deque((r for r in self._standby if r[0] > self._taken_ns), IMU_QUEUE)
        self._standby.clear()
        self.counters["took_over"] += 1
        self._event(
            self.used,
            "imu_spare",
            f"{before} has given nothing that counts for {silent_ns * 1e-9:.1f} s: {self.used} is "
            "used, with biases unknown, until the daemon starts again",
        )
        return True

    def samples(self) -> tuple[NDArray[np.int64], Array] | None:
        """Samples since the last call, (m,) ns and (m, 6); None without any."""
        if not self.waiting:
            return None
        times, samples = zip(*self.waiting, strict=True)
        self.waiting.clear()
        self._offered_ns = max(self._offered_ns, times[-1])
        return np.array(times, dtype=np.int64), np.array(samples, dtype=np.float64)
