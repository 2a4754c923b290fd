"""Tests that failed while their guest stood still, because its host had other things to do.

A bus on which nothing comes for a second is silent, and a daemon says so: nothing can be told from
what happens then, and the test is to be run again. A standstill is measured, by a thread that does
nothing but sleep; a test that failed without one has failed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

FAILURES = "FUSIOND_HIL_FAILURES"
"""Environment: the file that a guest's failures are noted in, a line each: `void` or `failed`, and
the test."""
PERIOD_S = 0.02
STANDSTILL_S = 0.25
"""Half of what an IMU may be silent for (`gap_s`)."""


@contextmanager
def watching() -> Iterator[Callable[[], float]]:
    """Gives the longest time (s) until now for which this process stood still."""
    over, longest_s = threading.Event(), 0.0

    def watch() -> None:
        nonlocal longest_s
        before = time.monotonic()
        while not over.wait(PERIOD_S):
            now = time.monotonic()
            longest_s = max(longest_s, now - before - PERIOD_S)
            before = now

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield lambda: longest_s
    finally:
        over.set()
        thread.join()
