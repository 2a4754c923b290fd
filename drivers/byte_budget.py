"""Limit on the bytes parsed of a line, set by the fastest rate of a real receiver.

    a bucket of BURST bytes, filled at the line's rate; each byte read takes one out of it

A byte of the worst stream costs some microseconds (`python -m tests.fuzz.hostile`), a flood over a
network as much processor time as there is. What is not read waits with its sender (TCP, a pty) or
is lost in the kernel (UDP): navigation comes first.
"""

from __future__ import annotations

import time
from collections.abc import Callable

LINE_BYTES_S = 92_160.0
"""Byte rate of 921600 baud, a receiver's highest UART rate, at ten bits a byte; 60 satellites of
two signals at 10 Hz (RXM-RAWX and RXM-SFRBX) take half of it."""
BURST = 65_536.0
"""The largest datagram; seven of the longest epochs (8 kB)."""


class ByteBudget:
    """The bucket of one line at `baud`; `now_s` is monotonic."""

    def __init__(self, baud: int = 0, now_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = max(LINE_BYTES_S, baud / 10.0)
        self._now_s = now_s
        self._left, self._filled_s = BURST, now_s()

    def spend(self, count: int) -> float:
        """Take `count` bytes out; for how long nothing more is to be read, in s."""
        now_s = self._now_s()
        self._left = min(BURST, self._left + self._rate * (now_s - self._filled_s)) - count
        self._filled_s = now_s
        return max(0.0, -self._left / self._rate)
