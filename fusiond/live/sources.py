"""Devices of the daemon: one supervised task for each driver, and their `health`.

A driver's exception restarts that driver, never the daemon. This module processes the drivers'
output: it resolves stamps to instants, stores IMU samples for the next tick, and passes time
reports to the clock.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from functools import partial
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import Driver, Emitted
from drivers.external_inputs import Inputs
from drivers.measurements import DeviceEvent, Height, ImuSample, Measurement, TimeReport
from drivers.raw.messages import NavigationMessage, RawGnssEpoch
from drivers.rdss.mail import Mail
from drivers.standard_atmosphere import standard_pressure_pa
from fusiond.clock.results import Instant
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.aiding import RdssAiding
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.live.injection import Injection
from fusiond.live.supervision import supervise
from fusiond.navigator.imu_choice import ImuChoice
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.raw_sky import Seen
from fusiond.navigator.source_status import worst
from fusiond.outputs.messages.fault import FaultReport, fault_report
from fusiond.outputs.messages.health import BeamHealth, SatelliteHealth, SkyHealth, SourceHealth

POLLED_HZ = 50.0
"""Least tick rate by which the buses are read: of a full 500 kbit/s bus 80 frames wait for such a
tick, and a socket of Linux's default size holds 277."""

Array = NDArray[np.float64]
EventSink = Callable[[str, str, str], None]


class Source:
    """Device: its driver and the outcomes of its measurements."""

    def __init__(self, name: str, driver: Any) -> None:
        self.name = name
        self.driver: Driver = driver
        self.received = 0
        self.faults = 0
        self.last_seen_ns: int | None = None
        self.latency_s: float | None = None


