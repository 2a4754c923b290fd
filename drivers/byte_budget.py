"""Limit on the bytes parsed of a line, set by the fastest rate of a real receiver.

    a bucket of BURST bytes, filled at the line's rate; each byte read takes one out of it

Navigation comes first: parsing a byte of the worst stream takes some microseconds (`python -m
tests.fuzz.hostile`), so a flood over a network could use the whole processor. Bytes beyond the
limit wait with their sender (TCP, a pty) or are lost in the kernel (UDP).
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
    """Token bucket of one line at `baud`; `now_s` is monotonic."""

    def __init__(self, baud: int = 0, now_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = max(LINE_BYTES_S, baud / 10.0)
        self._now_s = now_s
        self._left, self._filled_s = BURST, now_s()

    def spend(self, count: int) -> float:
        """Spend `count` bytes; return how long to wait before the next read, s."""
        now_s = self._now_s()
        self._left = min(BURST, self._left + self._rate * (now_s - self._filled_s)) - count
        self._filled_s = now_s
        return max(0.0, -self._left / self._rate)
