"""Recent IMU samples in arrays for the kernels: body axes, own time offset removed.

Samples keep an absolute number for ever: sample k lies at row k - start. Rows move to the front
when the arrays are full, so that the kernels always see one contiguous run of at least `keep_s`
seconds, and of all that the filter may still rewind to.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled
from fusiond.navigation.crosstalk_noise import Crosstalk
from fusiond.navigation.strapdown import NAV_SIZE
from fusiond.navigation.vibration import Vibration

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# Beyond any vehicle and any sensor sold for one: such a row is damage, not motion.
MAX_RATE_RAD_S = 100.0
MAX_FORCE_M_S2 = 1000.0
# A pause beyond this many sample periods is more than jitter and a lost sample or two: what the
# vehicle did in it is unknown.
HOLD_PERIODS = 3.5
# Intervals whose median is the sample period as seen, and how far from the present one it must be
# (1) to count: a few seconds, whatever single intervals do.
PERIOD_WINDOW, PERIOD_CHANGE = 256, 0.5
# What a row holds beside its time: rate and force, their densities, solution, sigmas.
ROW_WIDTHS = (6, 6, NAV_SIZE, 9)
ROW_SIZE = 1 + sum(ROW_WIDTHS)
# What `packed` begins with, as int64: `start`, `end` and `hold_ns`; a line of the cache.
HEAD_SIZE = 8
START, END, HOLD = 0, 1, 2
# Rows kept before the oldest needed one: the slopes of a sample use the two before it.
MARGIN = 3


def sound(samples: Array) -> NDArray[np.bool_]:
    """Mask of samples (m, 6) that are finite and within the range of any sensor."""
    found: NDArray[np.bool_] = np.abs(samples[:, :3]).max(axis=1, initial=0.0) <= MAX_RATE_RAD_S
    found &= np.abs(samples[:, 3:]).max(axis=1, initial=0.0) <= MAX_FORCE_M_S2
    return found


@compiled("b1(f8[:, :])")
def all_sound(samples: Array) -> bool:
    """True if `sound` holds for each of samples (m, 6); fast for the one or two samples of a
    tick."""
    for i in range(samples.shape[0]):
        for j in range(6):
            most = MAX_RATE_RAD_S if j < 3 else MAX_FORCE_M_S2
            if not abs(samples[i, j]) <= most:
                return False
    return True


@compiled("f8(f8[:, ::1], i8, i8)")
def squares(samples: Array, first: int, end: int) -> float:
    """Sum of the squares of the rates of rows first ... end-1 of samples (m, 6)."""
    total = 0.0
    for i in range(first, end):
        for j in range(3):
            total += samples[i, j] * samples[i, j]
    return total


@compiled("void(f8[:, ::1], f8[::1])")
def _magnitudes(samples: Array, found: Array) -> None:
    for i in range(samples.shape[0]):
        x, y, z = samples[i, 3], samples[i, 4], samples[i, 5]
        found[i] = np.sqrt(x * x + y * y + z * z)


def magnitudes(samples: Array) -> Array:
    """Magnitudes of the forces of samples (m, 6)."""
    found = np.empty(len(samples))
    _magnitudes(samples, found)
    return found


@compiled("UniTuple(i8, 2)(i8[:], i8, i8[::1])")
def _steps(times: Stamps, before_ns: int, intervals: Stamps) -> tuple[int, int]:
    """Write the intervals (m,) between `before_ns` and times (m,), m > 0; shortest and longest."""
    shortest = longest = times[0] - before_ns
    for i in range(len(times)):
        intervals[i] = times[i] - before_ns
        before_ns = times[i]
        shortest, longest = min(shortest, intervals[i]), max(longest, intervals[i])
    return shortest, longest


@compiled("UniTuple(i8, 2)(i8[:], i8)")
def longest_step(times: Stamps, before_ns: int) -> tuple[int, int]:
    """Longest interval between `before_ns` and times (m,), m > 0, and the latest of them."""
    longest, latest = times[0] - before_ns, before_ns
    for i in range(len(times)):
        longest, latest = max(longest, times[i] - before_ns), max(latest, times[i])
        before_ns = times[i]
    return longest, latest


@compiled("UniTuple(i8, 2)(i8[::1])")
def _extremes(intervals: Stamps) -> tuple[int, int]:
    """The shortest and the longest of intervals (m,), m > 0."""
    shortest = longest = intervals[0]
    for i in range(len(intervals)):
        shortest, longest = min(shortest, intervals[i]), max(longest, intervals[i])
    return shortest, longest


class ImuBuffer:
    """IMU samples of the last `keep_s` seconds and the solution recorded at each.

    `times` (m,) ns, `samples` (m, 6) rate rad/s and force m/s^2 in body axes, `nav` (m, 10) and
    `sigmas` (m, 9) as the filter first passed each sample; rows 0 ... `end`-1 hold samples `start`
    ... `start + end - 1`. `counters` name the rejections.
    """

    def __init__(
        self,
        rate_hz: float,
        keep_s: float,
        sensor_to_body: Array,
        time_offset_s: float,
        gap_s: float,
        vibration: Vibration | None = None,
        crosstalk: Crosstalk | None = None,
    ) -> None:
        capacity = int(rate_hz * keep_s * 2.5) + 1000
        self._allocate(capacity)
        self.vibration, self.crosstalk = vibration, crosstalk
        self.start = 0
        self.end = 0
        self.latest_ns = 0
        """Time of the newest sample; 0 before the first."""
        self.needed: int | None = None
        """Absolute number of the oldest sample that a rewind would use; nobody needs any: None."""
        self.backward_in_a_row = 0
        """Number of samples refused as `backward_stamp` since the last accepted one."""
        self.counters: Counter[str] = Counter()
        self._keep_ns = round(keep_s * 1e9)
        self._gap_ns = round(gap_s * 1e9)
        self._configured_ns = self._period_ns = 1e9 / rate_hz
        self.hold_ns = self._hold()
        """Longest time that a sample represents; beyond it the covariance grows as for a gap."""
        self._head[HOLD] = self.hold_ns
        self._intervals: list[Stamps] = []
        self._unjudged = 0
        self._offset_ns = round(time_offset_s * 1e9)
        self._turn = np.zeros((6, 6))
        self._turn[:3, :3] = self._turn[3:, 3:] = sensor_to_body.T

    def _allocate(self, capacity: int) -> None:
        """Allocate so many rows, all arrays in one: `packed`, which a kernel takes at less cost."""
        self.packed: Array = np.zeros(HEAD_SIZE + ROW_SIZE * capacity)
        self._head: NDArray[np.int64] = self.packed[:HEAD_SIZE].view(np.int64)
        behind = self.packed[HEAD_SIZE:]
        self.times: NDArray[np.int64] = behind[:capacity].view(np.int64)
        parts: list[Array] = []
        first = 1
        for width in ROW_WIDTHS:
            rows = behind[first * capacity : (first + width) * capacity]
            parts.append(rows.reshape(capacity, width))
            first += width
        self.samples, self.densities, self.nav, self.sigmas = parts
        self.nav[:] = self.sigmas[:] = np.nan

    @property
    def next_sample(self) -> int:
        """Absolute number of the sample that will come next."""
        return self.start + self.end

    def _hold(self) -> int:
        """Set the hold time by the slower of the configured and the observed rate: a bus with
        bursts does not make its sensor fast."""
        slower = max(self._period_ns, self._configured_ns)
        return min(self._gap_ns, round(HOLD_PERIODS * slower))

    @property
    def oldest_ns(self) -> int:
        """Time of the oldest sample still held; 0 before the first."""
        return int(self.times[0]) if self.end else 0

    def index_after(self, t_ns: int) -> int:
        """Row of the first sample later than `t_ns`."""
        return int(np.searchsorted(self.times[: self.end], t_ns, side="right"))

    def restart(self) -> None:
        """Forget all samples: the next may have any stamp."""
        self.start, self.end, self.needed = self.next_sample, 0, None
        self._head[START], self._head[END] = self.start, 0
        self.latest_ns = 0
        self.backward_in_a_row = 0

    def refuse(self, bad: Array) -> dict[str, int]:
        """Count samples (m, 6) that are not `sound`, by name."""
        finite = int(np.isfinite(bad).all(axis=1).sum())
        names = {"out_of_range": finite, "not_finite": len(bad) - finite}
        self.counters.update(names)
        return {name: count for name, count in names.items() if count}

    def append(self, times: Stamps, samples: Array) -> int:
        """Append samples (m,) ns and (m, 6) in sensor axes; return the number used.

        Rejected and counted: `not_finite`, `out_of_range`, `duplicate_stamp`, `backward_stamp`.
        Counted and used: `gap`.
        """
        if not all_sound(samples):
            good = sound(samples)
            self.refuse(samples[~good])
            times, samples = times[good], samples[good]
        if not len(times):
            return 0
        if self._offset_ns:
            times = times + self._offset_ns
        before_ns = self.latest_ns if self.end else int(times[0]) - 1
        intervals = np.empty(len(times), dtype=np.int64)
        shortest, longest = _steps(times, before_ns, intervals)
        if shortest <= 0:
            highest = np.maximum.accumulate(np.concatenate(([before_ns], times)))[:-1]
            self.counters["duplicate_stamp"] += int((times == highest).sum())
            backward = int((times < highest).sum())
            self.counters["backward_stamp"] += backward
            self.backward_in_a_row += backward
            forward = times > highest
            times, samples = times[forward], samples[forward]
            if not len(times):
                return 0
            intervals = np.empty(len(times), dtype=np.int64)
            _, longest = _steps(times, before_ns, intervals)
        self._learn_period(intervals)
        if longest > self._gap_ns:
            self.counters["gap"] += int((intervals > self._gap_ns).sum())
        taken = len(times)
        self.backward_in_a_row = 0
        room = len(self.times) // 4  # at a time: a long chunk before the start needs no more
        for first in range(0, taken, room):
            part = slice(first, first + room)
            self._store(times[part], samples[part])
        return taken

    def _learn_period(self, intervals: Stamps) -> None:
        """Intervals (m,) ns of samples taken; judged by whole windows, however they come."""
        self._intervals.append(intervals)
        self._unjudged += len(intervals)
        if self._unjudged < PERIOD_WINDOW:
            return
        intervals = np.concatenate(self._intervals)
        shortest, longest = _extremes(intervals)
        far = PERIOD_CHANGE * self._period_ns
        if self._period_ns - far < shortest and longest < self._period_ns + far:
            # No median is far from the period, where nothing is.
            intervals = intervals[len(intervals) // PERIOD_WINDOW * PERIOD_WINDOW :]
        while len(intervals) >= PERIOD_WINDOW:
            half = PERIOD_WINDOW // 2
            middle = np.partition(intervals[:PERIOD_WINDOW], (half - 1, half))
            seen = 0.5 * float(middle[half - 1] + middle[half])
            if abs(seen - self._period_ns) > PERIOD_CHANGE * self._period_ns:
                self._period_ns = seen
                self.hold_ns = self._head[HOLD] = self._hold()
            intervals = intervals[PERIOD_WINDOW:]
        self._intervals, self._unjudged = [intervals], len(intervals)

    def _store(self, times: Stamps, samples: Array) -> None:
        count = len(times)
        if self.end + count > len(self.times):
            needed = int(times[-1]) - self._keep_ns
            drop = self.index_after(needed)
            if self.needed is not None:
                drop = min(drop, self.needed - self.start)
            drop = max(0, drop - MARGIN)
            for array in (self.times, self.samples, self.densities, self.nav, self.sigmas):
                array[: self.end - drop] = array[drop : self.end]
            self.start += drop
            self.end -= drop
            self._head[START] = self.start
            if self.end + count > len(self.times):
                self._grow(2 * (self.end + count))
        rows = slice(self.end, self.end + count)
        self.times[rows] = times
        np.matmul(samples, self._turn, out=self.samples[rows])
        if self.vibration is not None:
            self.vibration.follow(times, self.samples[rows], self.densities[rows])
        else:
            self.densities[rows] = 0.0
        if self.crosstalk is not None:
            self.crosstalk.follow(times, self.samples[rows], self.densities[rows])
        self.nav[rows] = np.nan
        self.end += count
        self._head[END] = self.end
        self.latest_ns = int(times[-1])

    def _grow(self, capacity: int) -> None:
        """More rows: the IMU is faster than configured, or the filter has not run for long."""
        held = self._head, self.times, self.samples, self.densities, self.nav, self.sigmas
        self._allocate(capacity)
        grown = self._head, self.times, self.samples, self.densities, self.nav, self.sigmas
        for array, before in zip(grown, held, strict=True):
            array[: len(before)] = before
