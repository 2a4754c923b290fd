"""Run of the daemon's drivers over a recorded CAN bus: `fusiond process --can LOG`.

The configured drivers get the frames, and the daemon's own `Clock` their stamps, with the log as
host time: the recorder's stamp of a frame is its arrival, and the recorder's clock is the system
clock, which may be set (fusiond.clock.recorder_clock). Times are those of the log, POSIX seconds if
the recorder knew the date; if its clock was set, those of the clock at the end.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivers.base import Emit, Emitted
from drivers.can.base_driver import CanDriver
from drivers.can.imu import CanImuDriver
from drivers.measurements import (
    DeviceEvent,
    ImuSample,
    MonotonicStamp,
    TimeReport,
    UtcStamp,
)
from drivers.raw.messages import (
    Bdgim,
    Correction,
    Ephemeris,
    Klobuchar,
    RawGnssEpoch,
    SignalDelays,
)
from drivers.rdss.mail import FleetFix, MessageReceived, MessageStage
from fusiond.clock.recorder_clock import FOLLOWING, RecorderClock, Slew
from fusiond.clock.stamp_mapping import Clock
from fusiond.clock.utc_from_arrivals import plausible_date
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.schema import Config
from fusiond.files.csv_tables import Rejection, TableError, rejections_from_counts
from fusiond.files.measurement_csv import ImuTable
from fusiond.offline.can_log_reader import Refusals, channels, messages
from fusiond.offline.can_utc_reports import Ahead, Reports, frame
from fusiond.offline.measurement_files import Arrival

OFF_S = 1.0
"""Offset of a recorder's clock beyond which it is reported; receivers report UTC up to a second
late."""
PAUSE_NS = 60_000_000_000
"""Shortest reported pause; no awake bus is silent for so long, and the solution shows shorter ones.
"""
REFUSALS = {
    "wrong_length",
    "undecodable",
    "not_finite",
    "out_of_range",
    "not_valid",
    "no_fix",
    "bad_date",
    "no_steering",
    "unpaired",
    "refused",
    "several_frames",
    "time_backward",
}
"""Counters of frames for a driver that gave no measurement."""


class CanLog(NamedTuple):
    """Contents of a log: IMU samples with their refusals, measurements with their arrivals,
    refusals of frames (`can`) and by source of a measurement; `events` (code, text); number of
    `frames`.

    With a spare in the configuration `units` are the samples of all units with their instants (ns),
    in order of arrival, and `imu` those of the first alone."""

    imu: ImuTable
    arrivals: list[Arrival]
    rejected: dict[str, list[Rejection]]
    events: list[tuple[str, str]]
    frames: int
    units: list[tuple[int, ImuSample]]


class _LogTime:
    """Host with the log's clocks: real time is the recorder's stamp of the frame without slews;
    monotonic and boot time are the same without the steps of the recorder's clock."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.stamp_ns = 0

    def monotonic_ns(self) -> int:
        return self.t_ns

    boottime_ns = slewed_ns = monotonic_ns

    def realtime_ns(self) -> int:
        return self.stamp_ns


def read_can_log(path: Path, config: Config) -> CanLog:
    """Read the log by the configured drivers; twice if its reports of UTC show that the recorder's
    clock was slewed. Raises `TableError`."""
    once = _Replay(path, config)
    log = once.read()
    source, slews = once.reports.slews(config.clock.max_clock_drift_ppm)
    if not slews:
        return log
    again = _Replay(path, config, slews)
    again.report_slews(source, slews)
    return again.read()


