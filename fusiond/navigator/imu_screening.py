"""Screening of IMU samples: rejects invalid ones, and reports start and end.

Rejected samples leave a gap, which the filter bridges with noise for the possible motion. After a
gap too long for a linear filter, or with a dead axis, alignment restarts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusiond.aiding.velocity import CORNER_RAD_S
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import imu_range
from fusiond.navigation.distributions import median
from fusiond.navigation.imu_buffer import ImuBuffer, all_sound, longest_step, sound
from fusiond.navigation.imu_check import AXIS_DEAD, OUTCOMES, TAKEN, Checked, ImuCheck
from fusiond.navigator.imu_unit_check import other_unit
from fusiond.navigator.mode_reasons import reason

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# A yaw error whose sine is wrong by 3 %, so that an error state still means what it says, at the
# rate of a street corner. The mean of a drive, by which sigma grows, is half of that: a gap of 3 s
# in a bend left errors of 7.7 sigma. That makes 2.2 s.
BEARABLE_YAW_RAD = math.radians(25.0)
BEARABLE_GAP_S = BEARABLE_YAW_RAD / CORNER_RAD_S
# A stamp may lie this far ahead of what arrives with it (clock mapping, jitter).
AHEAD_NS = 200_000_000
# So long must stamps lie ahead: a program that was held up takes in what has arrived meanwhile.
SURE_NS = 500_000_000
# Good samples that end a trouble: twice what it takes to see that an axis is dead.
SOUND_NS = 2_000_000_000

TEXTS = {
    "not_finite": "samples that are no numbers",
    "out_of_range": "samples beyond any sensor's range",
    "saturated": "samples at full scale",
    "repeated": "the same sample again and again",
    "no_gravity": "no specific force: free fall, or accelerations in another unit",
    "spike": "samples that no vehicle can follow",
    "stamp_ahead": "stamps ahead of those that follow",
    "time": "stamps that go back",
    "axis_dead": "one axis stands still while the others move",
}


class Run(NamedTuple):
    """Samples (m,) ns, (m, 6) in order; `ends`: why navigation must restart with them."""

    times: Stamps
    samples: Array
    ends: str = ""


@dataclass(slots=True)
class _Trouble:
    """Rejections of one name: first and last stamp (ns), and number."""

    first_ns: int
    last_ns: int
    count: int = 0


class ImuScreening:
    """Screening of samples; `on_event(code, text)` receives the start and the end of each
    trouble."""

    def __init__(self, config: Imu, keep_s: float, on_event: Callable[[str, str], None]) -> None:
        self._config, self._event = config, on_event
        self._check = ImuCheck(config.rate_hz, *imu_range(config))
        self._most_s = min(BEARABLE_GAP_S, keep_s)
        self._latest_ns: int | None = None
        self._newest: Stamps = np.zeros(1, dtype=np.int64)
        self._ahead_ns = 0
        """Arrival of anything else since which stamps lie ahead, or 0."""
        self._arrived_ns, self._lags = 0, False
        """Arrival of anything else since `look_behind`, or 0, and what that found."""
        self._troubles: dict[str, _Trouble] = {}

    def silence(self, silent_s: float | None) -> str:
        """Text on a silent IMU; None if it is not silent."""
        last = max(self._troubles.items(), key=lambda t: t[1].last_ns, default=None)
        why = "" if last is None else f": {TEXTS[last[0]]}"
        if silent_s is None:
            return reason("no_imu") + why
        return reason("imu_silent", seconds=silent_s) + why

    def restarts(self, imu: ImuBuffer) -> bool:
        """True if stamps went back for good; any next stamp is then accepted."""
        stuck_s = imu.backward_in_a_row / self._config.rate_hz
        if stuck_s <= self._config.gap_s:
            return False
        # A clock set back: nothing would be taken until it is made up.
        text = f"IMU stamps went back {stuck_s:.1f} s ago: aligning again"
        self._trouble("time", self._newest, imu.backward_in_a_row, text)
        self._check.restart()
        self._latest_ns = None
        return True

    def arrived(self, seen_ns: int, imu: ImuBuffer) -> bool:
        """Compare the stamps with another arrival at `seen_ns`; True if they have been ahead of
        arrivals for long, which no valid sample can be."""
        self._arrived_ns = seen_ns
        if not imu.end or imu.latest_ns <= seen_ns + AHEAD_NS:
            self._ahead_ns = 0 if imu.end else self._ahead_ns
            return False
        if self._ahead_ns == 0:
            self._ahead_ns = seen_ns
            return False
        if seen_ns - self._ahead_ns < SURE_NS:
            return False
        ahead_s = (imu.latest_ns - seen_ns) * 1e-9
        text = f"IMU stamps lie {ahead_s:.1f} s ahead of what arrives: aligning again"
        self._trouble("time", self._newest, 1, text)
        self._check.restart()
        self._latest_ns = None
        return True

    def look_behind(self, imu: ImuBuffer) -> bool:
        """Compare the newest sample with other arrivals, once all samples are in `imu`; True if it
        is too old to navigate: its stamps have gone back."""
        if self._arrived_ns and imu.end:
            self._lags = self._arrived_ns - imu.latest_ns > self._config.gap_s * 1e9
            self._arrived_ns = 0
        return self._lags

    def change(self) -> None:
        """Reset for another unit."""
        self._check.restart()
        self._troubles.clear()

    def admit(
        self, times: Stamps, samples: Array, imu: ImuBuffer, navigating: bool
    ) -> Iterator[Run]:
        """Select the samples for `imu`, in runs between gaps too long for navigation.

        Rejections are counted in `imu.counters`. Before navigation the motion in a gap is unknown:
        one beyond `gap_s` discards the evidence of the alignment.
        """
        if len(times):
            self._newest = times[-1:]
        if not all_sound(samples):
            good = sound(samples)
            unit = _unit(samples[~good])
            for name, count in imu.refuse(samples[~good]).items():
                self._trouble(name, times[~good], count, TEXTS[name] + unit)
            times, samples = times[good], samples[good]
        checked = self._check.feed(times, samples, imu.hold_ns)
        times, samples = checked.times, checked.samples
        if self._check.refused:
            ends = self._refuse(checked, imu)
            taken = checked.codes == TAKEN
            times, samples = times[taken], samples[taken]
            if ends:
                yield Run(times[:0], samples[:0], ends)
                navigating = False
        if not len(times):
            return
        before = int(times[0]) - 1 if self._latest_ns is None else self._latest_ns
        most_s = self._most_s if navigating else max(self._config.gap_s, imu.hold_ns * 1e-9)
        longest, self._latest_ns = longest_step(times, before)
        if longest * 1e-9 > most_s:
            yield from self._split_at_gaps(times, samples, before, most_s, imu)
        else:
            yield Run(times, samples)
        if self._troubles:
            self._recover(self._latest_ns)

    def _split_at_gaps(
        self, times: Stamps, samples: Array, before: int, most_s: float, imu: ImuBuffer
    ) -> Iterator[Run]:
        """Split samples at gaps too long for navigation."""
        intervals = np.diff(times, prepend=before) * 1e-9
        breaks = np.flatnonzero(intervals > most_s).tolist()
        for begin, end in pairwise(sorted({0, *breaks, len(times)})):
            ends = ""
            if begin in breaks:
                ends = reason("imu_was_silent")
                imu.counters["gap"] += 1
                silent = reason("imu_silent", seconds=intervals[begin])
                self._event("imu_gap", f"{silent}: aligning again")
            yield Run(times[begin:end], samples[begin:end], ends)

    def _refuse(self, checked: Checked, imu: ImuBuffer) -> str:
        """Count rejected samples; the reason if navigation ends."""
        ends = ""
        for code in np.unique(checked.codes).tolist():
            if code == TAKEN:
                continue
            rows = checked.codes == code
            name, count = OUTCOMES[code], int(rows.sum())
            imu.counters[name] += count
            text = TEXTS[name] + _unit(checked.samples[rows])
            if self._trouble(name, checked.times[rows], count, text) and code == AXIS_DEAD:
                ends = reason("imu_axis_dead")
        return ends

    def _trouble(self, name: str, times: Stamps, count: int, text: str = "") -> bool:
        """Record rejections of a name at `times`; True if they are new."""
        known = self._troubles.get(name)
        news = known is None
        if known is None:
            known = self._troubles[name] = _Trouble(int(times[0]), int(times[0]))
            self._event(f"imu_{name}", text or TEXTS[name])
        known.last_ns = int(times[-1])
        known.count += count
        return news

    def _recover(self, now_ns: int) -> None:
        for name, trouble in list(self._troubles.items()):
            if now_ns - trouble.last_ns > SOUND_NS:
                lasted_s = (trouble.last_ns - trouble.first_ns) * 1e-9
                counted = f"{trouble.count} refused within {lasted_s:.1f} s"
                self._event("imu_sound", f"Accepted again, after {TEXTS[name]} ({counted})")
                del self._troubles[name]


def _unit(samples: Array) -> str:
    """Unit of rejected samples (m, 6) by their magnitude."""
    magnitude = median(np.linalg.norm(samples[:, 3:], axis=1))
    unit = other_unit(magnitude)
    if unit is None:
        return ""
    name, factor = unit
    return (
        f"; {magnitude:.4g} looks like {name}: multiply the accelerometer's figures by {factor:g}"
    )
