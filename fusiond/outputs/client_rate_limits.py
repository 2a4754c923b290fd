"""Rate limits of one client: token buckets for bytes, messages and microseconds.

    left(t) = min(burst, left(t0) + rate (t - t0))

A piece of work may overdraw a bucket. The client then waits until the bucket has refilled; one that
floods is disconnected. Time is `time.perf_counter_ns`.
"""

from __future__ import annotations

from dataclasses import dataclass

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Rate:
    """Rate limit: the amount a second, and the burst."""

    per_s: float
    burst: float


BYTES = Rate(65_536.0, 65_536.0)
"""Bytes from a client. Requests have 10 to 1000 bytes; a plotter that sends the sentences of a
whole vessel at 38400 baud (NMEA 0183-HS) has 4 kB/s."""
MESSAGES = Rate(25.0, 50.0)
"""Requests. gpsd's clients poll once a report, and receivers report at 20 Hz at most; a Foxglove
viewer sends one for each panel of a layout."""
MICROSECONDS = Rate(20_000.0, 20_000.0)
"""Processor time for a client's requests: 2 % of a core, a fifth of the time of all clients."""


class Bucket:
    """Token bucket of one rate."""

    __slots__ = ("_at_ns", "_left", "_rate")

    def __init__(self, rate: Rate, now_ns: int) -> None:
        self._rate = rate
        self._left = rate.burst
        self._at_ns = now_ns

    def spend(self, amount: float, now_ns: int) -> None:
        self._fill(now_ns)
        self._left -= amount

    def empty(self, now_ns: int) -> bool:
        """True if the client has used more than the limit allows."""
        self._fill(now_ns)
        return self._left < 0.0

    def _fill(self, now_ns: int) -> None:
        gained = self._rate.per_s * (now_ns - self._at_ns) / _SECOND_NS
        self._left = min(self._rate.burst, self._left + gained)
        self._at_ns = now_ns


class Allowance:
    """The three buckets of one client."""

    __slots__ = ("bytes", "messages", "microseconds")

    def __init__(self, now_ns: int) -> None:
        self.bytes = Bucket(BYTES, now_ns)
        self.messages = Bucket(MESSAGES, now_ns)
        self.microseconds = Bucket(MICROSECONDS, now_ns)

    def must_wait(self, now_ns: int) -> bool:
        """True if reading from the client must wait."""
        return self.bytes.empty(now_ns) or self.microseconds.empty(now_ns)