class _Replay:
    """Drivers and clock of one reading, with their results."""

    def __init__(self, path: Path, config: Config, slews: tuple[Slew, ...] = ()) -> None:
        self._path = path
        self._config = config
        self._host = _LogTime()
        self._recorder = RecorderClock(slews)
        self._clock = Clock(config.clock, self._host)
        self._events: list[tuple[str, str]] = []
        self._clock.on_event = self._on_clock_event
        self._arrivals: list[Arrival] = []
        self._imu: list[tuple[int, ImuSample]] = []
        self.reports = Reports(self._recorder, self._scouts)
        self._sources = _on_a_bus(config)
        self._drivers = self._make_drivers(self._emit)
        self._on_buses: dict[Any, list[CanDriver[Any]]] = {}
        if not self._drivers:
            raise TableError(f"{path}: the configuration has no source on a CAN bus")

    def _make_drivers(self, emit: Emit) -> dict[str, CanDriver[Any]]:
        now_ns = self._host.monotonic_ns
        return {name: make(name, o, emit, now_ns) for name, (make, o) in self._sources.items()}

    def read(self) -> CanLog:
        """Read the log to its end."""
        self._on_buses = buses = self._buses()
        refusals, refused = Refusals(), Counter[str]()
        recorder, host = self._recorder, self._host
        frames = Ahead(messages(self._path, refusals, self._on_refusal), refused)
        for message, stamp_ns in frames:
            if message.channel not in buses:
                refused["unknown_channel"] += 1
                continue
            of = message.channel, message.arbitration_id
            if recorder.is_odd(stamp_ns, of):
                before_ns, steps = recorder.stamp_ns, len(recorder.steps)
                following = [ns for _, ns in frames.ahead(FOLLOWING)]
                set_off = partial(self.reports.set_before, frames, message, stamp_ns)
                verdict = recorder.take(stamp_ns, of, following, set_off)
                if verdict != "taken":
                    refused[verdict] += 1
                    continue
                if len(recorder.steps) > steps:
                    self.reports.follow(recorder.steps[-1].set_ns)
                elif self._arrivals:
                    self._report_pause(stamp_ns - before_ns)
            else:
                recorder.next(stamp_ns, of)
            host.t_ns, host.stamp_ns = recorder.t_ns, recorder.stamp_ns - recorder.slewed_ns
            came = frame(message, host.t_ns, stamp_ns - recorder.slewed_ns)
            for driver in buses[message.channel]:
                driver.feed(came)
        refusals.count(refused)
        self._report_error()
        self._shift()
        rejected, imu = {"can": refusals.all()}, self._imu_table()
        for name, driver in self._drivers.items():
            odd = rejections_from_counts(
                {n: c for n, c in driver.counters.items() if n in REFUSALS}
            )
            if isinstance(driver, CanImuDriver):
                imu.rejected.extend(odd)
            else:
                rejected[name] = odd
        units = self._imu if self._config.imu.spare is not None else []
        return CanLog(imu, self._arrivals, rejected, self._events, frames.number, units)

    def _buses(self) -> dict[Any, list[CanDriver[Any]]]:
        """Drivers that get the frames of each channel of the log.

        All drivers share the only channel of a log. Of several channels a source has the one with
        its channel's name, or number N for `canN`.
        """
        there = sorted(channels(self._path), key=str)
        if not there:
            raise TableError(f"{self._path}: no CAN frame")
        if len(there) == 1:
            return {there[0]: list(self._drivers.values())}
        buses: dict[Any, list[CanDriver[Any]]] = {channel: [] for channel in there}
        for name, driver in self._drivers.items():
            wanted = driver.options.channel
            mine = [c for c in there if wanted in (str(c), f"can{c}")]
            if not mine:
                raise TableError(
                    f"{self._path}: there are the channels {', '.join(map(str, there))}, and none "
                    f"is {wanted} of [sources.{name}]"
                )
            buses[mine[0]].append(driver)
        return buses

    def _scouts(self, emit: Emit) -> dict[Any, list[CanDriver[Any]]]:
        """Second set of drivers, to read ahead."""
        scouts = self._make_drivers(emit)
        names = {id(driver): name for name, driver in self._drivers.items()}
        return {
            channel: [scouts[names[id(driver)]] for driver in drivers]
            for channel, drivers in self._on_buses.items()
        }

    # ------------------------------------------------------------------ the recorder's clock

    def _on_refusal(self, code: str, text: str) -> None:
        self._events.append((code, text))

    def _on_clock_event(self, code: str, text: str) -> None:
        self._on_refusal(code, f"{text}, at {self._recorder.stamp_ns * 1e-9:.3f} s of the log")

    def report_slews(self, source: str, slews: tuple[Slew, ...]) -> None:
        """Report rate and time of the slews of the recorder's clock."""
        largest = max(slews, key=lambda slew: abs(slew.rate))
        how = "fast" if largest.rate > 0.0 else "slow"
        times = f"in {len(slews)} stretches, at most " if len(slews) > 1 else ""
        self._on_refusal(
            "recorder_clock_slewed",
            f"the recorder's clock ran {times}{abs(largest.rate):.2%} too {how} from "
            f"{largest.begin_ns * 1e-9:.3f} s of the log on: time is {source}'s there",
        )

    def _report_pause(self, passed_ns: int) -> None:
        """Report a pause, which cannot be distinguished from a step of the clock if no device
        reports UTC."""
        if passed_ns > PAUSE_NS:
            text = f"no frame for {passed_ns * 1e-9:.0f} s by the recorder's clock"
            if not self.reports:
                text += ": a pause, or its clock was set, of which no device tells UTC"
            self._on_refusal("recorder_paused", text)

    def _report_error(self) -> None:
        """Report the final offset of a dated recorder from a receiver's UTC, such as a wrong time
        zone."""
        status = self._clock.status()
        off_s = (status.system_error_s or 0.0) + self._recorder.slewed_ns * 1e-9
        if abs(off_s) >= OFF_S and plausible_date(self._host.stamp_ns):
            how = f"by {off_s:+.1f} s from the UTC of {status.utc_source}"
            self._on_refusal("recorder_clock_off", f"the recorder's clock is off {how}")

    def _shift(self) -> None:
        """Convert times to the recorder's clock at the end."""
        if not (by_ns := self._recorder.ahead_ns):
            return
        self._imu = [
            (t_ns + by_ns, replace(m, t_seen_ns=m.t_seen_ns + by_ns)) for t_ns, m in self._imu
        ]
        self._arrivals = [_later(arrival, by_ns) for arrival in self._arrivals]

    # ------------------------------------------------------------------ results of drivers

    def _emit(self, item: Emitted) -> None:
        """Emit an item as `fusiond.live.sources` does, at the instant of the frame."""
        match item:
            case DeviceEvent():
                self._on_refusal(item.code, f"{item.source}: {item.text}")
            case TimeReport():
                if item.trusted:
                    self.reports.add(item, self._host.stamp_ns)
                self._clock.report(item)
            case (
                Ephemeris() | Klobuchar() | Bdgim() | SignalDelays() | Correction() | RawGnssEpoch()
            ):
                raise AssertionError("no driver on a CAN bus has raw observations")
            case MessageReceived() | MessageStage() | FleetFix():
                raise AssertionError("no driver on a CAN bus has short messages")
            case _:
                instant = self._clock.resolve(item.stamp, item.source, item.t_seen_ns)
                if isinstance(item, ImuSample):
                    self._imu.append((instant.t_valid_ns, item))
                    return
                utc_ns = item.stamp.utc_ns if isinstance(item.stamp, UtcStamp) else None
                held = replace(item, stamp=MonotonicStamp(instant.t_valid_ns))
                self._arrivals.append(Arrival(item.t_seen_ns, held, instant.sd_s, utc_ns))

    def _imu_table(self) -> ImuTable:
        """IMU samples of the first source that sends any, as in the daemon."""
        spare = self._config.imu.spare
        spare_name = None if spare is None else spare.source
        first = next((m.source for _, m in self._imu if m.source != spare_name), spare_name)
        kept = [(t_ns, m) for t_ns, m in self._imu if m.source == first]
        rejected = []
        if others := sum(m.source not in (first, spare_name) for _, m in self._imu):
            rejected.append(Rejection(0, "second_imu", f"{others} samples", others))
        times = np.array([t_ns for t_ns, _ in kept], dtype=np.int64)
        samples = [(*m.gyro_rad_s, *m.accel_m_s2) for _, m in kept]
        t_s = times.astype(np.float64) * 1e-9
        return ImuTable(t_s, np.array(samples, dtype=np.float64).reshape(-1, 6), rejected)


def _on_a_bus(config: Config) -> dict[str, tuple[Any, Any]]:
    """Class and options of each driver of a source on a CAN bus."""
    points = driver_entry_points()
    made = ((name, points[s.driver].load(), s.options) for name, s in config.sources.items())
    return {n: (make, make.Options(**o)) for n, make, o in made if issubclass(make, CanDriver)}


def _later(arrival: Arrival, by_ns: int) -> Arrival:
    """Shift all times of an arrival by `by_ns`."""
    m: Any = arrival.measurement
    seen_ns = m.t_seen_ns + by_ns
    moved = replace(m, t_seen_ns=seen_ns, stamp=MonotonicStamp(m.stamp.t_ns + by_ns))
    return arrival._replace(t_arrival_ns=arrival.t_arrival_ns + by_ns, measurement=moved)
