"""Results of the clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Instant(NamedTuple):
    """Instant of validity (monotonic ns), its sigma (s) and the rule."""

    t_valid_ns: int
    sd_s: float
    how: str


class TimeSample(NamedTuple):
    """Reading of CLOCK_REALTIME at a report of the reference, and true UTC then (ns)."""

    system_ns: int
    utc_ns: int


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """Status of the clock for `health` and `doctor`.

    `utc_source` is a source's name, `system`, or `none` while no plausible UTC is known.
    `system_error_s` is the system clock minus the receiver's UTC. `rdss_clock_error_s` is daemon
    UTC minus the terminal's as learnt from fixes whose time of day fits nothing, by source.
    """

    utc_source: str
    settled: bool
    system_error_s: float | None
    rdss_clock_error_s: dict[str, float] = field(default_factory=dict)
    rdss_zone_h: dict[str, int] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
