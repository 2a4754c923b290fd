"""`fusiond doctor`: diagnosis of each port, opened by its own driver for some seconds.

Each finding names symptom and remedy; the exit status is 0 without findings. Nothing is sent beyond
the daemon's own bytes: an RDSS terminal is asked for identity and beams, and for fixes, which make
it transmit, only on request.
"""

from __future__ import annotations

import asyncio
import sys
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, TextIO

import aiomqtt
import numpy as np

from drivers.base import Driver, Emitted
from drivers.measurements import DeviceEvent, ImuSample, TimeReport
from drivers.raw.messages import NavigationMessage
from drivers.rdss.mail import Mail
from drivers.rdss.messages import BeamPower
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import ConfigError, driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import imu_noise, quiet_limits, sensor_to_body
from fusiond.doctor.devices import device_name, open_findings
from fusiond.doctor.findings import finding
from fusiond.doctor.measurement_statistics import KEPT, MeasurementStatistics
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.outputs import broker_access

BURST_S = 0.1
"""Longest burst: arrivals within one read of a line, such as all ephemerides; it has no rate."""
MAX_TILT_DEG = 30.0
"""No vehicle is parked on a steeper slope; a wrong axis is 90 or 180 degrees off."""
GRAVITY_TOLERANCE = 0.05
"""Share of g: 50 mg is the turn-on bias of the coarsest automotive accelerometers."""
RATE_TOLERANCE = 0.2
"""Tolerated deviation from the configured IMU rate; beyond it buffer size and noise are wrong."""
DAMAGED_SHARE = 0.001
"""A sound line damages less than one item in a thousand."""
SYSTEM_CLOCK_S = 1.0
"""System clock against GNSS: beyond it logs and file dates mislead."""
ROLLOVER_S = 1024 * 604_800.0
"""Period of the GPS week's ten bits."""
DAY_S = 86_400.0
OLD_FIX_S = 1.0
"""Receivers send within 0.3 s of the epoch; older means a line too slow for its sentences."""
_BROKER_S = 5.0
_SHOWN_EVENTS = 6
_CHECKSUMS = "wrong checksums against"


@dataclass(slots=True)
class Arrivals:
    """Arrivals of one kind of measurement: monotonic ns, delay since validity (s), and values."""

    values: MeasurementStatistics
    seen_ns: deque[int] = field(default_factory=lambda: deque(maxlen=KEPT))
    age_s: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    count: int = 0

    @property
    def rate_hz(self) -> float | None:
        """Mean rate (Hz) between the first and the last remembered arrival; None for a burst."""
        span_s = (self.seen_ns[-1] - self.seen_ns[0]) * 1e-9
        return (len(self.seen_ns) - 1) / span_s if span_s > BURST_S else None


class ObservedSource:
    """One source under observation."""

    def __init__(self, name: str, driver_name: str, options: Any, clock: Clock) -> None:
        self.name = name
        self.driver_name = driver_name
        self.options = options
        self._clock = clock
        make = driver_entry_points()[driver_name].load()
        self.driver: Driver = make(name, options, self._emit, clock.now_ns)
        self.kinds: dict[str, Arrivals] = {}
        self.imu: deque[tuple[float, ...]] = deque(maxlen=KEPT)
        self.events: list[str] = []

    def _emit(self, item: Emitted) -> None:
        if isinstance(item, DeviceEvent):
            self.events.append(f"{item.code}: {item.text}")
            return
        if isinstance(item, Mail):
            return  # whom it is for will have it from the daemon; its counters are told
        kind = self.kinds.setdefault(
            type(item).__name__, Arrivals(MeasurementStatistics(type(item)))
        )
        kind.count += 1
        kind.values.add(item)
        kind.seen_ns.append(item.t_seen_ns)
        if isinstance(item, TimeReport):
            self._clock.report(item)
            return
        if isinstance(item, NavigationMessage):
            return  # they have no instant
        instant = self._clock.resolve(item.stamp, item.source, item.t_seen_ns)
        kind.age_s.append((item.t_seen_ns - instant.t_valid_ns) * 1e-9)
        if isinstance(item, ImuSample):
            self.imu.append((*item.gyro_rad_s, *item.accel_m_s2))


@dataclass(slots=True)
class Report:
    """Report of one device or service: its headline, facts, and findings."""

    title: str
    facts: list[str] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)


def doctor(config: Config, seconds: float, transmit: bool = False) -> int:
    """Listen for `seconds`, print the report and return the exit status: 0 without findings, else
    1.

    With `transmit` it also requests fixes from an RDSS terminal.
    """
    return asyncio.run(examine(config, seconds, sys.stdout, transmit))


