"""A host whose monotonic and system clocks a test owns."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

S = 1_000_000_000
MS = 1_000_000


def utc(text: str) -> int:
    """POSIX ns of an ISO instant."""
    t = datetime.fromisoformat(text).replace(tzinfo=UTC)
    return int(t.timestamp()) * S + t.microsecond * 1000


@dataclass
class Host:
    """True UTC and the monotonic clock run together; the system clock may be wrong and step."""

    mono: int = 5_000 * S
    true_utc_at_zero: int = utc("2026-11-20T23:00:00") - 5_000 * S
    system_error: int = 0
    slept: int = 0

    def monotonic_ns(self) -> int:
        return self.mono

    def realtime_ns(self) -> int:
        return self.mono + self.true_utc_at_zero + self.system_error

    def boottime_ns(self) -> int:
        return self.mono + self.slept

    def suspend(self, ns: int) -> None:
        """Monotonic time stands still, all others go on."""
        self.slept += ns
        self.true_utc_at_zero += ns

    def utc(self, mono: int | None = None) -> int:
        return (self.mono if mono is None else mono) + self.true_utc_at_zero

    def at_utc(self, text: str) -> int:
        """Move to a UTC instant; the monotonic time there."""
        self.mono = utc(text) - self.true_utc_at_zero
        return self.mono
