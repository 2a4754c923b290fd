"""Reports of UTC in a recorded CAN bus, which show steps and slews of the recorder's clock.

Reports before and after a jump of the stamps show a step; all reports together show a slew
(fusiond.clock.recorder_clock, recorder_rate). Separate drivers, whose state is discarded, read the
reports ahead of the present frame.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

from drivers.base import Emit, Emitted
from drivers.can.base_driver import CanDriver
from drivers.can.bus import CanFrame
from drivers.can.python_can_import import can
from drivers.measurements import TimeReport
from fusiond.clock.recorder_clock import (
    ENOUGH_REPORTS,
    REPORTS,
    RecorderClock,
    Slew,
    own_share,
    set_by,
)
from fusiond.clock.recorder_rate import SPACING_NS, slews

REPORTS_WITHIN_NS = 120_000_000_000
"""Time ahead in which reports of UTC are searched after a possible step: tunnels are shorter, and
in two minutes a recorder's clock drifts by 12 ms (100 ppm)."""
LATEST_S = 9e9
"""Largest time (s) whose nanoseconds fit a 64-bit integer."""

Scouts = Callable[[Emit], dict[Any, list[CanDriver[Any]]]]
"""Factory of drivers by channel, with a callback for measurements."""


class Reports:
    """Reports of each source with the recorder's stamps, corrected for its slews."""

    def __init__(self, recorder: RecorderClock, scouts: Scouts) -> None:
        self._recorder = recorder
        self._scouts = scouts
        self._last: dict[str, deque[int]] = {}
        """Last differences by source: recorder's stamp minus reported UTC."""
        self._all: dict[str, list[tuple[int, int]]] = {}
        self._silent_ns = (1, 0)
        """Stamps that bound an interval without reports of UTC."""

    def __bool__(self) -> bool:
        return any(self._last.values())

    def add(self, report: TimeReport, stamp_ns: int) -> None:
        """Take a trusted report."""
        last = self._last.setdefault(report.source, deque(maxlen=REPORTS))
        last.append(stamp_ns - report.utc_ns)
        every = self._all.setdefault(report.source, [])
        if not every or report.utc_ns - every[-1][1] >= SPACING_NS:
            every.append((report.t_seen_ns, report.utc_ns))

    def follow(self, set_ns: int) -> None:
        """Shift the reports before a step to the clock after it."""
        for reports in self._last.values():
            for k, ahead_ns in enumerate(reports):
                reports[k] = ahead_ns + set_ns

    def slews(self, drift_ppm: float) -> tuple[str, tuple[Slew, ...]]:
        """Slews by the source with most reports, and its name."""
        source = max(self._all, key=lambda name: len(self._all[name]), default="")
        return source, slews(self._all.get(source, ()), drift_ppm)

    def set_before(self, frames: Ahead, first: can.Message, first_ns: int) -> int | None:
        """Find the step of the recorder's clock before this frame, by sources that report before
        and after it, even across further steps."""
        known = {name for name, reports in self._last.items() if reports}
        if not known or self._silent_ns[0] <= first_ns <= self._silent_ns[1]:
            return None
        after: dict[str, list[int]] = {name: [] for name in known}
        stamp_ns, passed_ns, others_ns = first_ns, 0, list[int]()
        slewed_ns = self._recorder.slewed_ns

        def emit(item: Emitted) -> None:
            if isinstance(item, TimeReport) and item.trusted and item.source in known:
                after[item.source].append(stamp_ns - slewed_ns - item.utc_ns)

        buses = self._scouts(emit)
        for driver in buses.get(first.channel, ()):
            driver.feed(frame(first, first_ns, first_ns))
        for message, ns in frames.ahead():
            change_ns = ns - stamp_ns
            if self._recorder.jumps(change_ns):
                others_ns.append(change_ns)
                stamp_ns = ns
            elif change_ns > 0:
                passed_ns += change_ns
                stamp_ns = ns
            if passed_ns > REPORTS_WITHIN_NS:
                break
            for driver in buses.get(message.channel, ()):
                driver.feed(frame(message, stamp_ns, stamp_ns))
            if any(len(reports) >= ENOUGH_REPORTS for reports in after.values()):
                break
        if not any(after.values()):
            self._silent_ns = first_ns, stamp_ns
        sets = (set_by(self._last[name], reports) for name, reports in after.items())
        found = next((ns for ns in sets if ns is not None), None)
        if found is None or not others_ns:
            return found
        return own_share(found, first_ns - self._recorder.stamp_ns, sum(others_ns))


class Ahead:
    """Data frames of a log with stamps (ns) and lookahead. Other contents are counted in
    `refused`."""

    def __init__(self, messages: Iterator[can.Message], refused: Counter[str]) -> None:
        self._messages = messages
        self._refused = refused
        self._kept: deque[tuple[can.Message, int]] = deque()
        self.number = 0
        """Number of all frames."""

    def __iter__(self) -> Iterator[tuple[can.Message, int]]:
        while True:
            while self._kept:
                yield self._kept.popleft()
            if (each := self._read()) is None:
                return
            yield each

    def ahead(self, number: int | None = None) -> Iterator[tuple[can.Message, int]]:
        """Next frames in order, up to a number, without removing them."""
        yield from list(islice(self._kept, number))
        while number is None or len(self._kept) < number:
            if (each := self._read()) is None:
                return
            self._kept.append(each)
            yield each

    def _read(self) -> tuple[can.Message, int] | None:
        for message in self._messages:
            self.number += 1
            if message.is_error_frame:
                self._refused["error_frames"] += 1
            elif message.is_remote_frame:
                self._refused["remote_frames"] += 1
            elif not -LATEST_S < message.timestamp < LATEST_S:  # NaN too
                self._refused["time_out_of_range"] += 1
            else:
                return message, round(message.timestamp * 1e9)
        return None


def frame(message: can.Message, t_ns: int, stamp_ns: int) -> CanFrame:
    """Frame of a message that arrived at `t_ns`, with the recorder's stamp."""
    can_id, extended = message.arbitration_id, message.is_extended_id
    return CanFrame(can_id, extended, bytes(message.data), t_ns, stamp_ns)
