"""Initial alignment: waits for level, heading and position, and starts the filter when it has all.

Level comes from a standstill (or from motion known by two velocity fixes), heading from the first
of the allowed sources that can give it, position from a fix, the configuration or the saved state.
No heading, no navigation: `reason` says what is missing.
"""

from __future__ import annotations

from collections.abc import Callable

from fusiond.models.blocks import ImuNoise
from fusiond.models.model import Model
from fusiond.navigation.imu_buffer import ImuBuffer
from fusiond.navigator.alignment.basis import Basis
from fusiond.navigator.alignment.collected import Collected
from fusiond.navigator.alignment.course import from_course
from fusiond.navigator.alignment.headings import (
    from_config,
    from_dual_antenna,
    from_gyrocompass,
    from_saved,
)
from fusiond.navigator.alignment.options import AlignmentOptions
from fusiond.navigator.alignment.start import Place, Start
from fusiond.navigator.saved_state import SavedState

HeadingSource = Callable[[Basis, ImuBuffer, Place], Start | None]
HEADING_SOURCES: dict[str, HeadingSource] = {
    "saved": from_saved,
    "config": from_config,
    "dual_antenna": from_dual_antenna,
    "gyrocompass": from_gyrocompass,
    "gnss_course": from_course,
}


class Aligner:
    """Tries a start whenever asked; `known` takes in what may lead to one."""

    def __init__(
        self,
        options: AlignmentOptions,
        noise: ImuNoise,
        model: Model,
        saved: SavedState | None,
        on_event: Callable[[str, str], None],
    ) -> None:
        self.reason = "waiting for IMU data"
        self.known = Collected(options, noise, saved, on_event)
        self._basis = Basis(options, noise, model, saved, self.known)

    def attempt(self, imu: ImuBuffer) -> Start | None:
        """A start, if all is known by now; else None, and `reason` says what is missing."""
        if not imu.end:
            self.reason = "waiting for IMU data"
            return None
        if self.known.upside_down:
            self.reason = self.known.why
            return None
        place = self.known.place()
        if place is None:
            self.reason = "no position yet: no fix, none configured"
            return None
        allowed = self._basis.options.heading
        for source in allowed:
            start = HEADING_SOURCES[source](self._basis, imu, place)
            if start is not None:
                return start
        if not self.known.levelled() and not self.known.fixes:
            self.reason = "not at rest: no level yet"
        else:
            self.reason = f"no heading yet (allowed: {', '.join(allowed)})"
        if self.known.why:
            self.reason += f"; {self.known.why}"
        return None
