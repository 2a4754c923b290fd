"""One clock: every stamp a device can give becomes an instant of the host's monotonic clock.

Three relations are kept, each on its own evidence:

    kernel stamp   realtime - monotonic, sampled; both sides of a step of the system clock
    device counter lower envelope of arrival minus ticks, one for each device clock
    UTC            lower envelope of arrival minus reported UTC, less `serial_latency_s`;
                   the system clock until a receiver has reported

It is the only place that knows leap seconds and weeks: UTC is POSIX nanoseconds, a leap second
repeats the second before, and shows here as a jump of UTC that is learnt again and counted. Dates
from before the last rollover of the ten-bit GPS week are moved by 1024 weeks (IS-GPS-200,
20.3.3.3.1.1).

Host time is injected; with the same host time and the same calls the answers are the same.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, assert_never

from drivers.measurements import (
    ArrivalStamp,
    DeviceStamp,
    KernelStamp,
    MonotonicStamp,
    Stamp,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from fusiond.clock.offset_filter import MILLISECOND_NS, SECOND_NS, DeviceClock, UtcEnvelope
from fusiond.clock.time_of_day import RdssTimeOfDay, nearest
from fusiond.configuration.schema import ClockOptions

_STEP_NS = MILLISECOND_NS
"""NTP slews at 500 ppm at most (adjtimex(2)); with 1000 ppm and 1 ms allowed the rest are steps."""
_SLEW_PER_NS = 1000
_BRACKET_NS = 50_000
"""Reading realtime between two monotonic readings further apart than this was interrupted."""
_AFTER_STEP_NS = 2 * SECOND_NS
"""Frames stamped before a step of the system clock are out of the kernel's queue by then."""
_KERNEL_MAX_AGE_NS = SECOND_NS
_KERNEL_FUTURE_NS = MILLISECOND_NS
_UTC_MAX_AGE_NS = 10 * SECOND_NS
"""The timeline's least history: a UTC stamp older than that says the mapping is wrong."""
_UTC_FUTURE_NS = 100 * MILLISECOND_NS
_SOURCE_SILENT_NS = 60 * SECOND_NS
_SAME_UTC_NS = 3 * SECOND_NS
"""Sources this close state the same UTC: whole seconds, and delays up to 2 s."""
_BETTER_NS = 5 * MILLISECOND_NS
_WEEKS_1024_NS = 1024 * 7 * 86400 * SECOND_NS
EARLIEST_UTC_NS = 1554595200 * SECOND_NS
"""2019-04-07, the last rollover of the ten-bit GPS week: earlier dates are mistakes."""

_KERNEL_SD_S = 1e-4
_DEVICE_SD_S = 5e-4
_UTC_SD_S = 3e-3
_SYSTEM_SD_S = 1e-2
_ARRIVAL_SD_S = 5e-3
"""A USB serial read arrives 1 to 16 ms late: uniform, 16 ms / sqrt(12)."""
_GUESSED_SD_S = 0.05
"""Sentences come 50 to 200 ms after their epoch: uniform, 150 ms / sqrt(12)."""


class HostTime(Protocol):
    """The host's two clocks: CLOCK_MONOTONIC and CLOCK_REALTIME, in ns."""

    def monotonic_ns(self) -> int: ...
    def realtime_ns(self) -> int: ...


class SystemTime:
    """The clocks of this machine."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    realtime_ns = staticmethod(time.time_ns)


class Instant(NamedTuple):
    """When a measurement was true (monotonic ns), one sigma of that (s), and the rule used."""

    t_valid_ns: int
    sd_s: float
    how: str


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


class _Realtime:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC, before and after the last step of the system clock."""

    def __init__(self, host: HostTime, counters: Counter[str]) -> None:
        self._host = host
        self._counters = counters
        self._sampled_ns, self.offset_ns = self._read()
        self.before_step_ns: int | None = None
        self._stepped_ns = 0

    def _read(self) -> tuple[int, int]:
        best: tuple[int, int, int] | None = None
        for _ in range(3):
            before = self._host.monotonic_ns()
            realtime = self._host.realtime_ns()
            after = self._host.monotonic_ns()
            middle = (before + after) // 2
            if best is None or after - before < best[0]:
                best = (after - before, middle, realtime - middle)
            if best[0] <= _BRACKET_NS:
                break
        assert best is not None
        return best[1], best[2]

    def sample(self) -> int:
        """Read the offset again, notice steps; realtime minus monotonic in ns."""
        now, offset = self._read()
        slew = max(0, now - self._sampled_ns) // _SLEW_PER_NS
        if abs(offset - self.offset_ns) > _STEP_NS + slew:
            self._counters["system_clock_stepped"] += 1
            self.before_step_ns = self.offset_ns
            self._stepped_ns = now
        elif self.before_step_ns is not None and now - self._stepped_ns > _AFTER_STEP_NS:
            self.before_step_ns = None
        self._sampled_ns, self.offset_ns = now, offset
        return offset


