"""Outcomes of measurements since the last call, for `innovations`."""

from __future__ import annotations

from math import isfinite

from fusiond.clock.stamp_mapping import Clock
from fusiond.navigator.timeline import Entry, Key
from fusiond.outputs.messages.base import stamp
from fusiond.outputs.messages.innovations import Innovation

MOST = 200
"""Most innovations of one message: positions and velocities of a receiver at 20 Hz for 5 s, 20 kB.
The oldest are dropped."""


class Innovations:
    """Collector of outcomes in the tick. Constraints of the filter are left out: they are many, and
    have no verdict."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._ended: dict[Key, Entry] = {}

    def add(self, entry: Entry) -> None:
        """A measurement has ended; one that a rewind brings again is there already."""
        if entry.measurement.constraint:
            return
        self._ended[entry.key] = entry
        if len(self._ended) > MOST:
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
