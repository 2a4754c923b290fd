"""Retries of a failed recording: at first soon, then once a minute, until the disk accepts it.

An attempt is an empty log; once it is on the disk, recording resumes in it. Input in between is
lost.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.base import Backoff
from fusiond.clock.host import SECOND_NS
from fusiond.recording.log_writer import LogWriter

FIRST_S = 5.0
"""A disk that was plugged in again is mounted within some seconds."""
LONGEST_S = 60.0
"""Longest wait between attempts; a failure after a longer success begins a new series."""


class Retry:
    """Attempts of one recorder, timed by ticks."""

    def __init__(self) -> None:
        self._backoff = Backoff(FIRST_S, LONGEST_S)
        self._due_ns: int | None = None
        self._since_ns: int | None = None
        self._attempt: LogWriter | None = None

    def ready(self, t_ns: int, open_log: Callable[[], LogWriter]) -> LogWriter | None:
        """Log on a writable disk, or None until there is one; to be called every tick."""
        if self._due_ns is None:
            self._wait(t_ns)
        elif self._attempt is None and t_ns >= self._due_ns:
            self._attempt = open_log()
        elif self._attempt is not None and self._attempt.stopped is not None:
            self._attempt = None
            self._wait(t_ns)
        elif self._attempt is not None and self._attempt.synced:
            writer, self._attempt = self._attempt, None
            self._due_ns, self._since_ns = None, t_ns
            return writer
        return None

    def give_up(self) -> None:
        """Stop retrying."""
        if self._attempt is not None:
            self._attempt.close()
        self._attempt = self._due_ns = None

    def _wait(self, t_ns: int) -> None:
        if self._since_ns is not None and t_ns - self._since_ns > LONGEST_S * SECOND_NS:
            self._backoff.reset()
        self._since_ns = None
        self._due_ns = t_ns + round(self._backoff.next() * SECOND_NS)
