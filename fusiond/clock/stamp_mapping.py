"""Conversion of every device's stamps to the host's monotonic clock.

Three relations are kept, each on its own evidence:

    kernel stamp   realtime - monotonic, sampled; both sides of a step of the system clock
    device counter lower envelope of arrival minus ticks, one for each device clock
    UTC            lower envelope of arrival minus reported UTC, less `serial_latency_s`;
                   the system clock until a receiver has reported

A device's own stamps are mapped by its own reports, at any date: a receiver in the year 2100 has
the same delay as any other. UTC itself changes only after a plausible date has lasted for minutes,
and with an event.

It is the only place that knows leap seconds and weeks: UTC is POSIX nanoseconds, a leap second
repeats the second before; it appears here as a jump of UTC, which is learnt again and counted.

Host time is injected; with the same host time and the same calls the results are the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from math import hypot
from typing import assert_never

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
from fusiond.clock.device_clock import DeviceClock
from fusiond.clock.host import (
    KERNEL_FUTURE_NS,
    MILLISECOND_NS,
    SECOND_NS,
    HostTime,
    Readings,
    SystemClock,
    SystemTime,
)
from fusiond.clock.results import ClockStatus, Instant, TimeSample
from fusiond.clock.time_of_day import RdssTimeOfDay, nearest
from fusiond.clock.utc_from_arrivals import UtcEnvelope, UtcKnown, plausible_date, rolled_over, year
from fusiond.configuration.schema import ClockOptions

_KERNEL_MAX_AGE_NS = SECOND_NS
_UTC_MAX_AGE_NS = 10 * SECOND_NS
"""The timeline's least history: a UTC stamp older than that by another's UTC says that one of the
two is wrong."""
_UTC_MAX_DELAY_NS = 60 * SECOND_NS
"""Longer than a tty's queue holds: a stamp older by its own source's UTC belongs to another UTC."""
_UTC_FUTURE_NS = 100 * MILLISECOND_NS
_SYSTEM_LATENCY_NS = SECOND_NS
"""Delay from which a receiver's fixes prove the system clock wrong."""
_SOURCE_SILENT_NS = 60 * SECOND_NS
_SAME_UTC_NS = 3 * SECOND_NS
"""Difference up to which two sources state the same UTC: whole seconds, and delays up to 2 s."""
_RESUMED_NS = 60 * SECOND_NS
"""Age from which saved UTC is learnt again: 100 ppm of drift are then 6 ms, twice its sigma."""
_BETTER_NS = 5 * MILLISECOND_NS
_REPORTED_STEP_NS = 500 * MILLISECOND_NS
"""Change of UTC from which another reference is reported as an event."""

_SETS_CLOCKS_SD_S = 2e-2
"""Sigma up to which UTC may set clocks. A receiver reaches it after eight reports, or fifty of
whole seconds delayed by up to a second."""

_KERNEL_SD_S = 1e-4
_DEVICE_SD_S = 5e-4
_SYSTEM_SD_S = 1e-2
_ARRIVAL_SD_S = 5e-3
"""A USB serial read arrives 1 to 16 ms late: uniform, 16 ms / sqrt(12)."""
_GUESSED_SD_S = 0.5
"""Sigma of an assumed delay. Sentences come 20 to 200 ms after their epoch, with one receiver
always alike. A filter averages the errors of fixes as independent; sigma is therefore three times
the largest error (a drive at 15 m/s with 0.15 s: 8 sigma)."""


