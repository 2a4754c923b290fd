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
    """True UTC and the monotonic clock run together; the system clock may be wrong, step and be
    slewed, which moves CLOCK_MONOTONIC too."""

    mono: int = 5_000 * S
    true_utc_at_zero: int = utc("2026-11-20T23:00:00") - 5_000 * S
    system_error: int = 0
    slept: int = 0
    slew_ppm: int = 0
    _slewed: int = 0
    _slewed_since: int = 0

    def monotonic_ns(self) -> int:
        return self.mono

    @property
    def slewed(self) -> int:
        """What slews have come to."""
        return self._slewed + (self.mono - self._slewed_since) * self.slew_ppm // 1_000_000

    def slew(self, ppm: int) -> None:
        """Slew the system clock from now on."""
        self._slewed, self._slewed_since, self.slew_ppm = self.slewed, self.mono, ppm

    def slewed_ns(self) -> int:
        return self.mono + self.slewed

    def realtime_ns(self) -> int:
        return self.mono + self.true_utc_at_zero + self.system_error + self.slewed

    def boottime_ns(self) -> int:
        return self.mono + self.slept + self.slewed

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
