"""Row of the matrix: a drive, its fault, the navigator and its output.

The navigator is fed as in the daemon: at each tick the samples that have arrived, then the
measurements in order of arrival; then the filter runs up to the last sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import ImuSample, MonotonicStamp
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode, Solution
from fusiond.navigator.imu_choice import ImuChoice
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import States, Truth, metres_to_geodetic
from fusiond.studies.faults.error_sigma_score import Course, Event, Sample, axis_ratio, row_figures
from fusiond.studies.faults.library import (
    FAULTS,
    PHASES,
    Fault,
    PhaseName,
    with_second,
    with_spare,
    with_wheels,
)
from fusiond.studies.faults.random_drives import drive_of_number
from fusiond.studies.faults.sensor_data import DURATION_S, Drive, Recording, town

Array = NDArray[np.float64]

TICKS_PER_S = 10
"""The `nav_rate_hz` of `config/vehicle.toml`."""
ANTENNA_M = (0.0, 0.0, -1.0)
VEHICLE = Config.model_validate(
    {
        "imu": {
            "axes": ("+x", "-y", "-z"),
            "rate_hz": 100.0,
            "gyro_range_deg_s": 2000.0,
            "accel_range_g": 10.0,
            "gyro_noise_deg_sqrt_h": 0.3,
            "accel_noise_m_s_sqrt_h": 0.1,
            "gyro_bias_instability_deg_h": 10.0,
            "accel_bias_instability_mg": 0.1,
        },
        "aiding": {
            "gnss": {"lever_arm_m": ANTENNA_M, "range_error_m": 3.0, "bias_sd_m": 0.0},
            "rdss": {"lever_arm_m": ANTENNA_M},
        },
        "constraints": {"non_holonomic": {"enabled": True, "lever_arm_m": (-1.0, 0.0, 0.5)}},
        "estimator": {"model": "ins21"},
    }
)
"""Configuration `config/vehicle.toml` without its devices, which a test compares. Its fixes share
no error."""


@dataclass(frozen=True, slots=True)
class Row:
    """Row of the matrix: a fault in a phase."""

    fault: str
    phase: PhaseName


def rows(only: str | None = None, phase: PhaseName | None = None) -> list[Row]:
    """Rows of the matrix, or of a part of it."""
    return [
        Row(name, p)
        for name, fault in FAULTS.items()
        for p in fault.phases
        if only in (None, name) and phase in (None, p)
    ]


def run_row(row: Row, seed: int, drive: int | None = None) -> dict[str, Any]:
    """Run a row and return its figures, equal for equal seeds. `drive` is made by
    `on_random_drive`."""
    return {
        "fault": row.fault,
        "phase": row.phase,
        **run_fault(on_random_drive(FAULTS[row.fault], drive), row.phase, seed),
    }


def on_random_drive(fault: Fault, drive: int | None) -> Fault:
    """Fault on the drawn drive of that number instead of the town, if it can occur there."""
    if drive is None or fault.drive.path is not town:
        return fault
    own = fault.drive
    found = replace(
        drive_of_number(drive),
        wheels=own.wheels,
        spare=own.spare,
        second=own.second,
        places_alone=own.places_alone,
    )
    return replace(fault, drive=found)


def run_fault(fault: Fault, phase: PhaseName, seed: int) -> dict[str, Any]:
    """Run a fault in a phase and return its figures."""
    begin_s = fault.begins_s(phase)
    harmless = fault.alter is None and fault.configure is None
    end_s = begin_s if harmless else min(begin_s + fault.length_s, DURATION_S)
    reference = _unharmed(fault.drive, phase, seed)
    course = reference if harmless else run_course(fault, phase, seed)
    return {"begin_s": begin_s, "end_s": end_s, **row_figures(course, reference, begin_s, end_s)}


@lru_cache(maxsize=8)
def _unharmed(drive: Drive, phase: PhaseName, seed: int) -> Course:
    """Result of the same drive without a fault."""
    return run_course(Fault(drive=drive), phase, seed)


def run_course(fault: Fault, phase: PhaseName, seed: int) -> Course:
    """Result of a fault in a phase."""
    vehicle = with_wheels(VEHICLE) if fault.drive.wheels else VEHICLE
    if fault.drive.spare:
        vehicle = with_spare(vehicle)
    if fault.drive.second:
        vehicle = with_second(vehicle)
    truth, recording = fault.drive.recorded(vehicle, seed)
    outage = PHASES[phase].outage_s
    if outage is not None:
        recording = recording.withheld(*outage)
    if fault.alter is not None:
        recording = fault.alter(recording, fault.begins_s(phase), fault.length_s)
    config = vehicle if fault.configure is None else fault.configure(vehicle)
    return navigate(config, recording, truth)


def navigate(
    config: Config,
    recording: Recording,
    truth: Truth,
    watch: Callable[[Navigator], None] | None = None,
) -> Course:
    """Feed a navigator with a recording; compare it with the truth at every second, when `watch`
    may look at it."""
    # Of all seconds at once: one by one it takes as long as the navigation.
    track = truth.at(np.arange(1.0, truth.duration_s + 0.5))

    def look(solution: Solution, row: int) -> Sample:
        return error_sample(solution, track, row)

    return run_navigator(config, recording, truth.duration_s, look, watch)


def run_navigator(
    config: Config,
    recording: Recording,
    duration_s: float,
    look: Callable[[Solution, int], Sample],
    watch: Callable[[Navigator], None] | None = None,
    every_ticks: int = TICKS_PER_S,
) -> Course:
    """Feed a navigator with a recording and call `look` with its solution at intervals, by default
    each second, from row 0 on."""
    samples: list[Sample] = []
    events: list[Event] = []
    now_s = 0.0

    def receive(code: str, text: str) -> None:
        events.append(Event(now_s, code, text))

    navigator = Navigator(config, on_event=receive)
    units = _Units(config, recording, lambda source, code, text: receive(code, text))
    taken = 0
    received = recording.received
    for tick in range(1, round(duration_s * TICKS_PER_S) + 1):
        now_s = tick / TICKS_PER_S
        now_ns = round(now_s * 1e9)
        try:
            units.give(navigator, now_ns)
            while taken < len(received) and received[taken].seen_ns <= now_ns:
                item = received[taken]
                taken += 1
                navigator.add(item.measurement, item.t_ns, 0.0, item.seen_ns)
            navigator.advance()
            if tick % every_ticks == 0:
                samples.append(look(navigator.solution(now_ns), tick // every_ticks - 1))
                if watch is not None:
                    watch(navigator)
        except Exception as error:  # whatever leaves the navigator ends the daemon: a finding
            return Course(samples, events, f"{type(error).__name__} at {now_s:g} s: {error}")
    return Course(samples, events)


class _Units:
    """Source of a recording's samples, of the unit in use."""

    def __init__(
        self, config: Config, recording: Recording, on_event: Callable[[str, str, str], None]
    ) -> None:
        self._recording, self._given = recording, 0
        self._choice: ImuChoice | None = None
        spare, self._said = config.imu.spare, list[ImuSample]()
        if spare is not None and recording.spare is not None:
            self._choice = ImuChoice(config.imu, on_event)
            self._said = [*_said("imu", recording), *_said(spare.source, recording.spare)]
            self._said.sort(key=lambda sample: sample.t_seen_ns)

    def give(self, navigator: Navigator, now_ns: int) -> None:
        """Hand over the samples that have arrived."""
        if self._choice is None:
            r, given = self._recording, self._given
            self._given = end = int(np.searchsorted(r.imu_seen, now_ns, side="right"))
            if end > given:
                navigator.add_imu(r.stamps[given:end], r.samples[given:end])
            return
        while self._given < len(self._said) and self._said[self._given].t_seen_ns <= now_ns:
            sample = self._said[self._given]
            assert isinstance(sample.stamp, MonotonicStamp)
            self._choice.take(sample, sample.stamp.t_ns)
            self._given += 1
        if self._choice.changes(now_ns, navigator.imu.latest_ns if navigator.imu.end else None):
            navigator.change_imu()
        if (samples := self._choice.samples()) is not None:
            navigator.add_imu(*samples)


