"""Faults put into recorded drives, with their real vibration, roads and errors.

A recorded drive has no true attitude and velocity. Its own fault-free smoothed solution, of all
measurements, stands for the truth, and errors are compared with the sigmas of both together:

    ratio = |x_fault - x_smoothed| / sqrt(sigma_fault^2 + sigma_smoothed^2)

If both were optimal, the variance of the difference would be P_fault - P_smoothed, since the
smoother uses all that the filter uses. So the ratio is too small, by little where the smoothed
sigma is much the smaller. An error that both share, such as a receiver's lasting one, remains
unseen.

Where a fault turns the unit in the vehicle its yaw is compared with that of either.

The recording is cut: a run begins `LEAD_S` before the instant of a fault, on the move or at rest as
it is, in phase `aligning` 5 s before it, and ends `AFTER_S` behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, Height, MonotonicStamp, PositionFix, WheelSpeed
from fusiond.configuration.aiding import GnssAiding
from fusiond.configuration.load import load_config
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.si_units import sensor_to_body
from fusiond.files.measurement_csv import TrajectoryTable, read_imu, read_solution
from fusiond.navigation.solution import Solution
from fusiond.offline.can_through_drivers import read_can_log
from fusiond.offline.measurement_files import READERS, Arrival, source_of
from fusiond.offline.process import process
from fusiond.simulation.imu_truth import States
from fusiond.studies.faults.error_sigma_score import QUANTITIES, Course, Sample, row_figures
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.library import Fault, PhaseName
from fusiond.studies.faults.runs import VEHICLE, error_sample, run_navigator
from fusiond.studies.faults.sensor_data import Received, Recording, town

Array = NDArray[np.float64]

LEAD_S = 120.0
AFTER_S = 130.0
OUTAGE_S = 20.0
"""Outage before and after the instant of a fault in phase `coasting`."""
ALIGNING_S = 5.0
FUSED = (PositionFix, WheelSpeed, DelayedFix, Height)
YAW = QUANTITIES.index("yaw")
KINDS = ("gnss", "wheel", "rdss", "barometer")
"""Tables of a folder that are used if present."""


@dataclass(frozen=True, slots=True)
class RecordedRow:
    """Fault in a phase at an instant of a recording, s from its first sample."""

    fault: str
    phase: PhaseName
    at_s: float


@dataclass(frozen=True, slots=True)
class Place:
    """Recording (a folder of tables or a CAN log) with its configuration and smoothed solution."""

    config: Path
    recording: Path
    smoothed: Path


def smooth(place: Place) -> None:
    """Write the smoothed solution that runs are compared with. Errors of fixes count as white:
    their shared part is in the runs as well, so that the difference does not show it."""
    config = load_config(place.config)
    gnss = config.aiding.get("gnss")
    if isinstance(gnss, GnssAiding):
        white = gnss.model_copy(update={"bias_sd_m": 0.0})
        config = config.model_copy(update={"aiding": {**config.aiding, "gnss": white}})
    if place.recording.is_dir():
        measurements, imu = _tables(place.recording), place.recording / "imu.csv"
        process(config, imu, measurements, out=place.smoothed, smooth=True)
    else:
        process(config, None, [], out=place.smoothed, can_log=place.recording, smooth=True)


def recorded_rows(
    place: Place, instants_s: Sequence[float], only: str | None, phase: PhaseName | None
) -> list[RecordedRow]:
    """Faults that this recording can have, at each instant."""
    _, recording = _read(place)
    wheels = any(isinstance(r.measurement, WheelSpeed) for r in recording.received)
    return [
        RecordedRow(name, p, at_s)
        for name, fault in EVERY.items()
        if only in (None, name) and fault.drive.path is town and not fault.drive.spare
        if not name.startswith("rdss") and (wheels or not fault.drive.wheels)
        for p in fault.phases
        if phase in (None, p)
        for at_s in instants_s
    ]


def run_recorded(row: RecordedRow, place: Place) -> dict[str, Any]:
    """Run a row and return its figures."""
    fault = EVERY[row.fault]
    part = _part(row, place)
    begin_s = part.lead_s
    if fault.begin_s == 0.0:
        begin_s = 0.0
    elif row.phase == "coasting" and not fault.of_imu:
        begin_s += OUTAGE_S
    reference = _unharmed(place, part)
    if fault.alter is None and fault.configure is None:
        course, end_s = reference, begin_s
    else:
        course = _run(place, part, fault, begin_s)
        end_s = min(begin_s + fault.length_s, part.duration_s)
    return {
        "fault": row.fault,
        "phase": row.phase,
        "at_s": row.at_s,
        "duration_s": part.duration_s,
        "begin_s": begin_s,
        "end_s": end_s,
        **row_figures(course, reference, begin_s, end_s),
    }


@dataclass(frozen=True, slots=True)
class _Part:
    """Part of a recording from `from_s` on; its fault starts after `lead_s`."""

    from_s: float
    lead_s: float
    duration_s: float
    coasting: bool


def _part(row: RecordedRow, place: Place) -> _Part:
    lead_s = min(row.at_s, ALIGNING_S if row.phase == "aligning" else LEAD_S)
    from_s = row.at_s - lead_s
    length_s = float(_read(place)[1].imu_seen[-1]) * 1e-9
    duration_s = min(lead_s + AFTER_S, math.floor(length_s - from_s))
    return _Part(from_s, lead_s, duration_s, row.phase == "coasting")


@lru_cache(maxsize=4)
def _unharmed(place: Place, part: _Part) -> Course:
    """Result of the same part without a fault."""
    return _run(place, part, EVERY["none"], 0.0)


def _run(place: Place, part: _Part, fault: Fault, begin_s: float) -> Course:
    config, whole = _read(place)
    recording = _cut(whole, part.from_s, part.duration_s)
    if part.coasting:
        recording = recording.withheld(part.lead_s - OUTAGE_S, part.lead_s + OUTAGE_S)
    if fault.alter is not None:
        recording = fault.alter(recording, begin_s, fault.length_s)
    if fault.configure is not None:
        config = fault.configure(config)
    states, sd = _smoothed(place, part.from_s, part.duration_s)

    turned = replace(states, rpy=states.rpy + np.array([0.0, 0.0, fault.turned_rad]))

    def look(solution: Solution, row: int) -> Sample:
        found = error_sample(solution, states, row, sd[row].tolist())
        if fault.turned_rad and solution.t_ns >= begin_s * 1e9:
            other = error_sample(solution, turned, row, sd[row].tolist())
            return min(found, other, key=lambda sample: sample.ratios[YAW : YAW + 1])
        return found

    return run_navigator(config, recording, part.duration_s, look)


def _cut(r: Recording, from_s: float, length_s: float) -> Recording:
    """Part of a recording, on a clock that starts with it."""
    begin, end = round(from_s * 1e9), round((from_s + length_s) * 1e9)
    kept = r.without((r.imu_seen <= begin) | (r.imu_seen > end))
    received = [
        _moved(item, begin) for item in r.received if begin < item.t_ns and item.seen_ns <= end
    ]
    return Recording(kept.stamps - begin, kept.imu_seen - begin, kept.samples, tuple(received))


def _moved(item: Received, by_ns: int) -> Received:
    """Move an item to a clock that is behind by an offset."""
    m, t, seen = item.measurement, item.t_ns - by_ns, item.seen_ns - by_ns
    assert isinstance(m, FUSED)
    return Received(t, seen, replace(m, t_seen_ns=seen, stamp=MonotonicStamp(t)))


def _tables(folder: Path) -> list[tuple[str, Path]]:
    return [(kind, path) for kind in KINDS if (path := folder / f"{kind}.csv").exists()]


@lru_cache(maxsize=1)
def _read(place: Place) -> tuple[Config, Recording]:
    """Read a recording, rotated to the mounting of the simulated drives, whose axes the faults
    name."""
    config = load_config(place.config)
    arrivals: list[Arrival] = []
    if place.recording.is_dir():
        imu = read_imu(place.recording / "imu.csv")
        for kind, path in _tables(place.recording):
            arrivals += READERS[kind](path, imu, source_of(kind, config))[0]
    else:
        log = read_can_log(place.recording, config)
        imu, arrivals = log.imu, log.arrivals
    stamps = np.rint(imu.t_s * 1e9).astype(np.int64)
    begin = int(stamps[0])
    received = []
    for arrival in arrivals:
        m = arrival.measurement
        if isinstance(m, FUSED) and isinstance(m.stamp, MonotonicStamp):
            item = Received(m.stamp.t_ns, arrival.t_arrival_ns, m)
            received.append(_moved(item, begin))
    turn = _nominal(VEHICLE.imu).T @ _nominal(config.imu)
    samples = np.hstack((imu.gyro @ turn.T, imu.accel @ turn.T))
    mounted = config.imu.model_copy(update={"axes": VEHICLE.imu.axes})
    recording = Recording(stamps - begin, stamps - begin, samples, ()).with_received(received)
    return config.model_copy(update={"imu": mounted}), recording


def _nominal(imu: Imu) -> Array:
    return sensor_to_body(imu.model_copy(update={"mounting_deg": (0.0, 0.0, 0.0)}))


def _smoothed(place: Place, from_s: float, duration_s: float) -> tuple[States, Array]:
    """Smoothed solution of each second of a part, and its sigmas (n, 9); without those before its
    start, where no run can navigate."""
    table, begin_s = _table(place)
    t_s = np.arange(1.0, duration_s + 0.5)
    there_s = t_s + begin_s + from_s

    def at(values: Array) -> Array:
        return np.column_stack([np.interp(there_s, table.t_s, column) for column in values.T])

    place_of = at(np.column_stack((table.lat_rad, table.lon_rad, table.height_m)))
    states = States(t_s, place_of, at(table.v), at(np.unwrap(table.rpy, axis=0)))
    return states, np.hstack((at(table.sd_position), at(table.sd_v), at(table.sd_rpy)))


@lru_cache(maxsize=1)
def _table(place: Place) -> tuple[TrajectoryTable, float]:
    """Smoothed solution, and the first instant of the recording on its clock."""
    config = load_config(place.config)
    imu = (
        read_imu(place.recording / "imu.csv")
        if place.recording.is_dir()
        else read_can_log(place.recording, config).imu
    )
    return read_solution(place.smoothed), float(imu.t_s[0])
