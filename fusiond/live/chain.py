"""Processing chain from inputs to the solution: clock, drivers, navigator, without I/O.

Its results depend only on its restored state, its drivers' inputs, the operator's commands and its
ticks. The daemon feeds it from devices, a replay from a recording, with the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import isfinite

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.model_fit import model_doubts
from fusiond.configuration.schema import Config
from fusiond.live.events import Events
from fusiond.live.injection import Injection
from fusiond.live.operator import Operator
from fusiond.live.rdss_messaging import Messaging
from fusiond.live.sources import Sources
from fusiond.live.tick_scheduler import SECOND_NS, Every
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.checkpoints import Key
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_state import SavedState
from fusiond.navigator.timeline import Entry
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.innovations import Innovation

MOST_INNOVATIONS = 200
"""Most innovations of one message: positions and velocities of a receiver at 20 Hz for 5 s, 20 kB.
The oldest are dropped."""


class Innovations:
    """Collector of measurement outcomes for `innovations`. The filter's own constraints are left
    out: they are many and have no verdict."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._ended: dict[Key, Entry] = {}

    def add(self, entry: Entry) -> None:
        """Store a measurement's outcome; after a rewind the new outcome replaces the first."""
        if entry.measurement.constraint:
            return
        self._ended[entry.key] = entry
        if len(self._ended) > MOST_INNOVATIONS:
            del self._ended[next(iter(self._ended))]

    def since(self) -> list[Innovation]:
        """Innovations since the last call, in order of validity."""
        ended, self._ended = self._ended, {}
        return [
            message for key in sorted(ended) if (message := self._message(ended[key])) is not None
        ]

    def _message(self, entry: Entry) -> Innovation | None:
        outcome = entry.outcome
        if outcome is None:
            return None
        return Innovation(
            source=entry.measurement.source,
            t_ms=stamp(self._clock.utc_ns(entry.key[0]))[1],
            outcome=outcome.name,
            nis=round(outcome.nis, 3) if isfinite(outcome.nis) else None,
            degrees=outcome.degrees,
        )


LONGEST_WAIT_NS = 50_000_000
"""Longest time that samples wait for a tick that does something: a solution's mode is as old as
that at most, and of an IMU of 1 kHz 50 samples cost that tick 0.1 ms."""


class Chain:
    """Chain of one vehicle from inputs to the solution. `saved`: state for the alignment;
    `on_outcome` receives each measurement's outcome."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        events: Events,
        saved: SavedState | None = None,
        on_outcome: Callable[[Entry], None] | None = None,
    ) -> None:
        self.config = config
        self.clock = clock
        self.events = events
        self._on_code: Callable[[str], None] | None = None
        navigator_event = partial(self._report, "navigator")
        self.innovations = Innovations(clock)
        self._on_outcome = on_outcome
        self.navigator = Navigator(config, saved, navigator_event, self._ended)
        for doubt in model_doubts(config):
            navigator_event("states_absent", doubt)
        self.injection = Injection(events.report)
        self.sources = Sources(config, clock, self.navigator, self.injection, self._report)
        drivers = {name: source.driver for name, source in self.sources.all.items()}
        self.messaging = Messaging(config, clock, drivers, events.report)
        self.sources.on_mail, self._on_code = self.messaging.receive, self.messaging.note_event
        self._reports_position = config.position_reports.card is not None
        self.operator = Operator(self.navigator, self.sources, self.injection, self.messaging)
        self.solution: Solution | None = None
        self.changed = False
        """True if the last tick brought another mode."""
        self._second = Every(SECOND_NS)
        self._ticked_ns = 0

    def _report(self, source: str, code: str, text: str) -> None:
        """Report an event of a device or of the navigator."""
        self.events.report(source, code, text)
        if self._on_code is not None:  # None while the parts are made
            self._on_code(code)

    def _ended(self, entry: Entry) -> None:
        self.innovations.add(entry)
        if self._on_outcome is not None:
            self._on_outcome(entry)

    def may_wait(self, t_ns: int) -> bool:
        """True if the tick at `t_ns`, whose solution nobody reads, may leave its samples to the
        next.

        How many samples the filter processes at once does not change its state, but it changes the
        decisions of a tick. So a tick may wait only if nothing but samples has arrived and the
        vehicle navigates.
        """
        sources = self.sources
        return (
            self.solution is not None
            and self.solution.mode is Mode.NAVIGATING
            and t_ns - self._ticked_ns < LONGEST_WAIT_NS
            and len(sources.imu.waiting) > 0
            and not sources.imu.has_spare
            and not sources.measured
            and not self.injection.faults
            and self._second.waits(t_ns)
        )

    def wait(self) -> None:
        """Leave the samples of a tick to the next."""
        self.sources.behind = True
        self.changed = False

    def tick(self, t_ns: int) -> Solution:
        """Run the filter on all input and read the solution at `t_ns`."""
        self._ticked_ns, self.sources.measured, self.sources.behind = t_ns, False, False
        if self.injection.faults:
            self.sources.release(t_ns)
        arrived = self.sources.take_imu(t_ns)
        if arrived is not None:
            self.navigator.add_imu(*arrived)
        self.navigator.tick(t_ns)
        solution = self.navigator.solution(t_ns)
        before, self.solution = self.solution, solution
        self.changed = before is None or before.mode is not solution.mode
        if self.changed:
            self._report("navigator", f"mode_{solution.mode}", solution.reason)
        navigating = solution.mode in (Mode.NAVIGATING, Mode.COASTING)
        if (self._second.due(t_ns) or self.changed) and navigating:
            self.sources.height_hint(solution.height_m, solution.sd_ned_m[2], t_ns)
        if self._reports_position:
            self.messaging.tick(t_ns, solution)
        return solution
