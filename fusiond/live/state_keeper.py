"""State on disk: stored while the vehicle is at rest, removed once it drives.

A vehicle that is driven leaves no state: only a heading at rest is still true at the next start.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import ValidationError

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.saved_state import SavedState, load_state, save_state
from fusiond.navigator.state_file import DamagedStateError, RefusedStateError, set_aside

log = logging.getLogger("fusiond")

# Period of writes at rest: a power cut loses a minute.
SAVE_EVERY_S = 60
# Largest speed (m/s) of a vehicle at rest; above it no heading is saved.
SAVE_MAX_SPEED_M_S = 0.2
# Above this speed (m/s) the vehicle certainly drives, whatever the velocity's sigma (0.05 m/s
# aided). Its heading differs from the saved one, which a start after a power cut must not use.
FORGET_SPEED_M_S = 1.0


class StateKeeper:
    """Store of one vehicle's state: in `state_file`, else in systemd's state directory; none
    without either.

    Files are written and removed in a thread: a tick never waits for a disk. Failures are logged.
    `on_event(code, text)` receives `saved_state_damaged` and `saved_state_refused`.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        on_event: Callable[[str, str], None],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._path = state_file(config, environ)
        self._max_age_s = config.alignment.saved_max_age_s
        self._clock = clock
        self._event = on_event
        self.kept = False
        """True if there is a file, which the vehicle's departure removes."""
        self._working: asyncio.Task[None] | None = None
        self._schedule = Every(SAVE_EVERY_S * SECOND_NS)
        self.schedule = None if self._path is None else self._schedule
        """Schedule of `keep`; None if nothing is stored."""

    def load(self) -> SavedState | None:
        """Load the last run's state; None without a usable one."""
        if self._path is None:
            return None
        utc_ns = self._clock.utc_ns(self._clock.now_ns())
        now_utc_s = None if utc_ns is None else utc_ns * 1e-9
        try:
            state = load_state(self._path, now_utc_s, self._max_age_s)
        except DamagedStateError as error:
            self._event("saved_state_damaged", f"{self._path}: {error}; {set_aside(self._path)}")
            return None
        except RefusedStateError as error:
            self._event("saved_state_refused", f"{self._path}: {error}")
            return None
        log.info("%s: %s", self._path, "no saved state" if state is None else "saved state")
        self.kept = state is not None
        return state

    def keep(self, t_ns: int, solution: Solution, *, confirmed: bool) -> None:
        """Renew the file while the vehicle stands; remove it once the vehicle drives. `confirmed`:
        true if the heading has been confirmed."""
        if self._path is None or (self._working is not None and not self._working.done()):
            return
        if self._schedule.due(t_ns):
            state = self._state(solution, confirmed)
            if state is not None:
                self.kept = True
                self._working = asyncio.create_task(asyncio.to_thread(_write, self._path, state))
        elif self.kept and _speed_m_s(solution) > FORGET_SPEED_M_S:
            self.kept = False
            self._working = asyncio.create_task(asyncio.to_thread(_remove, self._path))

    async def close(self, solution: Solution | None, *, confirmed: bool) -> None:
        """Write the last solution, after a pending write has ended."""
        if self._working is not None:
            await asyncio.wait([self._working])
        state = None if solution is None else self._state(solution, confirmed)
        if self._path is not None and state is not None:
            await asyncio.to_thread(_write, self._path, state)

    def _state(self, solution: Solution, confirmed: bool) -> SavedState | None:
        utc_ns = self._clock.utc_ns(solution.t_ns)
        if utc_ns is None or not _speed_m_s(solution) <= SAVE_MAX_SPEED_M_S:
            return None
        s = solution
        if math.isnan(s.rpy_rad[2]):  # no heading without an IMU
            return None
        try:
            return SavedState(
                utc_ns * 1e-9,
                (s.lat_rad, s.lon_rad, None if math.isnan(s.height_m) else s.height_m),
                math.hypot(s.sd_ned_m[0], s.sd_ned_m[1]),
                s.rpy_rad[2],
                s.sd_rpy_rad[2],
                confirmed,
            )
        except ValidationError as error:  # a model without heading, or a diverged filter
            log.warning("state not saved: %s", error.errors(include_url=False)[0]["msg"])
            return None


def _speed_m_s(solution: Solution) -> float:
    """Speed of the solution; NaN without navigation."""
    if solution.mode not in (Mode.NAVIGATING, Mode.COASTING):
        return math.nan
    return math.hypot(*solution.v_ned_m_s)


def state_file(config: Config, environ: Mapping[str, str]) -> Path | None:
    """Path of a vehicle's saved state; None if none is configured."""
    if config.state_file is not None:
        return config.state_file
    directory = environ.get("STATE_DIRECTORY")
    return Path(directory.split(":")[0]) / f"{config.vehicle}.json" if directory else None


def _write(path: Path, state: SavedState) -> None:
    try:
        save_state(path, state)
    except OSError as error:
        log.warning("state not saved: %s", error)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        log.warning("state not removed: %s", error)