class Clock:
    """Turns stamps into instants. `counters` names everything it refused, guessed or learnt."""

    def __init__(self, options: ClockOptions, host: HostTime | None = None) -> None:
        self._options = options
        self._host: HostTime = SystemTime() if host is None else host
        self._serial_latency_ns = round(options.serial_latency_s * SECOND_NS)
        self.counters: Counter[str] = Counter()
        self._realtime = _Realtime(self._host, self.counters)
        self._devices: dict[str, DeviceClock] = {}
        self._utc: dict[str, UtcEnvelope] = {}
        self._reference: str | None = None
        self._rdss: dict[str, RdssTimeOfDay] = {}

    def now_ns(self) -> int:
        """The host's monotonic clock, ns."""
        return self._host.monotonic_ns()

    # ------------------------------------------------------------------ stamps

    def resolve(self, stamp: Stamp, source: str, t_seen_ns: int) -> Instant:
        """The instant at which a measurement of `source`, seen at `t_seen_ns`, was true.

        Not after `t_seen_ns`, but for a `MonotonicStamp`, which is taken as it is, and for the
        nanosecond that keeps a device's samples apart.
        """
        match stamp:
            case KernelStamp():
                return self._from_kernel(stamp, t_seen_ns)
            case DeviceStamp():
                device = self._devices.get(stamp.device)
                if device is None:
                    device = DeviceClock(self._options.max_clock_drift_ppm, self.counters)
                    self._devices[stamp.device] = device
                t_ns = device.to_monotonic(stamp.ticks_ns, t_seen_ns)
                return Instant(t_ns, _DEVICE_SD_S, "device")
            case UtcStamp():
                return self._from_utc(_rolled_over(stamp.utc_ns), source, t_seen_ns)
            case TimeOfDayStamp():
                return self._from_time_of_day(stamp, source, t_seen_ns)
            case MonotonicStamp():
                return Instant(stamp.t_ns, 0.0, "monotonic")
            case ArrivalStamp():
                latency_ns = round(stamp.latency_s * SECOND_NS)
                return Instant(t_seen_ns - latency_ns, _ARRIVAL_SD_S, "arrival")
            case _:
                assert_never(stamp)

    def _from_kernel(self, stamp: KernelStamp, t_seen_ns: int) -> Instant:
        latency_ns = round(stamp.latency_s * SECOND_NS)
        t_ns = stamp.realtime_ns - self._realtime.sample()
        # After a step, frames stamped before it are still queued: of the two readings that one
        # is right which is the younger without lying in the future.
        before = self._realtime.before_step_ns
        if before is not None:
            other = stamp.realtime_ns - before
            ages = [(t_seen_ns - t, t) for t in (t_ns, other)]
            possible = [age for age in ages if age[0] >= -_KERNEL_FUTURE_NS]
            chosen = min(possible)[1] if possible else t_ns
            self.counters["kernel_stamp_remapped"] += chosen != t_ns
            t_ns = chosen
        age_ns = t_seen_ns - t_ns
        if age_ns < -_KERNEL_FUTURE_NS:
            self.counters["kernel_stamp_future"] += 1
        elif age_ns > _KERNEL_MAX_AGE_NS:
            self.counters["kernel_stamp_old"] += 1
        else:
            return Instant(min(t_ns, t_seen_ns) - latency_ns, _KERNEL_SD_S, "kernel")
        return Instant(t_seen_ns - latency_ns, _ARRIVAL_SD_S, "arrival")

    def _from_utc(self, utc_ns: int, source: str, t_seen_ns: int) -> Instant:
        own = self._utc.get(source)
        if own is not None and not own.settled:
            self.counters["utc_stamp_unsettled"] += 1
            return self._guessed(t_seen_ns)
        offset_ns, sd_s, how = self._mapping(source)
        t_ns = utc_ns + offset_ns
        if t_ns > t_seen_ns + _UTC_FUTURE_NS:
            self.counters["utc_stamp_future"] += 1
            return self._guessed(t_seen_ns)
        if t_ns < t_seen_ns - _UTC_MAX_AGE_NS:
            self.counters["utc_stamp_old"] += 1
            return self._guessed(t_seen_ns)
        return Instant(min(t_ns, t_seen_ns), sd_s, how)

    def _guessed(self, t_seen_ns: int) -> Instant:
        return Instant(t_seen_ns - self._serial_latency_ns, _GUESSED_SD_S, "arrival")

    def _from_time_of_day(self, stamp: TimeOfDayStamp, source: str, t_seen_ns: int) -> Instant:
        offset_ns, sd_s, _ = self._mapping(source)
        r_ns = t_seen_ns - offset_ns
        if stamp.requested_ns is None and len(stamp.zones_h) == 1:
            utc_ns = nearest(stamp.time_of_day_s, stamp.zones_h, r_ns)
            return self._from_utc(utc_ns, source, t_seen_ns)
        rule = self._rdss.get(source)
        if rule is None:
            rule = RdssTimeOfDay(self._options.rdss_latency_s, self.counters)
            self._rdss[source] = rule
        q_ns = None if stamp.requested_ns is None else stamp.requested_ns - offset_ns
        dated = rule.resolve(stamp.time_of_day_s, stamp.zones_h, stamp.uncertainty_s, r_ns, q_ns)
        return Instant(dated.utc_ns + offset_ns, max(dated.sd_s, sd_s), dated.how)

    # ------------------------------------------------------------------ UTC

    def report(self, report: TimeReport) -> None:
        """Take a device's statement of UTC in; one that the device does not trust moves nothing.

        Counters: `utc_report_untrusted`, `utc_report_implausible`, `gps_week_rollover`,
        `utc_source_changed`, and those of `UtcEnvelope`.
        """
        if not report.trusted:
            self.counters["utc_report_untrusted"] += 1
            return
        utc_ns = _rolled_over(report.utc_ns)
        if utc_ns < EARLIEST_UTC_NS:
            self.counters["utc_report_implausible"] += 1
            return
        self.counters["gps_week_rollover"] += utc_ns != report.utc_ns
        envelope = self._utc.get(report.source)
        if envelope is None:
            envelope = UtcEnvelope(self._options.max_clock_drift_ppm, self.counters)
            self._utc[report.source] = envelope
        envelope.update(utc_ns, report.t_seen_ns)
        self._choose_reference(report.source, envelope)

    def _choose_reference(self, source: str, envelope: UtcEnvelope) -> None:
        """Prefer the source that is heard, and of those that agree the least delayed."""
        if source == self._reference:
            return
        if self._reference is None:
            self._reference = source
            return
        incumbent = self._utc[self._reference]
        silent = envelope.t_seen_ns - incumbent.t_seen_ns > _SOURCE_SILENT_NS
        gain = incumbent.offset_ns - envelope.offset_ns
        if silent or _BETTER_NS < gain < _SAME_UTC_NS:
            self.counters["utc_source_changed"] += 1
            self._reference = source

    def _mapping(self, source: str | None) -> tuple[int, float, str]:
        """Monotonic minus UTC (ns), its sigma (s) and its name, for what `source` says."""
        if self._options.utc == "gnss":
            name = source if source in self._utc else self._reference
            if name is not None:
                return self._utc[name].offset_ns - self._serial_latency_ns, _UTC_SD_S, "utc"
        return -self._realtime.sample(), _SYSTEM_SD_S, "system"

    def utc_ns(self, t_ns: int) -> int | None:
        """POSIX UTC (ns) of a monotonic instant; None while no plausible UTC is known.

        From the receiver once it has reported, before that from the system clock if its date is
        later than `EARLIEST_UTC_NS` (a computer without a battery starts in 1970).
        """
        utc_ns = t_ns - self._mapping(None)[0]
        return utc_ns if utc_ns >= EARLIEST_UTC_NS else None

    def status(self) -> ClockStatus:
        """A snapshot for `health`."""
        system_error_s = None
        settled = True
        if self._options.utc == "gnss" and self._reference is not None:
            utc_source = self._reference
            settled = self._utc[self._reference].settled
            offset_ns = self._mapping(None)[0]
            system_error_s = (self._realtime.sample() + offset_ns) / SECOND_NS
        else:
            utc_source = "none" if self.utc_ns(self.now_ns()) is None else "system"
        return ClockStatus(
            utc_source=utc_source,
            settled=settled,
            system_error_s=system_error_s,
            rdss_clock_error_s={n: r.clock_error_s for n, r in self._rdss.items()},
            rdss_zone_h={n: r.zone_h for n, r in self._rdss.items() if r.zone_h is not None},
            counters=dict(self.counters),
        )


def _rolled_over(utc_ns: int) -> int:
    """The date moved by 1024 weeks once if it lies before the last rollover and then is not."""
    if utc_ns < EARLIEST_UTC_NS <= utc_ns + _WEEKS_1024_NS:
        return utc_ns + _WEEKS_1024_NS
    return utc_ns