async def examine(config: Config, seconds: float, out: TextIO, transmit: bool = False) -> int:
    """Listen to all sources at once, write a report of each to `out` and return the exit status."""
    clock = Clock(config.clock)
    sources: list[ObservedSource] = []
    for name, section in config.sources.items():
        options = driver_entry_points()[section.driver].load().Options(**section.options)
        if not transmit and "transmit" in type(options).model_fields:
            options = options.model_copy(update={"transmit": False})
        sources.append(ObservedSource(name, section.driver, options, clock))
    broker = asyncio.create_task(_broker(config))
    tasks = [asyncio.create_task(s.driver.run(), name=s.name) for s in sources]
    await asyncio.sleep(seconds)
    # Judged while the ports are open: closing them changes the states.
    reports = [_source(s, t, config, seconds) for s, t in zip(sources, tasks, strict=True)]
    reports.append(_clock(clock, config))
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    reports.append(await broker)
    if not sources:
        reports.insert(0, Report("sources", findings=[finding("no_sources")]))

    for report in reports:
        print(report.title, file=out)
        for fact in report.facts:
            print(f"    {fact}", file=out)
        for line in report.findings:
            print(f"  ! {line}", file=out)
    found = sum(len(report.findings) for report in reports)
    print(f"{found} finding{'s' * (found > 1)}" if found else "No findings", file=out)
    return 1 if found else 0


# --------------------------------------------------------------------------- a source


def _source(
    observed: ObservedSource, task: asyncio.Task[None], config: Config, seconds: float
) -> Report:
    status = observed.driver.status
    device = device_name(observed.options)
    title = f"{observed.name}: {observed.driver_name} on {device}: {status.state}"
    report = Report(title + (f" ({status.detail})" if status.detail else ""))
    for name, kind in observed.kinds.items():
        report.facts.append(_kind_line(name, kind))
        report.facts += [f"  {line}" for line in kind.values.lines()]
    report.facts += list(dict.fromkeys(observed.events))[-_SHOWN_EVENTS:]
    beams: BeamPower | None = getattr(observed.driver, "beams", None)
    if beams is not None:
        report.facts.append(_beams_line(beams))
    counters = {name: count for name, count in observed.driver.counters.items() if count}
    if counters:
        report.facts.append(", ".join(f"{name} {count}" for name, count in counters.items()))
    if task.done() and not task.cancelled():
        report.findings.append(finding("driver_ended", error=repr(task.exception())))
    report.findings += open_findings(observed.name, observed.driver, observed.options, seconds)
    report.findings += _damage(observed.driver.counters, report.findings)
    report.findings += getattr(observed.driver, "cautions", {}).values()
    if "ImuSample" in observed.kinds:
        _imu(observed, config, report)
    elif "PositionFix" in observed.kinds:
        oldest = max(observed.kinds["PositionFix"].age_s)
        if oldest > OLD_FIX_S:
            report.findings.append(finding("fixes_old", age=oldest))
    elif status.state == "running" and not status.detail:
        cause = getattr(observed.driver, "cause", "")
        if cause:
            report.findings.append(cause)
    return report


def _kind_line(name: str, kind: Arrivals) -> str:
    rate = "" if kind.rate_hz is None else f", {kind.rate_hz:.2f} Hz"
    age = ""
    if kind.age_s:
        ages = np.array(kind.age_s) * 1e3
        age = f", age {np.median(ages):.1f} ms (at most {ages.max():.1f})"
    return f"{name}: {kind.count}{rate}{age}"


def _beams_line(beams: BeamPower) -> str:
    """Describe the power of an RDSS terminal's beams, and which are usable."""
    levels = " ".join(map(str, beams.levels))
    serving = beams.serving
    if serving is None:
        return f"beams {levels}: none is heard"
    second = beams.time_difference_beam
    return f"beams {levels}: beam {serving} serves" + (f", with beam {second}" if second else "")


def _damage(counters: Counter[str], said: list[str]) -> list[str]:
    """Findings on damaged or missing data beyond the normal rate, without those already `said`."""
    findings = []
    lost, samples = counters["lost_samples"], counters["samples"]
    if lost > DAMAGED_SHARE * max(1, samples):
        findings.append(finding("samples_lost", lost=lost, all=samples + lost))
    if counters["error_frames"]:
        findings.append(finding("bus_errors", count=counters["error_frames"]))
    bad = counters["checksum_bad"] + counters["bad_checksum"]
    good = counters["sentences"] + counters["frames"]
    if bad > max(1, DAMAGED_SHARE * good) and not any(_CHECKSUMS in one for one in said):
        findings.append(finding("checksums", bad=bad, good=good))
    overflow = counters["socket_overflow"] + counters["ring_overflow"] + counters["error_overflow"]
    if overflow:
        findings.append(finding("bus_overflow", count=overflow))
    return findings


