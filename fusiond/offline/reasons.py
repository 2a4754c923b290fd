r"""Why a run over files cannot be good, in one sentence that names what to mend.

Units. The median of |f| over a file is that of gravity, whatever the vehicle does; another unit
shows as its factor. Rates are held against the course of the fixes: between two fixes of a vehicle
that moves, the yaw rate's integral is the change of course,

    k = sum(dpsi_gyro dpsi_course) / sum(dpsi_course^2),

1 for rad/s and 180 / pi for deg/s.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Imu
from fusiond.configuration.settings import DEG, sensor_to_body
from fusiond.files.csv_tables import Rejection, counts
from fusiond.files.tables import ImuTable
from fusiond.navigation.earth import STANDARD_GRAVITY_M_S2
from fusiond.offline.aid_files import Arrival

Array = NDArray[np.float64]

# In a loop of 2 g for half of a file nobody flies, and half of gravity for as long nobody falls.
FORCE_RANGE = (0.5, 2.0)
FORCE_UNITS = {"g": STANDARD_GRAVITY_M_S2, "milli-g": 1e-3 * STANDARD_GRAVITY_M_S2, "cm/s^2": 1e-2}
# RMS over a file that no vehicle turns with: a turn a second, all the time.
MOST_RATE_RAD_S = 2.0 * math.pi
# A course is one from the speed at which alignment takes it for the heading by default. Over a
# second a bend changes it by more than its noise; changes of 30 deg in all show the factor of 57.
COURSE_SPEED_M_S = 3.0
COURSE_STEP_S = (0.9, 2.1)
LEAST_TURN_RAD = 30.0 * DEG
DEGREES_RANGE = (10.0, 300.0)
_TIMES = {"time_backwards", "time_ahead"}


@dataclass(frozen=True, slots=True)
class FileRead:
    """A file's rows as they were read: s of its own time from the first to the last that is used
    (None: none is), how many, and those that are not."""

    span_s: tuple[float, float] | None
    rows: int
    rejected: Sequence[Rejection]


def wrong_units(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> str | None:
    """The sentence, where forces or rates are not in the units that the columns' names say."""
    if not len(imu.t_s):
        return None
    return _force_unit(imu) or _rate_unit(imu, section, arrivals)


def _force_unit(imu: ImuTable) -> str | None:
    median = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if FORCE_RANGE[0] <= median / STANDARD_GRAVITY_M_S2 <= FORCE_RANGE[1]:
        return None
    found = f"the specific force is {median:.4g} in the median, where gravity alone is 9.81 m/s^2"
    for unit, factor in FORCE_UNITS.items():
        if FORCE_RANGE[0] <= median * factor / STANDARD_GRAVITY_M_S2 <= FORCE_RANGE[1]:
            return f"{found}: it looks like {unit}; multiply the accel columns by {factor:g}"
    return f"{found}: another unit, or gravity taken out"


def _rate_unit(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> str | None:
    advice = "they look like deg/s; multiply the gyro columns by pi/180"
    rms = float(np.sqrt(np.mean(np.sum(imu.gyro**2, axis=1))))
    if rms > MOST_RATE_RAD_S:
        return f"the rates are {rms:.3g} rad/s RMS, more than a vehicle turns: {advice}"
    factor = _rate_factor(imu, section, arrivals)
    if factor is not None and DEGREES_RANGE[0] <= abs(factor) <= DEGREES_RANGE[1]:
        return f"the rates are {abs(factor):.0f} times the turns of the fixes' course: {advice}"
    return None


def _rate_factor(imu: ImuTable, section: Imu, arrivals: Sequence[Arrival]) -> float | None:
    """k, None where the fixes tell of no turn."""
    courses = sorted(
        (m.stamp.t_ns * 1e-9, math.atan2(m.v_ned_m_s[1], m.v_ned_m_s[0]))
        for m in (arrival.measurement for arrival in arrivals)
        if isinstance(m, PositionFix)
        and isinstance(m.stamp, MonotonicStamp)
        and m.v_ned_m_s is not None
        and math.hypot(*m.v_ned_m_s[:2]) >= COURSE_SPEED_M_S
    )
    apart: list[tuple[float, float]] = []
    for at_s, course_rad in courses:
        if not apart or at_s - apart[-1][0] >= COURSE_STEP_S[0]:
            apart.append((at_s, course_rad))
    if len(apart) < 2:
        return None
    t_s, course = np.array(apart).T
    yaw_rate = imu.gyro @ sensor_to_body(section)[2]
    yaw = np.concatenate(([0.0], np.cumsum(yaw_rate[1:] * np.diff(imu.t_s))))
    turned = np.diff(np.interp(t_s, imu.t_s + section.time_offset_s, yaw))
    change = (np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi
    inside = (t_s[1:] <= imu.t_s[-1]) & (t_s[:-1] >= imu.t_s[0])
    near = inside & (np.diff(t_s) <= COURSE_STEP_S[1])
    turned, change = turned[near], change[near]
    if np.abs(change).sum() < LEAST_TURN_RAD:
        return None
    return float(turned @ change / (change @ change))


def nothing_navigated(
    files: Mapping[str, FileRead], refused: Mapping[str, Mapping[str, int]], reason: str
) -> str:
    """The sentence for a run without a solution.

    `files` by name, the first is the IMU's; `refused` outcomes by source; `reason` is the
    alignment's.
    """
    for name, file in files.items():
        if len(file.rejected) > file.rows / 2:
            return _refused_rows(name, file)
    (imu_name, imu), *aids = files.items()
    if not aids:
        return f"no aid was given: {reason}"
    apart = [f"{name} from {_span(file)}" for name, file in aids if not _overlap(imu, file)]
    if len(apart) == len(aids):
        ranges = " and ".join(apart)
        return f"no time in common: {imu_name} from {_span(imu)}, {ranges}"
    kept = [f"{n} of {source} {name}" for source, o in refused.items() for name, n in o.items()]
    return f"{reason} ({', '.join(kept)})" if kept else reason


def _refused_rows(name: str, file: FileRead) -> str:
    by_reason = Counter(counts(file.rejected))
    times = sum(by_reason[reason] for reason in _TIMES)
    if times > len(file.rejected) / 2:
        return f"{name}: its times run backwards in {times} of {file.rows} rows"
    most, number = by_reason.most_common(1)[0]
    return f"{name}: {number} of {file.rows} rows are refused as {most}: {file.rejected[0]}"


def _overlap(a: FileRead, b: FileRead) -> bool:
    if a.span_s is None or b.span_s is None:
        return False
    return a.span_s[0] <= b.span_s[1] and b.span_s[0] <= a.span_s[1]


def _span(file: FileRead) -> str:
    if file.span_s is None:
        return "no row"
    return f"{file.span_s[0]:.3f} to {file.span_s[1]:.3f} s"
