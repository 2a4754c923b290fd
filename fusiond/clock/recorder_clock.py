"""Monotonic time from a recorder's stamps, whose clock may be set while it records.

A recorder stamps frames by a clock that NTP, a receiver or an operator sets while it records.
Between two frames the stamps advance by the elapsed time and by the step of the clock:

    s(k) - s(k-1) = passed + set,    d = s - utc advances by `set` alone

Reported UTC distinguishes the two. Without it, stamps that go back mean a set clock, since time
does not, and stamps that jump ahead mean a pause: a pause mistaken for a step is navigated through,
a step mistaken for a pause only restarts the alignment.

While the clock is slewed, which only a reading of the whole log shows (`recorder_rate`), time
passes by its stamps less the gain. A single deviating stamp is damage: `time_backwards`,
`time_ahead`. Stamps of another channel that lie a little behind come from its controller's own
clock or from delayed writing: those frames have arrived by now, and their stamps are valid.

All times are integer nanoseconds; a pure function of its inputs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Sequence
from statistics import median_low
from typing import Literal, NamedTuple

from fusiond.clock.host import MILLISECOND_NS, SECOND_NS

AHEAD_NS = SECOND_NS
"""Lead over the following stamps from which a stamp is damaged: a recorder writes frames on
arrival, and two controllers' clocks agree better."""
LEAP_NS = 200 * MILLISECOND_NS
"""Least step that reports of UTC can show: the largest delay of a receiver on a healthy line
(fusiond.clock.utc_from_arrivals). The envelope follows a smaller step."""
ASKED_AGAIN_NS = 20 * SECOND_NS
"""Interval between checks for a set clock on a bus whose controllers disagree."""
ORDINARY = 3
"""Longest normal pause of a sparse bus, in multiples of its longest recent one."""
FOLLOWING = 8
"""Frames that distinguish damage from a set clock: most must agree."""
_LATELY = 64
_OWN_PERIOD = 512
"""Frames searched for the last two with the same identifier."""
REPORTS = 5
"""Reports of UTC before and after a jump whose medians are compared."""
ENOUGH_REPORTS = 3
"""Fewest reports that prove a step, as for UTC itself (`utc_envelope`): two may come from one
queue."""

Verdict = Literal["taken", "time_backwards", "time_ahead"]
SetOff = Callable[[], int | None]
Of = tuple[Hashable, int]
"""Channel and identifier of a frame."""


class Step(NamedTuple):
    """Step: the recorder's clock was set by `set_ns` when its stamp was `stamp_ns`."""

    stamp_ns: int
    set_ns: int


class Slew(NamedTuple):
    """Slew: the clock, without its steps, gains `rate` s/s from `begin_ns` to `end_ns` of its
    time."""

    begin_ns: int
    end_ns: int
    rate: float


