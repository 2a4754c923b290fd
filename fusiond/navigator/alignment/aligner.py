"""Initial alignment: waits for level, heading and position, and starts the filter when it has all.

Level comes from a standstill (or from motion known by two velocity fixes), heading from the first
of the allowed sources that can give it, position from a fix, the configuration or the saved state.
Navigation does not start without a heading: `reason` names what is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fusiond.aiding.base import AidingMeasurement
from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigation.standstill import Window
from fusiond.navigator.alignment.course import from_course
from fusiond.navigator.alignment.evidence import AlignmentEvidence
from fusiond.navigator.alignment.heading_at_rest import (
    from_compass,
    from_config,
    from_dual_antenna,
    from_gyrocompass,
    from_positions,
    from_saved,
)
from fusiond.navigator.alignment.heading_from_positions import Track
from fusiond.navigator.alignment.heading_source_data import Basis
from fusiond.navigator.alignment.latency import LatencySearch
from fusiond.navigator.alignment.missing import Journal, why_not
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import Place, Start
from fusiond.navigator.mode_reasons import reason
from fusiond.navigator.saved_state import SavedState

HeadingSource = Callable[[Basis, ImuBuffer, Place], Start | None]
HEADING_SOURCES: dict[str, HeadingSource] = {
    "saved": from_saved,
    "config": from_config,
    "dual_antenna": from_dual_antenna,
    "compass": from_compass,
    "gyrocompass": from_gyrocompass,
    "gnss_course": from_course,
    "positions": from_positions,
}


SAID_NS = 100_000_000
"""Interval at which the missing condition is reported again while only samples arrive: reading
speed."""


class Aligner:
    """Alignment of one vehicle: collects evidence and starts the filter."""

    def __init__(
        self,
        options: AlignmentOptions,
        noise: ImuNoise,
        model: Model,
        saved: SavedState | None,
        on_event: Callable[[str, str], None],
    ) -> None:
        self.reason = reason("no_imu")
        self._found: Start | None = None
        self.known = AlignmentEvidence(options, noise, saved, on_event)
        self._track = Track(options, model)
        self._journal = Journal(on_event)
        self._news, self._said = True, -1
        """True if input has arrived since the last report, and the instant of that report
        (`SAID_NS`)."""
        self._basis = Basis(options, model, saved, self.known, self._track)

    def receive(self, measurements: Sequence[AidingMeasurement]) -> None:
        """Receive the aiding measurements of one device measurement."""
        self.known.receive(measurements)
        self._track.receive(measurements)
        self._news = True

    def sensed(self, windows: Sequence[Window], measurements: Sequence[AidingMeasurement]) -> None:
        """Receive ended windows of the standstill detector and the constraints that hold."""
        for window in windows:
            self.known.window(window)
            self._news = True
        self._track.receive(measurements)

    def waits(self, start: Start, latency: LatencySearch) -> bool:
        """True if a start must wait for the search for delayed fixes; with a suspected delay it
        waits for further fixes."""
        self._found = start if latency.looking else None
        if latency.suspects:
            self.reason = latency.suspects
        return self._found is not None or bool(latency.suspects)

    def attempt(self, imu: ImuBuffer) -> Start | None:
        """Start of the filter, if all is known; else None, and `reason` names what is missing."""
        if not imu.end:
            self.reason = reason("no_imu")
            return None
        if self._found is not None:
            return self._found
        start = None
        place = None if self.known.upside_down else self.known.place()
        if place is not None:
            sources = (HEADING_SOURCES[name] for name in self._basis.options.heading)
            found = (source(self._basis, imu, place) for source in sources)
            start = next((s for s in found if s is not None), None)
            if start is not None and self.known.contradicted_ns:
                start = replace(start, contradicted=True)
        if start is None:
            upside_down = self.known.upside_down
            if upside_down:
                self.reason = self.known.why
            elif self._news or imu.latest_ns // SAID_NS != self._said:
                latitude = None if place is None else float(place[1][0])
                self.reason = why_not(self._basis, imu, latitude)
                self._news, self._said = False, imu.latest_ns // SAID_NS
            if not upside_down:  # that has been told
                self._journal.keep(self.reason, imu.latest_ns)
        return start
