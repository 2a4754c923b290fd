"""What the clock answers with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Instant(NamedTuple):
    """When a measurement was true (monotonic ns), one sigma of that (s), and the rule used."""

    t_valid_ns: int
    sd_s: float
    how: str


class TimeSample(NamedTuple):
    """What CLOCK_REALTIME said when a report of the reference came in, and true UTC then (ns)."""

    system_ns: int
    utc_ns: int


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """What `health` and `doctor` say of the clock.

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