def _imu(observed: ObservedSource, config: Config, report: Report) -> None:
    """Findings on an IMU: its rate and, at rest, gravity, axes and turn rate."""
    rate = observed.kinds["ImuSample"].rate_hz
    wanted = config.imu.rate_hz
    if rate is not None and abs(rate - wanted) > RATE_TOLERANCE * wanted:
        report.findings.append(finding("imu_rate", seen=rate, set=wanted))
    values = np.array(observed.imu)
    mean = values.mean(axis=0)
    limits = quiet_limits(config.constraints.zero_velocity, imu_noise(config.imu))
    sd = values.std(axis=0)
    force = float(np.linalg.norm(mean[3:]))
    turn = float(np.degrees(np.linalg.norm(mean[:3])))
    # A wrong unit makes the noise larger too.
    quiet_force = limits.force_sd * max(1.0, force / STANDARD_GRAVITY_M_S2)
    if sd[:3].max() > limits.rate_sd or sd[3:].max() > quiet_force:
        report.facts.append("not at rest: gravity and axes not judged; repeat at rest")
        return
    body = sensor_to_body(config.imu) @ mean[3:]
    tilt = float(np.degrees(np.arccos(np.clip(-body[2] / max(force, 1e-9), -1.0, 1.0))))
    report.facts.append(
        f"at rest: specific force {force:.3f} m/s2, {tilt:.1f} deg from up; rate {turn:.3f} deg/s"
    )
    if abs(force / STANDARD_GRAVITY_M_S2 - 1.0) > GRAVITY_TOLERANCE:
        gravity = STANDARD_GRAVITY_M_S2
        report.findings.append(
            finding("imu_force", force=force, gravity=gravity, name=observed.name)
        )
    elif tilt > MAX_TILT_DEG:
        up = int(np.argmax(np.abs(mean[3:])))
        down = ("-" if mean[3 + up] > 0.0 else "+") + "xyz"[up]
        now = config.imu.axes[2]
        report.findings.append(finding("imu_axes", tilt=tilt, down=down, axes=now))
    if turn > np.degrees(limits.mean_rate):
        report.findings.append(finding("imu_turns", rate=turn, name=observed.name))


# --------------------------------------------------------------------------- clock and broker


def _clock(clock: Clock, config: Config) -> Report:
    status = clock.status()
    report = Report(f"clock: UTC from {status.utc_source}")
    if status.system_error_s is not None:
        error = status.system_error_s
        report.facts.append(f"system clock minus GNSS: {error:+.3f} s")
        rollovers = round(error / ROLLOVER_S)
        if rollovers and abs(error - rollovers * ROLLOVER_S) < DAY_S:
            report.findings.append(finding("week_rollover", weeks=-rollovers * 1024))
        elif abs(error) > SYSTEM_CLOCK_S:
            report.findings.append(finding("system_clock", error=error))
    elif status.utc_source == "none":
        report.findings.append(finding("no_utc"))
    elif config.clock.utc == "gnss":
        report.facts.append("no receiver has sent the time: the system clock is used")
    return report


async def _broker(config: Config) -> Report:
    """Connect to the broker as the daemon would, under another client name so that the daemon stays
    connected."""
    m = config.mqtt
    if not m.enabled:
        return Report("mqtt: not enabled")
    where = f"{m.host}:{m.port}"
    report = Report(f"mqtt: {where}")
    try:
        client = aiomqtt.Client(
            m.host,
            m.port,
            username=m.username,
            password=broker_access.password(m),
            identifier=f"fusiond-{config.vehicle}-doctor",
            timeout=_BROKER_S,
            tls_context=broker_access.tls_context(m),
        )
        async with asyncio.timeout(_BROKER_S + 1.0), client:
            report.facts.append("connected")
    except ConfigError as error:
        report.findings.append(str(error))
    except (aiomqtt.MqttError, TimeoutError) as error:
        failed = error if isinstance(error, aiomqtt.MqttError) else aiomqtt.MqttError("no answer")
        report.findings.append(broker_access.advice(failed, m.host, m.port))
    return report
