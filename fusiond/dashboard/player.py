"""Player of a log's messages, in real time or faster."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from pathlib import Path

from fusiond.dashboard.vehicles import Hub
from fusiond.recording.reader import Log

TOPICS = (
    *("/status", "/nav", "/health", "/consistency", "/calibration", "/event", "/innovation"),
    *("/message", "/fleet"),
)
SECOND = 1_000_000_000
AT_ONCE = 64
"""Messages played in a row, in a fast replay, before browsers are served."""


class Player:
    """Source of a hub: messages of a log. Raises `LogError` and OSError for an unreadable file."""

    def __init__(self, paths: Sequence[Path], speed: float) -> None:
        self._log = Log(paths)
        self.speed = speed
        self.vehicle = self._log.about.metadata["vehicle"]
        self.origin = ", ".join(path.name for path in self._log.paths)
        self._began = 0.0
        self._next_s = 0.0

    def now_s(self) -> float:
        """Seconds of the log played so far, at most up to the next message."""
        return min(self._elapsed_s, self._next_s)

    @property
    def _elapsed_s(self) -> float:
        return (time.monotonic() - self._began) * self.speed

    async def play(self, hub: Hub) -> None:
        """Play to the end, then wait until cancelled."""
        first_ns: int | None = None
        hub.linked("up")
        for count, message in enumerate(self._log.messages(*TOPICS)):
            if first_ns is None:
                first_ns, self._began = message.t_log_ns, time.monotonic()
            self._next_s = max(self._next_s, (message.t_log_ns - first_ns) / SECOND)
            ahead_s = self._next_s - self._elapsed_s
            if ahead_s > 0.0 or count % AT_ONCE == 0:
                await asyncio.sleep(max(0.0, ahead_s) / self.speed)
            if ahead_s < 0.0:  # it cannot be played so fast: the clock waits for it
                self._began -= ahead_s / self.speed
            hub.receive(self.vehicle, message.topic[1:], message.data)
        hub.linked("ended", "; ".join(self._log.problems))
        await asyncio.Event().wait()