class RecorderClock:
    """Monotonic clock from a recorder's stamps, in order. `t_ns` is monotonic time, which starts at
    the first stamp; `stamp_ns` the latest stamp; `steps` the changes of the recorder's clock,
    `slewed_ns` the sum of its slews."""

    def __init__(self, slews: Sequence[Slew] = ()) -> None:
        self.t_ns = 0
        self.stamp_ns = 0
        self.steps: list[Step] = []
        self.slewed_ns = 0
        self._slews = deque(slews)
        self._started = False
        self._went_back = False
        """Time itself did, as UTC says: what was recorded before is refused until it is over."""
        self._denied_ns: int | None = None
        self._spacings: deque[int] = deque(maxlen=_LATELY)
        self._frames: deque[tuple[Of, int]] = deque(maxlen=_OWN_PERIOD)
        self._of_channel: dict[Hashable, int] = {}
        """Last stamp of each channel."""

    @property
    def ahead_ns(self) -> int:
        """Sum of all steps and slews: the last stamps minus monotonic time."""
        return sum(step.set_ns for step in self.steps) + self.slewed_ns

    def is_odd(self, stamp_ns: int, of: Of) -> bool:
        """True if `take` needs the following frames."""
        change = stamp_ns - self.stamp_ns
        if not self._started:
            return True
        if 0 <= change < LEAP_NS:
            return False
        own_ns = self._of_channel.get(of[0], stamp_ns)
        return not (-AHEAD_NS < change < 0 and stamp_ns > own_ns - LEAP_NS)

    def jumps(self, change_ns: int) -> bool:
        """True if such an advance of stamps shows a set clock, or a pause."""
        spacing_ns = max(self._spacings, default=0)
        return change_ns < -AHEAD_NS or change_ns >= max(LEAP_NS, ORDINARY * spacing_ns)

    def next(self, stamp_ns: int, of: Of) -> None:
        """Take the stamp of a frame that fits."""
        if stamp_ns >= self.stamp_ns:
            self._on(stamp_ns, stamp_ns - self.stamp_ns, of)
        self._of_channel[of[0]] = stamp_ns

    def take(self, stamp_ns: int, of: Of, following: Sequence[int], set_by_utc: SetOff) -> Verdict:
        """Monotonic instant of a frame, given the stamps that follow it (`FOLLOWING`).

        `set_by_utc()`: step of the clock here by reports of UTC; None if unknown. Called if a step
        is possible.
        """
        if not self._started:
            if 2 * sum(f < stamp_ns - AHEAD_NS for f in following) > len(following):
                return "time_ahead"
            self._started = True
            self.t_ns = self.stamp_ns = stamp_ns
        change = stamp_ns - self.stamp_ns
        if change < 0:
            if self._went_back or self._alone(stamp_ns, following):
                return "time_backwards"
            if change > -AHEAD_NS:
                return self._little_back(stamp_ns, of, set_by_utc)
            if stamp_ns > self._of_channel.get(of[0], stamp_ns) - AHEAD_NS:
                return "time_backwards"  # of another channel, which was written too late
            set_ns = set_by_utc()
            if set_ns is not None and change - set_ns < -AHEAD_NS:
                self._went_back = True
                return "time_backwards"
            self._step(stamp_ns, change if set_ns is None else set_ns, of)
            return "taken"
        if change > AHEAD_NS and self._is_ahead(stamp_ns, following):
            return "time_ahead"
        if self.jumps(change):
            set_ns = set_by_utc()
            if set_ns is not None and abs(set_ns) >= LEAP_NS and change - set_ns > -AHEAD_NS:
                self._step(stamp_ns, set_ns, of)
                return "taken"
        self._on(stamp_ns, change, of)
        return "taken"

    def _little_back(self, stamp_ns: int, of: Of, set_by_utc: SetOff) -> Verdict:
        """True for a small step back, within the disagreement of controllers' clocks, which only
        UTC can confirm."""
        change = stamp_ns - self.stamp_ns
        denied = self._denied_ns is not None and stamp_ns - self._denied_ns < ASKED_AGAIN_NS
        set_ns = None if denied or change > -LEAP_NS else set_by_utc()
        if set_ns is not None and abs(set_ns - change) < LEAP_NS:
            self._step(stamp_ns, set_ns, of)
            return "taken"
        if change <= -LEAP_NS and not denied:
            self._denied_ns = stamp_ns
        return "time_backwards"

    def _on(self, stamp_ns: int, passed_ns: int, of: Of) -> None:
        self._went_back = False
        self._of_channel[of[0]] = stamp_ns
        if self._slews:
            passed_ns -= self._gained(passed_ns)
        self.t_ns += passed_ns
        self.stamp_ns = stamp_ns
        self._spacings.append(passed_ns)
        self._frames.append((of, self.t_ns))

    def _gained(self, passed_ns: int) -> int:
        """Gain by slews in `passed_ns` of the stamps."""
        begin_ns = self.t_ns + self.slewed_ns
        end_ns, gained_ns = begin_ns + passed_ns, 0
        while self._slews and self._slews[0].begin_ns < end_ns:
            slew = self._slews[0]
            within_ns = min(end_ns, slew.end_ns) - max(begin_ns, slew.begin_ns)
            gained_ns += round(max(0, within_ns) * slew.rate / (1.0 + slew.rate))
            if slew.end_ns > end_ns:
                break
            self._slews.popleft()
        self.slewed_ns += gained_ns
        return gained_ns

    def _step(self, stamp_ns: int, set_ns: int, of: Of) -> None:
        """Reports of UTC have jitter: if they show almost no elapsed time, the usual interval of
        this identifier is used."""
        change = stamp_ns - self.stamp_ns
        passed = change - set_ns
        if passed < LEAP_NS:
            passed = self._due_ns(of)
        self.steps.append(Step(stamp_ns, change - passed))
        self._of_channel.clear()
        self._on(stamp_ns, passed, of)

    def _due_ns(self, of: Of) -> int:
        """Time from the last frame to the next expected one of this channel and identifier."""
        times = [t_ns for each, t_ns in self._frames if each == of][-2:]
        spacing = median_low(self._spacings) if self._spacings else 0
        if len(times) < 2:
            return spacing
        due_ns = 2 * times[1] - times[0] - self.t_ns
        return due_ns if 0 <= due_ns < LEAP_NS else spacing

    def _alone(self, stamp_ns: int, following: Sequence[int]) -> bool:
        """True if only this stamp went back: most stamps after it continue those before it."""
        on = [f for f in following if stamp_ns - AHEAD_NS <= f < self.stamp_ns]
        return 2 * len(on) <= len(following)

    def _is_ahead(self, stamp_ns: int, following: Sequence[int]) -> bool:
        """True if most of the following stamps have not jumped with this one."""
        behind = [f for f in following if self.stamp_ns - AHEAD_NS < f < stamp_ns - AHEAD_NS]
        return 2 * len(behind) > len(following)


def own_share(total_ns: int, own_ns: int, others_ns: int) -> int | None:
    """Share of the first of several jumps in a step of `total_ns`. Either all jumped, or the first
    alone, or only the others; None if none of these fits."""
    for expected_ns, share_ns in (
        (own_ns + others_ns, own_ns),
        (own_ns, own_ns),
        (0, 0),
        (others_ns, 0),
    ):
        if abs(total_ns - expected_ns) < LEAP_NS:
            return share_ns
    return None


def set_by(before: Sequence[int], after: Sequence[int]) -> int | None:
    """Step of the clock, from stamp minus reported UTC before and after (ns).

    None with too few reports, or if their scatter would hide the step.
    """
    if not before or len(after) < ENOUGH_REPORTS:
        return None
    found = median_low(after) - median_low(before)
    scatter = max(max(before) - min(before), max(after) - min(after))
    return found if scatter < LEAP_NS or abs(found) > 2 * scatter else None
