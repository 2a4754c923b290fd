"""Log to standard error by a thread, so that a full pipe delays no tick.

A write to a pipe may wait for its reader for ever, a write to a file for a slow disk. The queue is
bounded: lines beyond its end are lost and counted.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections import deque
from typing import TextIO

MOST_LINES = 1000
"""Most waiting lines, tracebacks included: a minute of a hundred causes (`LogLimit`)."""
FAREWELL_S = 1.0
"""Time for the last lines at the end, a fifth of systemd's stop timeout."""


class StandardErrorHandler(logging.StreamHandler[TextIO]):
    """Handler that writes directly until `begin_thread`, so that processes can be forked before
    that. `lost` counts the lines lost since the last accepted one; the next accepted line states
    the number."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
        self.lost = 0
        self._waiting: deque[str] = deque()
        self._news = threading.Event()
        self._ending = False
        self._thread: threading.Thread | None = None

    def begin_thread(self) -> None:
        """Start the writer thread; logging no longer waits."""
        self._thread = threading.Thread(target=self._write_waiting, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        if self._thread is None:
            super().emit(record)
            return
        if len(self._waiting) >= MOST_LINES:
            self.lost += 1
            return
        text = self.format(record)
        if self.lost:
            text, self.lost = f"{text} ({self.lost} lines before it were lost)", 0
        self._waiting.append(text + self.terminator)
        self._news.set()

    def flush(self) -> None:
        """Write as many waiting lines as the descriptor takes."""
        if self._thread is None:
            super().flush()

    def close(self) -> None:
        """Write waiting lines for at most a second; later lines are written directly."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._ending = True
            self._news.set()
            thread.join(FAREWELL_S)
        super().close()

    def _write_waiting(self) -> None:
        """Write waiting lines to the descriptor itself: a blocked write through Python's buffer
        would hold the buffer's lock, for which the interpreter waits at exit."""
        descriptor = self.stream.fileno()
        while True:
            self._news.wait()
            self._news.clear()
            while self._waiting:
                data = self._waiting.popleft().encode(errors="replace")
                try:
                    while data:
                        data = data[os.write(descriptor, data) :]
                except OSError:  # the disk is full or the pipe closed
                    self.lost += 1
            if self._ending:
                return
