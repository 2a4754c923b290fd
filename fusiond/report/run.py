"""Run as the input of a report, from any kind of file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import nan
from typing import Literal, NamedTuple

import numpy as np

from fusiond.files.csv_tables import Floats
from fusiond.files.measurement_csv import TrajectoryTable


class Problem(NamedTuple):
    """Problem of a file that a reader must know before using the figures."""

    level: Literal["warning", "error"]
    text: str


class Event(NamedTuple):
    """Event at `t_s` of the run."""

    t_s: float
    level: str
    code: str
    source: str
    text: str


class Difference(NamedTuple):
    """Setting that differs from its default (None: no default), with a dotted name."""

    key: str
    value: str
    default: str | None


@dataclass(frozen=True, slots=True)
class Innovations:
    """The measurements of one source, a row each, by instant of validity.

    `delay_s` is from validity until the filter first met it. `whitened` (n, k) is NaN where there
    was no innovation. `raw` (n, j) in `unit`, estimate minus measurement, along `axes` (of
    `ned`; empty: of their own); j = 0: not in the log.
    """

    t_s: Floats
    delay_s: Floats
    nis: Floats
    degrees: Floats
    whitened: Floats
    outcome: Sequence[str]
    raw: Floats = field(default_factory=lambda: np.empty((0, 0)))
    unit: str = ""
    axes: str = ""

    @property
    def fused(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.array([name == "fused" for name in self.outcome], dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class Verdicts:
    """The consistency tests of one source over time (n,)."""

    t_s: Floats
    nis_average: Floats
    nis_low: Floats
    nis_high: Floats
    rho_1: Floats
    rho_high: Floats
    verdict: Sequence[str]


@dataclass(frozen=True, slots=True)
class Estimated:
    """A parameter over time with one sigma, in the unit named."""

    unit: str
    t_s: Floats
    value: Floats
    sd: Floats
    state: str = ""


@dataclass(frozen=True, slots=True)
class Sky:
    """Satellites of one receiver: counts over time, and refusals by reason over all epochs."""

    t_s: Floats
    used: Floats
    refused: Floats
    pdop: Floats
    reasons: dict[str, int]


@dataclass(frozen=True, slots=True)
class ImuStatistics:
    """Statistics of inertial samples before the filter, in the stretches looked at.

    Intervals (ms) between samples by their own stamps and by their arrival; the amplitude spectrum
    of the three axes of rate (deg/s per root Hz) and specific force (m/s^2 per root Hz), (n, 3).
    """

    source: str
    t_s: Floats
    stamped_ms: Floats
    arrived_ms: Floats
    samples: int
    seconds: float
    frequency_hz: Floats
    gyro: Floats
    accel: Floats


@dataclass(slots=True)
class Fault:
    """Fault that the daemon identified: begin, last report, and last size on the largest axis."""

    source: str
    kind: str
    started_s: float
    last_s: float
    axis: str = ""
    unit: str = ""
    action: str = ""
    size: float = nan
    sd: float = nan
    log_odds: float = nan


@dataclass(slots=True)
class LogParts:
    """Data of a log beyond the solution; a part that the log lacks is empty."""

    outcomes: dict[str, dict[str, int]] = field(default_factory=dict)
    counters: dict[str, dict[str, int]] = field(default_factory=dict)
    service: dict[str, Counter[str]] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    innovations: dict[str, Innovations] = field(default_factory=dict)
    verdicts: dict[str, Verdicts] = field(default_factory=dict)
    biases: dict[str, Estimated] = field(default_factory=dict)
    calibration: dict[str, Estimated] = field(default_factory=dict)
    sky: dict[str, Sky] = field(default_factory=dict)
    latency: dict[str, tuple[Floats, Floats]] = field(default_factory=dict)
    tick_delay_ms: tuple[Floats, Floats] | None = None
    usage: tuple[Floats, Floats, Floats] | None = None
    """Times, CPU in percent of a core, resident memory in MB."""
    imu: ImuStatistics | None = None
    sources: Sequence[str] = ()


@dataclass(slots=True)
class Run:
    """A run. `t_s` of the solution is the axis of everything; `posix` is True for POSIX seconds.
    `truth_offset_s` is the lead of a truth's times over this axis."""

    name: str
    solution: TrajectoryTable
    posix: bool
    facts: list[tuple[str, str]] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    differs: list[Difference] | None = None
    events: list[Event] = field(default_factory=list)
    truth_offset_s: float = 0.0
    log: LogParts | None = None

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant of the solution, or of the events in a run without one."""
        times = self.solution.t_s if len(self.solution.t_s) else [e.t_s for e in self.events]
        return (float(times[0]), float(times[-1])) if len(times) else (0.0, 0.0)

    def modes(self) -> Iterator[tuple[float, float, str]]:
        """Stretches of one mode: begin, end, mode."""
        status, t_s = self.solution.status, self.solution.t_s
        started = 0
        for k in range(1, len(status) + 1):
            if k == len(status) or status[k] != status[started]:
                yield float(t_s[started]), float(t_s[min(k, len(status) - 1)]), status[started]
                started = k
