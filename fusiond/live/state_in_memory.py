"""Navigation state in memory that survives the process, for a restart within moments.

The file is in systemd's runtime directory, a tmpfs: two writes a second of 6 kB (45 MB an hour)
would wear out flash. Nothing is lost by that: after a power cut the state is useless, because the
monotonic clock restarts. A thread writes; a tick only copies the arrays.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from fusiond.clock.stamp_mapping import Clock
from fusiond.clock.utc_from_arrivals import UtcKnown
from fusiond.configuration.load import config_digest
from fusiond.configuration.schema import Config
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.imu_handover import published_of_spare
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.restart_from_memory import (
    WarmStart,
    WarmState,
    same_run,
    warm_state,
)
from fusiond.navigator.state_file import (
    DamagedStateError,
    RefusedStateError,
    read_state,
    set_aside,
    write_state,
)

log = logging.getLogger("fusiond")

# A restart has to bridge the age of the snapshot, too; half a second is little beside the start of
# the process.
SNAPSHOT_NS = SECOND_NS // 2
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True, config=ConfigDict(strict=True, extra="forbid"))
class KeptState:
    """State that survives the process: the filter's, and UTC on the monotonic clock."""

    navigation: WarmState
    utc: tuple[UtcKnown, ...] = ()


KEPT_STATE = TypeAdapter(KeptState)


class WarmKeeper:
    """Store of one vehicle's navigation state in systemd's runtime directory, else none.

    `on_event(code, text)` receives `warm_state_damaged` and `warm_state_refused`.
    """

    def __init__(
        self,
        config: Config,
        clock: Clock,
        on_event: Callable[[str, str], None],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        directory = environ.get("RUNTIME_DIRECTORY")
        self._boot_id = _boot_id()
        self._path: Path | None = None
        if directory and self._boot_id:
            self._path = Path(directory.split(":")[0]) / f"{config.vehicle}.warm.json"
        self._clock = clock
        self._config = config_digest(config)
        self._event = on_event
        self._schedule = Every(SNAPSHOT_NS)
        self.schedule = None if self._path is None else self._schedule
        """Schedule of `keep`; None if nothing is stored."""
        self._working: asyncio.Task[None] | None = None
        self._failing = False
        self.restored: KeptState | None = None
        """State offered to the navigator."""

    def restore_into(self, navigator: Navigator) -> None:
        """Restore the last run's clock and navigator, unless the computer was rebooted since."""
        if self._path is None:
            return
        try:
            state = read_state(self._path, KEPT_STATE)
            if state is None:
                return
            same_run(state.navigation, self._config, self._boot_id, _asleep_ns())
            navigator.trial.warm = WarmStart(state.navigation, navigator.model)
            self._clock.resume(state.utc)
            self.restored = state
        except DamagedStateError as error:
            self._event("warm_state_damaged", f"{self._path}: {error}; {set_aside(self._path)}")
        except RefusedStateError as error:
            self._event("warm_state_refused", f"{self._path}: {error}")

    def keep(self, t_ns: int, solution: Solution, navigator: Navigator) -> None:
        """Write the file when due, if the solution is good enough."""
        busy = self._working is not None and not self._working.done()
        if self._path is None or busy or not self._schedule.due(t_ns):
            return
        state = self.state(solution, navigator)
        if state is not None:
            self._working = asyncio.create_task(asyncio.to_thread(self._write, self._path, state))

    async def close(self, solution: Solution | None, navigator: Navigator) -> None:
        """Write the last state, after a pending write has ended, also before a `restart`."""
        if self._working is not None:
            await asyncio.wait([self._working])
        state = None if solution is None else self.state(solution, navigator)
        if self._path is not None and state is not None:
            await asyncio.to_thread(self._write, self._path, state)

    def state(self, solution: Solution, navigator: Navigator) -> KeptState | None:
        """Present state; None if the solution is too poor to store, or if the spare is in use: its
        axes and biases are not those of the unit that the next run starts with."""
        usable = solution.mode in (Mode.NAVIGATING, Mode.COASTING)
        if navigator.started is None or navigator.trial.on_trial or not usable:
            return None
        if navigator.without_imu.active:
            return None
        if published_of_spare(navigator.estimator, navigator.config.imu):
            return None
        try:
            state = warm_state(
                navigator.estimator,
                navigator.imu,
                navigator.started.origin,
                self._config,
                self._boot_id,
                _asleep_ns(),
                confirmed=not navigator.trial.unconfirmed,
            )
            return KeptState(state, self._clock.known())
        except ValidationError as error:
            self._report(f"warm state not kept: {error.errors(include_url=False)[0]}")
            return None

    def _write(self, path: Path, state: KeptState) -> None:
        try:
            write_state(path, KEPT_STATE.dump_json(state), durable=False)
            self._failing = False
        except OSError as error:
            self._report(f"warm state not kept: {error}")

    def _report(self, text: str) -> None:
        """Report the first of a series of failed writes; they would repeat twice a second."""
        if not self._failing:
            self._failing = True
            log.warning("%s", text)


def _boot_id() -> str:
    """Identifier of this boot and of its monotonic clock; empty if the kernel hides it."""
    try:
        return f"{BOOT_ID.read_text().strip()} raw"
    except OSError:
        return ""


def _asleep_ns() -> int:
    """Time that the computer was suspended since boot (ns): the monotonic clock stops meanwhile."""
    asleep = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(
        time.CLOCK_MONOTONIC
    )
    return max(0, asleep)