def _said(source: str, r: Recording) -> list[ImuSample]:
    rows = zip(r.imu_seen.tolist(), r.stamps.tolist(), r.samples.tolist(), strict=True)
    return [
        ImuSample(source, seen, MonotonicStamp(t), (x[0], x[1], x[2]), (x[3], x[4], x[5]))
        for seen, t, x in rows
    ]


def error_sample(
    solution: Solution, true: States, row: int = 0, true_sd: Sequence[float] = (0.0,) * 9
) -> Sample:
    """Compare a solution with that row of true states, known to `true_sd` (m, m/s, rad)."""
    t_s = solution.t_ns * 1e-9
    nothing = solution.mode is Mode.INVALID and math.isnan(solution.lat_rad)
    if nothing or solution.mode in (Mode.WAITING, Mode.ALIGNING):
        return Sample(t_s, str(solution.mode))
    v_ned, rpy = true.v_ned[row].tolist(), true.rpy[row].tolist()
    place = _position_error_m(solution, true.position[row])
    velocity = [v - w for v, w in zip(solution.v_ned_m_s, v_ned, strict=True)]
    turn = [_wrapped(a - b) for a, b in zip(solution.rpy_rad, rpy, strict=True)]
    stated = (*solution.sd_ned_m, *solution.sd_v_ned_m_s, *solution.sd_rpy_rad)
    sd = [math.hypot(a, b) for a, b in zip(stated, true_sd, strict=True)]
    ratios = (
        _ratio(place[:2], sd[:2]),
        _ratio(place[2:], sd[2:3]),
        _ratio(velocity[:2], sd[3:5]),
        _ratio(turn[2:], sd[8:]),
        _ratio(turn[:2], sd[6:8]),
    )
    horizontal_m = math.hypot(place[0], place[1])
    return Sample(t_s, str(solution.mode), ratios, horizontal_m, math.degrees(turn[2]))


def _ratio(errors: Sequence[float], sigmas: Sequence[float]) -> float:
    return max(axis_ratio(e, s) for e, s in zip(errors, sigmas, strict=True))


def _wrapped(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi]; NaN stays NaN."""
    return math.remainder(angle_rad, 2.0 * math.pi) if math.isfinite(angle_rad) else math.nan


def _position_error_m(solution: Solution, true: Array) -> list[float]:
    """Position error north, east, down (m) from the true latitude, longitude (rad) and height
    (m)."""
    unit = metres_to_geodetic(true[0:1], true[2:3], np.ones((1, 3)))[0]
    lat, lon, height = true.tolist()
    difference = (
        solution.lat_rad - lat,
        _wrapped(solution.lon_rad - lon),
        solution.height_m - height,
    )
    return [a / u for a, u in zip(difference, unit.tolist(), strict=True)]