class Sources:
    """Devices of a configuration. `on_event(source, code, text)` receives their reports."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        navigator: Navigator,
        injection: Injection,
        on_event: EventSink,
    ) -> None:
        self._config = config
        self._injection = injection
        self._clock = clock
        self._navigator = navigator
        self._on_event = on_event
        clock.on_event = lambda code, text: on_event("clock", code, text)
        self.imu = ImuChoice(config.imu, on_event)
        self.on_arrival: Callable[[Measurement | RawGnssEpoch, Instant], None] | None = None
        """Callback with every measurement and its instant."""
        self.on_mail: Callable[[Mail], None] = lambda mail: None
        """Callback with short messages."""
        self.measured = False
        """True if a measurement that is no IMU sample has come since it was last set to False."""
        self.behind = False
        """True if a tick has left its samples to a later one."""
        self.all: dict[str, Source] = {}
        self._polls: list[Callable[[], None]] = []
        points = driver_entry_points()
        for name, section in config.sources.items():
            make = points[section.driver].load()
            driver = make(name, make.Options(**section.options), self._emit, clock.now_ns)
            self.all[name] = Source(name, driver)
            begin = getattr(driver, "poll_from_now_on", None)
            if begin is not None and config.scheduler.rate_hz >= POLLED_HZ:
                self._polls.append(begin())

    async def run(self) -> None:
        """Serve every device until cancelled."""
        async with asyncio.TaskGroup() as group:
            for source in self.all.values():
                name = f"driver {source.name}"
                serve = supervise(name, source.driver.run, partial(self._fell, source))
                group.create_task(serve, name=name)

    def _fell(self, source: Source, text: str) -> None:
        source.faults += 1
        self._on_event(source.name, "driver_fault", text)

    # ------------------------------------------------------------------ arrivals

    def _emit(self, item: Emitted) -> None:
        if not self._injection.faults:
            self._receive(item)
            return
        for left in self._injection.pass_on(item):
            self._receive(left)

    def poll(self) -> None:
        """Read the CAN buses before a tick, so that their frames never wake the process between
        ticks."""
        for poll in self._polls:
            poll()

    def release(self, t_ns: int) -> None:
        """Accept measurements of an injected delay that are due by the tick at `t_ns`."""
        for item in self._injection.tick(t_ns):
            self._receive(item)

    def _receive(self, item: Emitted) -> None:
        if not isinstance(item, ImuSample):  # the most frequent, so tested first
            if isinstance(item, DeviceEvent):
                self._on_event(item.source, item.code, item.text)
                return
            if isinstance(item, TimeReport):
                self._clock.report(item)
                return
            if isinstance(item, NavigationMessage):
                self._navigator.learn(item)
                return
            if isinstance(item, Mail):
                self.on_mail(item)
                return
        source = self.all[item.source]
        source.received += 1
        source.last_seen_ns = item.t_seen_ns
        instant = self._clock.resolve(item.stamp, item.source, item.t_seen_ns)
        source.latency_s = (item.t_seen_ns - instant.t_valid_ns) * 1e-9
        if self.on_arrival is not None:
            self.on_arrival(item, instant)
        if isinstance(item, Height) and item.barometric:
            self._pressure_hint(item)
        if isinstance(item, ImuSample):
            self.imu.take(item, instant.t_valid_ns)
            return
        self.measured = True
        self.catch_up()
        self._navigator.add(item, instant.t_valid_ns, instant.sd_s, item.t_seen_ns)

    def take_imu(self, t_ns: int) -> tuple[NDArray[np.int64], Array] | None:
        """Samples since the last call, (m,) ns and (m, 6); None without any. A change to the spare
        is reported to the navigator first."""
        navigator = self._navigator
        if self.imu.changes(t_ns, navigator.imu.latest_ns if navigator.imu.end else None):
            navigator.change_imu()
        return self.imu.samples()

    def catch_up(self) -> None:
        """Hand over the samples that earlier ticks left, before any other input."""
        if self.behind:
            self.behind = False
            if (left := self.imu.samples()) is not None:
                self._navigator.add_imu(*left)

    # ------------------------------------------------------------------ state

    @property
    def all_running(self) -> bool:
        """True if every device sends."""
        return all(s.driver.status.state == "running" for s in self.all.values())

    @property
    def inputs(self) -> dict[str, Inputs]:
        """External inputs by driver; drivers without `inputs` are left out."""
        found = {name: getattr(s.driver, "inputs", None) for name, s in self.all.items()}
        return {name: inputs for name, inputs in found.items() if inputs is not None}

    def height_hint(self, height_m: float, sd_m: float, t_ns: int) -> None:
        """Send the solution's antenna height to the terminals that use it.

        Only the upward part of the lever arm is used: tilt moves a roof antenna by centimetres.
        """
        for name, source in self.all.items():
            hint = getattr(source.driver, "height_hint", None)
            if hint is not None:
                section = self._config.aiding.get(name)
                down = section.lever_arm_m[2] if section is not None else 0.0
                centre_sd_m = section.height_sd_m if isinstance(section, RdssAiding) else None
                hint(height_m - down, sd_m, t_ns, centre_sd_m)

    def _pressure_hint(self, barometer: Height) -> None:
        """Send the pressure of a barometer's height to the terminals that use it."""
        for source in self.all.values():
            hint = getattr(source.driver, "pressure_hint", None)
            if hint is not None:
                hint(standard_pressure_pa(barometer.height_m), barometer.t_seen_ns)

    def request_fix(self, t_ns: int) -> list[str]:
        """Request a fix of every terminal and return their replies; empty without a terminal."""
        asks = (getattr(s.driver, "request_now", None) for s in self.all.values())
        return [ask(t_ns) for ask in asks if ask is not None]

    def faults(self, now_ns: int) -> tuple[FaultReport, ...]:
        """Faults of the vehicle, the latest last. Faults of the IMU have the name of the unit in
        use."""
        return tuple(
            fault_report(f.finding, f.finding.kind.device or self.imu.used or "imu", now_ns)
            for f in self._navigator.service.faults(now_ns)
        )

    def _diagnosed(self, now_ns: int) -> Callable[[str], dict[str, Any]]:
        """Lookup of a source's service states and latest fault for `health`."""
        service = self._navigator.service
        pairs = list(zip(service.faults(now_ns), self.faults(now_ns), strict=True))

        def of(name: str) -> dict[str, Any]:
            states = service.states(name)
            faults = [said for f, said in pairs if said.source == name or name in f.series]
            return {
                "service": worst(states.values()),
                "series": states,
                "isolated": service.reason(name),
                "diagnosis": faults[-1] if faults else None,
            }

        return of

    def health(self, now_ns: int) -> dict[str, SourceHealth]:
        """`health` by source; each of the filter's own measurements (`zero_velocity`) has an entry,
        too."""
        navigator = self._navigator
        outcomes = navigator.outcomes()
        diagnosed = self._diagnosed(now_ns)
        health: dict[str, SourceHealth] = {}
        for name in dict.fromkeys((*self.all, *outcomes, *navigator.outcome_watch.refused)):
            ended = outcomes.get(name, Counter())
            rejected = {n: c for n, c in ended.items() if n != "fused" and c > 0}
            for reason, count in navigator.outcome_watch.refused.get(name, Counter()).items():
                rejected[reason] = rejected.get(reason, 0) + count
            fused_ns = navigator.outcome_watch.fused_ns.get(name)
            fused_age = None if fused_ns is None else round((now_ns - fused_ns) * 1e-9, 3)
            source = self.all.get(name)
            if source is None:
                health[name] = SourceHealth(
                    state="running",
                    detail="made by the filter or part of another source",
                    received=ended.total(),
                    fused=ended["fused"],
                    rejected=rejected,
                    fused_age_s=fused_age,
                    **diagnosed(name),
                    verdict=navigator.verdicts.verdict(name),
                )
                continue
            counters = {k: int(v) for k, v in source.driver.counters.items() if v}
            if name in navigator.raw:
                counters |= dict(navigator.raw[name].refused)
            fused = ended["fused"]
            if name == self.imu.used:
                counters |= {k: int(v) for k, v in self.imu.counters.items() if v}
                rejected |= {k: int(v) for k, v in navigator.imu.counters.items() if v}
                gaps = rejected.pop("gap", 0)
                counters["gap"] = gaps
                fused = navigator.imu.next_sample
                if navigator.imu.end:
                    fused_age = round((now_ns - navigator.imu.latest_ns) * 1e-9, 3)
            if source.faults:
                counters["driver_fault"] = source.faults
            seen = source.last_seen_ns
            health[name] = SourceHealth(
                state=source.driver.status.state,
                detail=source.driver.status.detail,
                received=source.received,
                fused=fused,
                rejected=rejected,
                age_s=None if seen is None else round((now_ns - seen) * 1e-9, 3),
                fused_age_s=fused_age,
                latency_s=None if source.latency_s is None else round(source.latency_s, 4),
                counters=counters,
                **diagnosed(name),
                verdict=navigator.verdicts.verdict(name),
                sky=self._sky(name),
                beams=_beams(source.driver),
            )
        return health

    def _sky(self, name: str) -> SkyHealth | None:
        receiver = self._navigator.raw.get(name)
        if receiver is None:
            return None
        sky = receiver.sky()
        figures: dict[str, float | None] = {"innovation_rms": sky.innovation_rms}
        if sky.dops is not None:
            figures |= sky.dops._asdict()
        rounded = {k: None if v is None else round(v, 2) for k, v in figures.items()}
        satellites = {name: _satellite(seen) for name, seen in sky.seen.items()}
        return SkyHealth(used=sky.used, refused=sky.refused, satellites=satellites, **rounded)


def _beams(driver: Driver) -> BeamHealth | None:
    said = getattr(driver, "beams", None)
    if said is None:
        return None
    difference = said.time_difference_beam or None
    return BeamHealth(levels=said.levels, serving=said.serving, time_difference=difference)


def _satellite(seen: Seen) -> SatelliteHealth:
    azimuth, elevation, cno = seen
    return SatelliteHealth(
        azimuth_deg=None if azimuth is None else round(degrees(azimuth) % 360.0, 1),
        elevation_deg=None if elevation is None else round(degrees(elevation), 1),
        cno_db_hz=cno,
    )
