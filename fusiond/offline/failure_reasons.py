"""Reasons why a run over files failed, in one sentence."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from drivers.immutable import immutable
from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Imu
from fusiond.configuration.si_units import sensor_to_body
from fusiond.files.csv_tables import Rejection, rejection_counts
from fusiond.files.measurement_csv import ImuTable
from fusiond.navigation.distributions import median
from fusiond.navigation.imu_buffer import magnitudes, squares
from fusiond.navigator.imu_unit_check import CourseTurns, force_unit, rms_unit
from fusiond.offline.measurement_files import Arrival

_TIMES = {"time_backwards", "time_ahead"}


@immutable()
class FileRead:
    """Rows of a file: its own times (s) of the first and last used row (None: none), the number of
    used rows, and the rejected ones. Frames of a bus do not count as measurements."""

    span_s: tuple[float, float] | None
    used: int
    rejected: Sequence[Rejection]
    is_measurement: bool = True

    @property
    def refused(self) -> int:
        """Number of rejected rows."""
        return sum(rejection_counts(self.rejected).values())

    @property
    def rows(self) -> int:
        """Number of all rows."""
        return self.used + self.refused


def wrong_units(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> str | None:
    """Sentence on forces or rates in other units than those of the columns' names."""
    if not len(imu.t_s):
        return None
    return force_unit(median(magnitudes(imu.samples))) or _rate_unit(imu, section, arrivals)


def _rate_unit(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> str | None:
    rms = math.sqrt(squares(imu.samples, 0, len(imu.samples)) / len(imu.samples))
    return rms_unit(rms) or _course_turns(imu, section, arrivals).said()


def _course_turns(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> CourseTurns:
    yaw_rate = imu.gyro @ sensor_to_body(section)[2]
    yaw = np.concatenate(([0.0], np.cumsum(yaw_rate[1:] * np.diff(imu.t_s))))
    velocities = sorted(
        (m.stamp.t_ns, m.v_ned_m_s[:2])
        for m in (arrival.measurement for arrival in arrivals)
        if isinstance(m, PositionFix)
        and isinstance(m.stamp, MonotonicStamp)
        and m.v_ned_m_s is not None
    )
    instants = [t_ns for t_ns, _ in velocities]
    times = imu.t_s + section.time_offset_s
    faced = np.interp(np.array(instants, dtype=np.float64) * 1e-9, times, yaw, np.nan, np.nan)
    yaw_at = dict(zip(instants, faced.tolist(), strict=True))
    turns = CourseTurns()
    for t_ns, velocity in velocities:
        turns.fix(t_ns, velocity, lambda begin_ns, end_ns: yaw_at[end_ns] - yaw_at[begin_ns])
    return turns


def nothing_navigated(
    files: Mapping[str, FileRead], refused: Mapping[str, Mapping[str, int]], reason: str
) -> str:
    """Sentence for a run without a solution.

    `files` by name, the IMU's first; `refused`: outcomes by source; `reason`: the alignment's.
    """
    for name, file in files.items():
        if file.refused > file.used:
            return _refused_rows(name, file)
    imu_name, imu, measurements = _measurements(files)
    if not measurements:
        return f"No measurements: give --aid KIND=FILE ({reason})"
    others = [
        f"{name} from {_span(file)}" for name, file in measurements if not _overlap(imu, file)
    ]
    if len(others) == len(measurements):
        ranges = " and ".join(others)
        return f"No time in common: {imu_name} from {_span(imu)}, {ranges}"
    empty = [source for source, outcomes in refused.items() if set(outcomes) == {"too_few"}]
    if empty:
        return (
            f"{reason}: the epochs of {', '.join(empty)} hold too few satellites of GPS, Galileo "
            "and BeiDou, on signals that are read"
        )
    kept = [f"{n} of {source} {name}" for source, o in refused.items() for name, n in o.items()]
    return f"{reason} ({', '.join(kept)})" if kept else reason


def without_overlap(files: Mapping[str, FileRead]) -> list[str]:
    """Lines on measurement files whose times do not overlap the IMU's, the first file."""
    if not files:
        return []
    imu_name, imu, measurements = _measurements(files)
    return [
        f"{name} from {_span(file)}: no time in common with {imu_name}, from {_span(imu)}"
        for name, file in measurements
        if not _overlap(imu, file)
    ]


def _measurements(
    files: Mapping[str, FileRead],
) -> tuple[str, FileRead, list[tuple[str, FileRead]]]:
    """Split the files into the IMU's, the first one, and those of measurements."""
    (imu_name, imu), *others = files.items()
    return imu_name, imu, [(name, file) for name, file in others if file.is_measurement]


def _refused_rows(name: str, file: FileRead) -> str:
    by_reason = Counter(rejection_counts(file.rejected))
    times = sum(by_reason[reason] for reason in _TIMES)
    if times > file.refused / 2:
        return f"{name}: its times run backwards in {times} of {file.rows} rows"
    if len(by_reason) > 1:
        del by_reason["unpaired"]  # several frames make one row
    most, number = by_reason.most_common(1)[0]
    said = f"{name}: {number} of {file.rows} rows are refused as {most}"
    return f"{said}: {file.rejected[0]}" if file.rejected[0].line else said


def _overlap(a: FileRead, b: FileRead) -> bool:
    if a.span_s is None or b.span_s is None:
        return False
    return a.span_s[0] <= b.span_s[1] and b.span_s[0] <= a.span_s[1]


def _span(file: FileRead) -> str:
    if file.span_s is None:
        return "no row"
    return f"{file.span_s[0]:.3f} to {file.span_s[1]:.3f} s"