class Clock:
    """Converter of stamps to instants. `counters` names every refusal, guess and learnt value.

    `on_event(code, text)` receives events of UTC, system clock and host; `on_time` receives every
    report by which the system clock may be set.
    """

    def __init__(
        self,
        options: ClockOptions,
        host: HostTime | None = None,
        readings: Readings | None = None,
    ) -> None:
        self._options = options
        self._host: HostTime = SystemTime() if host is None else host
        self.readings = Readings(self._host) if readings is None else readings
        self._serial_latency_ns = round(options.serial_latency_s * SECOND_NS)
        self.counters: Counter[str] = Counter()
        self.on_event: Callable[[str, str], None] | None = None
        self.on_time: Callable[[TimeSample], None] | None = None
        self._system = SystemClock(self.readings, self.counters)
        self._slept_ns = 0
        self._devices: dict[str, DeviceClock] = {}
        self._utc: dict[str, UtcEnvelope] = {}
        self._stamped: dict[str, UtcEnvelope] = {}
        self._reference: str | None = None
        self._rdss: dict[str, RdssTimeOfDay] = {}

    def now_ns(self) -> int:
        """The host's monotonic clock, ns."""
        return self._host.monotonic_ns()

    def system_state(self) -> dict[str, int | None]:
        """State of the system clock, for a replay (`restore_system`)."""
        return self._system.state()

    def restore_system(self, state: Mapping[str, int | None]) -> None:
        """Restore another `Clock`'s state of the system clock, from its start."""
        self._system.restore(state)

    def look(self) -> int:
        """Sample the host's clocks; realtime minus monotonic, ns."""
        changes = self._system.changes
        offset_ns = self._system.sample()
        if self._system.changes != changes:
            self._changed()
        return offset_ns

    def _changed(self) -> None:
        """Handle a suspend of the host, a step of its clock, or both."""
        stepped_ns = self._system.last_step_ns
        slept_ns = self._system.slept_ns - self._slept_ns
        if slept_ns:
            self._slept_ns = self._system.slept_ns
            for envelope in (*self._utc.values(), *self._stamped.values()):
                envelope.slept(slept_ns)
            # Whether a device counted on is not known; it is learnt at its next sample. One that
            # sends before this is noticed has its counts held back, if it did.
            self._devices.clear()
            self.counters["host_resumed"] += 1
            self._event("host_resumed", f"the host was suspended for {slept_ns / SECOND_NS:.1f} s")
        if stepped_ns:
            text = f"the system clock was set by {stepped_ns / SECOND_NS:+.3f} s"
            self._event("system_clock_stepped", text)

    def _event(self, code: str, text: str) -> None:
        if self.on_event is not None:
            self.on_event(code, text)

    def _envelope(self, of: dict[str, UtcEnvelope], source: str) -> UtcEnvelope:
        """UTC envelope of `source`, created on first use."""
        if source not in of:
            of[source] = UtcEnvelope(self._options.max_clock_drift_ppm, self.counters)
        return of[source]

    # ------------------------------------------------------------------ stamps

    def resolve(self, stamp: Stamp, source: str, t_seen_ns: int) -> Instant:
        """Instant of validity of a measurement of `source` that was seen at `t_seen_ns`.

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
                return self._from_utc(rolled_over(stamp.utc_ns), source, t_seen_ns)
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
        self.look()
        t_ns = self._system.monotonic_of(stamp.realtime_ns, t_seen_ns)
        age_ns = t_seen_ns - t_ns
        if age_ns < -KERNEL_FUTURE_NS:
            self.counters["kernel_stamp_future"] += 1
        elif age_ns > _KERNEL_MAX_AGE_NS:
            self.counters["kernel_stamp_old"] += 1
        else:
            return Instant(min(t_ns, t_seen_ns) - latency_ns, _KERNEL_SD_S, "kernel")
        return Instant(t_seen_ns - latency_ns, _ARRIVAL_SD_S, "arrival")

    def _from_utc(self, utc_ns: int, source: str, t_seen_ns: int) -> Instant:
        self.look()
        own = self._utc.get(source) if self._options.utc == "gnss" else None
        if own is None:
            return self._from_others_utc(utc_ns, source, t_seen_ns)
        if own.open:
            self.counters["utc_stamp_unsettled"] += 1
            return self._by_arrival(t_seen_ns, own.sd_s)
        stamped = own.stamp(utc_ns, t_seen_ns)
        t_ns = stamped.t_ns - self._serial_latency_ns
        if t_ns > t_seen_ns + _UTC_FUTURE_NS:
            self.counters["utc_stamp_future"] += 1
            return self._by_arrival(t_seen_ns, stamped.sd_s)
        if t_ns < t_seen_ns - _UTC_MAX_DELAY_NS:
            self.counters["utc_stamp_old"] += 1
            return self._by_arrival(t_seen_ns, own.sd_s)
        return Instant(min(t_ns, t_seen_ns), stamped.sd_s, "utc")

    def _from_others_utc(self, utc_ns: int, source: str, t_seen_ns: int) -> Instant:
        """Instant by the reference's UTC or the system's; by the source's own stamps if neither
        applies."""
        own = self._envelope(self._stamped, source)
        own.update(utc_ns, t_seen_ns)
        offset_ns, sd_s, how = self._mapping(source)
        t_ns = utc_ns + offset_ns
        least_age_ns = own.offset_ns - offset_ns
        if t_ns > t_seen_ns + _UTC_FUTURE_NS:
            self.counters["utc_stamp_future"] += 1
        elif t_ns < t_seen_ns - _UTC_MAX_AGE_NS or (
            how == "system" and least_age_ns > _SYSTEM_LATENCY_NS
        ):
            self.counters["utc_stamp_old"] += 1
        else:
            return Instant(min(t_ns, t_seen_ns), sd_s, how)
        if own.open:
            return self._by_arrival(t_seen_ns, own.sd_s)
        stamped = own.stamp(utc_ns, t_seen_ns)
        t_ns = min(stamped.t_ns, t_seen_ns) - self._serial_latency_ns
        return Instant(t_ns, hypot(stamped.sd_s, _GUESSED_SD_S), "arrival")

    def _by_arrival(self, t_seen_ns: int, sd_s: float) -> Instant:
        return Instant(t_seen_ns - self._serial_latency_ns, hypot(sd_s, _GUESSED_SD_S), "arrival")

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
        `utc_source_changed`, `utc_jumped`, and those of `UtcEnvelope`.
        """
        self.look()
        utc_ns = rolled_over(report.utc_ns)
        if not report.trusted:
            self.counters["utc_report_untrusted"] += 1
            if report.source in self._utc:
                self._utc[report.source].untrusted(utc_ns, report.t_seen_ns)
            return
        plausible = plausible_date(utc_ns)
        self.counters["utc_report_implausible"] += not plausible
        self.counters["gps_week_rollover"] += utc_ns != report.utc_ns
        envelope = self._envelope(self._utc, report.source)
        if envelope.plausible and not plausible:
            refusal = f"{report.source} tells the year {year(utc_ns)}: not believed"
            self._event("utc_implausible", refusal)
        jumped_ns = -envelope.update(utc_ns, report.t_seen_ns, plausible=plausible)
        if jumped_ns and report.source == self._reference:
            self._jumped(jumped_ns, f"{report.source} has said so for minutes")
        if plausible:
            self._choose_reference(report.source, envelope)
            self._pass_on(report.source, utc_ns, report.t_seen_ns)

    def _pass_on(self, source: str, utc_ns: int, t_seen_ns: int) -> None:
        """Hand the reference's report on unchanged. A client that sets a clock has its own filter,
        and the envelope follows the clock that the client slews: it would return the client's own
        correction."""
        if self.on_time is None or source != self._reference or self._options.utc == "system":
            return
        reference = self._utc[source]
        if reference.settled and reference.sd_s < _SETS_CLOCKS_SD_S:
            system_ns = t_seen_ns + self._system.offset_ns
            self.on_time(TimeSample(system_ns, utc_ns + self._serial_latency_ns))

    def known(self) -> tuple[UtcKnown, ...]:
        """UTC of every source without doubts, for `resume`."""
        found = (envelope.known(source) for source, envelope in self._utc.items())
        return tuple(known for known in found if known is not None)

    def resume(self, known: tuple[UtcKnown, ...]) -> None:
        """Resume with UTC from an earlier process, before the first report; monotonic time must
        have continued without a pause. Old values are ignored.

        A new process knows UTC from the first reports to 50 ms or worse, with the same error for
        all fixes of the next seconds: on a road a metre or two along the path, which no filter can
        distinguish.
        """
        now_ns = self.now_ns()
        for each in known:
            new = 0 <= now_ns - each.t_seen_ns <= _RESUMED_NS
            if new and plausible_date(each.utc_ns):
                envelope = self._envelope(self._utc, each.source)
                envelope.resume(each)
                self.counters["utc_resumed"] += 1
                self._choose_reference(each.source, envelope)

    def _jumped(self, jumped_ns: int, why: str) -> None:
        self.counters["utc_jumped"] += 1
        self._event("utc_jumped", f"UTC jumped by {jumped_ns / SECOND_NS:+.3f} s: {why}")

    def _choose_reference(self, source: str, envelope: UtcEnvelope) -> None:
        """Select the reference: a source that reports, and among those that agree the least
        delayed."""
        if self._reference is None or source == self._reference:
            self._reference = source
            return
        incumbent = self._utc[self._reference]
        silent = envelope.t_seen_ns - incumbent.t_seen_ns > _SOURCE_SILENT_NS
        gain = incumbent.believed_offset_ns - envelope.believed_offset_ns
        if silent or _BETTER_NS < gain < _SAME_UTC_NS:
            self.counters["utc_source_changed"] += 1
            if abs(gain) > _REPORTED_STEP_NS and self._options.utc == "gnss":
                self._jumped(gain, f"{source} tells it in place of {self._reference}")
            self._reference = source

    def _mapping(self, source: str | None) -> tuple[int, float, str]:
        """Monotonic minus UTC (ns), its sigma (s) and its name, for a stamp of `source`.

        With `utc = "system"` a step of the system clock shows a change of its reference, for better
        or worse: for two minutes stamps are mapped as before, and sigma is the step, or its value
        without any UTC. UTC itself (None) follows the system clock.
        """
        system_ns = self.look()
        if self._options.utc == "gnss":
            own = self._utc.get(source) if source is not None else None
            if own is not None:
                return own.offset_ns - self._serial_latency_ns, own.sd_s, "utc"
            if self._reference is not None:
                reference = self._utc[self._reference]
                offset_ns = reference.believed_offset_ns
                doubt_s = (reference.offset_ns - offset_ns) / SECOND_NS
                return offset_ns - self._serial_latency_ns, hypot(reference.sd_s, doubt_s), "utc"
        if source is None:
            return -system_ns, _SYSTEM_SD_S, "system"
        step_s = min(_GUESSED_SD_S, abs(system_ns - self._system.held_ns) / SECOND_NS)
        return -self._system.held_ns, hypot(_SYSTEM_SD_S, step_s), "system"

    def utc_ns(self, t_ns: int) -> int | None:
        """POSIX UTC (ns) of a monotonic instant; None while no plausible UTC is known.

        From the receiver once it has reported, before that from the system clock if its date is
        plausible (a computer without a battery starts in 1970).
        """
        utc_ns = t_ns - self._mapping(None)[0]
        return utc_ns if plausible_date(utc_ns) else None

    @property
    def sets_others(self) -> bool:
        """True if others may set a clock by `utc_ns`: a receiver has reported UTC without doubt, or
        the system clock is configured as its reference."""
        if self._options.utc == "system":
            return True
        return self._reference is not None and self._utc[self._reference].settled

    def status(self) -> ClockStatus:
        """A snapshot for `health`."""
        system_error_s = None
        settled = True
        if self._options.utc == "gnss" and self._reference is not None:
            utc_source = self._reference
            settled = self._utc[self._reference].settled
            offset_ns = self._mapping(None)[0]
            system_error_s = (self.look() + offset_ns) / SECOND_NS
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
