"""Calibration on disk: restored at the start, written during the drive and at its end."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.state_keeper import state_file
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigator.imu_handover import published_of_spare
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_calibration import (
    SavedCalibration,
    load_calibration,
    mounting_digest,
    save_calibration,
    saved_calibration,
)
from fusiond.navigator.state_file import DamagedStateError, RefusedStateError, set_aside

log = logging.getLogger("fusiond")

# Parameters settle over minutes. At this interval a power cut loses five minutes at most, and flash
# is written 12 times an hour.
SAVE_EVERY_S = 300


class CalibrationKeeper:
    """Store of one vehicle's calibration, beside its saved state, if that is configured.

    Restored values are logged. `on_event(code, text)` receives `calibration_damaged` and
    `calibration_refused`.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        on_event: Callable[[str, str], None],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        beside = state_file(config, environ)
        self._path = None if beside is None else beside.with_suffix(".calibration.json")
        self._digest = mounting_digest(config)
        self._clock = clock
        self._event = on_event
        self._schedule = Every(SAVE_EVERY_S * SECOND_NS)
        self.schedule = None if self._path is None else self._schedule
        """Schedule of `keep`; None if nothing is stored."""
        self._working: asyncio.Task[None] | None = None

    def restore_into(self, navigator: Navigator) -> None:
        """Restore the last run's calibration into the navigator, if the mounting is unchanged."""
        if self._path is None:
            return
        try:
            found = load_calibration(self._path, navigator.model, self._digest)
        except DamagedStateError as error:
            self._event("calibration_damaged", f"{self._path}: {error}; {set_aside(self._path)}")
        except RefusedStateError as error:
            self._event("calibration_refused", f"{self._path}: {error}")
        else:
            if found is not None and found.noise is not None:
                found = replace(found, noise=found.noise.at(self._utc_s()))
            navigator.calibration = found
            names = found.names if found is not None else ()
            log.info("%s: %s", self._path, ", ".join(names) or "no saved calibration")

    def keep(self, t_ns: int, navigator: Navigator) -> None:
        """Write the file when due, if a parameter has been observed."""
        busy = self._working is not None and not self._working.done()
        if self._path is None or busy or not self._schedule.due(t_ns):
            return
        saved = self._of(navigator)
        if saved is not None:
            self._working = asyncio.create_task(asyncio.to_thread(_write, self._path, saved))

    async def close(self, navigator: Navigator) -> None:
        """Write the last calibration, after a pending write has ended."""
        if self._working is not None:
            await asyncio.wait([self._working])
        saved = self._of(navigator)
        if self._path is not None and saved is not None:
            await asyncio.to_thread(_write, self._path, saved)

    def _of(self, navigator: Navigator) -> SavedCalibration | None:
        # The spare's mounting is not that of the unit with which the next run starts.
        spare = published_of_spare(navigator.estimator, navigator.config.imu)
        if navigator.started is None or navigator.trial.on_trial or spare:
            return None
        noise = navigator.shown_noise(self._utc_s())
        return saved_calibration(navigator.calibrating.parameters, self._digest, noise)

    def _utc_s(self) -> float | None:
        utc_ns = self._clock.utc_ns(self._clock.now_ns())
        return None if utc_ns is None else utc_ns * 1e-9


def _write(path: Path, saved: SavedCalibration) -> None:
    try:
        save_calibration(path, saved)
    except OSError as error:
        log.warning("calibration not saved: %s", error)
