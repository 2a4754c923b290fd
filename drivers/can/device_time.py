"""Device time from a wrapping counter: unwrapped, with restarts detected. No I/O.

    lateness l(k) = l(k-1) + (arrival(k) - arrival(k-1)) - (device(k) - device(k-1)) >= 0

A frame cannot arrive before it was sent, but may arrive any time later: after a stall the reader
gets the delayed frames in one burst. So the number of wraps is the one that makes a frame's
lateness least, and a burst, a repeated or an overtaken frame is no restart. Lateness never makes
device time go backwards. If it does, and continues from there at the pace of the arrivals, without
a frame of the old time in between, the clock was restarted or set; so it was if the lateness
persists.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

RESTART_S = 1.0
"""Step from which a device may have restarted: frames of one device overtake each other by less,
and smaller steps of the arrival clock need no action; a boot takes longer."""
DEVICE_DRIFT = 1e-3
"""Bound of the rate error of a device's clock; crystals have 100 ppm at worst, RC oscillators ten
times that."""
RESTART_SAMPLES = 3
"""Consistent samples that confirm a new time: two may be one damaged frame and its repetition."""
LEAST_PACE = 0.5
"""Least ratio of arrival time to device time after a restart; repeated old frames come in a burst.
"""
SETTLE_S = 2.0
BACKLOG_PACE = 0.1
"""Least ratio by which a backlog shrinks while it is read. A latency above RESTART_S that shrank by
less over SETTLE_S shows a set clock."""

Arrivals = tuple[int, int]


@dataclass(slots=True)
class _Doubt:
    """Possible restart: the last ticks of the new time, and where its steady run began."""

    ticks: int
    first_ticks: int
    first_ns: Arrivals
    samples: int = 1


class DeviceTime:
    """Unwrapped time of a device; `restarts` counts its restarts."""

    def __init__(self, modulus: int, tick_ns: Fraction) -> None:
        self.restarts = 0
        self._modulus = modulus
        self._tick_ns = tick_ns
        self._tick = float(tick_ns)
        per_tick = 1e9 / self._tick
        # Half a period separates forward from backward; a short one cannot reveal a restart.
        self._slack = min(RESTART_S * per_tick, modulus / 4)
        self._restart = RESTART_S * per_tick
        self._settle = SETTLE_S * per_tick
        self._ticks: int | None = None
        self._arrivals_ns: Arrivals = (0, 0)
        self._delay = 0.0
        self._doubt: _Doubt | None = None
        self._lag: tuple[float, float] | None = None
        """Delay above RESTART_S under observation, and its duration (ticks)."""

    def unwrap(self, raw: int, arrivals_ns: Arrivals) -> int | None:
        """Time in ns since the clock's own zero; None for a time that did not advance, or that
        jumped and is not yet confirmed as a restart.

        `arrivals_ns`: instant of arrival on two clocks (kernel stamp, monotonic). The clock that
        agrees better with the device is used, for the first can be set and the second can stall.
        """
        if self._ticks is None:
            return self._begin(raw, arrivals_ns)
        advance, delay, elapsed = self._explain(raw, arrivals_ns)
        if advance <= 0:
            return self._confirm(raw, arrivals_ns)
        self._doubt = None
        if self._stays_delayed(delay, elapsed):
            self.restarts += 1
            return self._begin(raw, arrivals_ns)
        self._ticks, self._arrivals_ns = self._ticks + advance, arrivals_ns
        self._delay = max(0.0, delay)
        return self._ns()

    def _begin(self, raw: int, arrivals_ns: Arrivals) -> int:
        self._ticks, self._arrivals_ns = raw, arrivals_ns
        self._delay, self._lag, self._doubt = 0.0, None, None
        return self._ns()

    def _explain(self, raw: int, arrivals_ns: Arrivals) -> tuple[int, float, float]:
        """Ticks since the last sample, the resulting latency, and the time passed."""
        assert self._ticks is not None
        modulus, slack = self._modulus, self._slack
        step = (raw - self._ticks) % modulus
        found: tuple[int, float, float] | None = None
        for now, before in zip(arrivals_ns, self._arrivals_ns, strict=True):
            elapsed = (now - before) / self._tick
            drift = DEVICE_DRIFT * abs(elapsed)
            due = self._delay + elapsed
            advance = step + modulus * int((due + slack + drift - step) // modulus)
            delay = max(due - advance - drift, -slack)
            if found is None or abs(delay) < abs(found[1]):
                found = advance, delay, elapsed
        assert found is not None
        return found

    def _confirm(self, raw: int, arrivals_ns: Arrivals) -> int | None:
        """True if a time that stood or went backwards continues from there at the pace of the
        arrivals."""
        doubt = self._doubt
        if doubt is not None:
            advance = (raw - doubt.ticks) % self._modulus
            gone = (raw - doubt.first_ticks) % self._modulus
            passed = [
                (now - first) / self._tick
                for now, first in zip(arrivals_ns, doubt.first_ns, strict=True)
            ]
            on_pace = any(LEAST_PACE * gone <= p <= gone + self._slack for p in passed)
            if 0 < advance < self._modulus // 2:
                doubt.ticks = raw
                doubt.samples += 1
                if not on_pace:  # a burst decides nothing; the next frames may
                    doubt.first_ticks, doubt.first_ns, doubt.samples = raw, arrivals_ns, 1
                elif doubt.samples >= RESTART_SAMPLES:
                    self.restarts += 1
                    return self._begin(raw, arrivals_ns)
                return None
        self._doubt = _Doubt(raw, raw, arrivals_ns)
        return None

    def _stays_delayed(self, delay: float, elapsed: float) -> bool:
        if delay <= self._restart or self._slack < self._restart:
            self._lag = None
            return False
        first, passed = self._lag or (delay, 0.0)
        passed += max(0.0, elapsed) if self._lag else 0.0
        self._lag = first, passed
        if passed <= self._settle:
            return False
        self._lag = delay, 0.0
        return delay > first - BACKLOG_PACE * passed

    def _ns(self) -> int:
        assert self._ticks is not None
        return self._ticks * self._tick_ns.numerator // self._tick_ns.denominator
