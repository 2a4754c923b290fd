"""Fault-free recorded drives: false reports, and error against sigma in outages or by a reference.

Each drive passes the navigator with the knowledge of the vehicle's owner: axes and sensor class, no
noise figures. It runs once unchanged, then with each set of outages (`Drive.outages`). The
reference is not fused: withheld fixes, or a truth by another device. Its sigma adds to the
published one; the nearest instants are compared, `GAP_S` apart at most. Lever arms of 5 cm are
neglected.

told        events after the first `navigating`, but for those that say all is well
own         published horizontal sigma over that of the filter's own covariance, at each tick
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.files.measurement_csv import TrajectoryTable, read_imu, read_truth
from fusiond.navigator.navigator import Navigator
from fusiond.offline.measurement_files import READERS
from fusiond.simulation.imu_truth import States
from fusiond.studies.faults.hours import USUAL, event_name
from fusiond.studies.faults.recorded import FUSED
from fusiond.studies.faults.runs import TICKS_PER_S
from fusiond.studies.faults.sensor_data import Received, Recording
from fusiond.studies.faults.sigma_sharpness import moments
from fusiond.studies.faults.solution_errors import AXES, STEP_S, Bools, errors_against, longest_s

Array = NDArray[np.float64]

GAP_S = 0.5 * STEP_S
ON_FOOT = {"heading": ("gnss_course",), "course_speed_m_s": 0.8, "course_sd_deg": 20.0}
SLIPLESS = {"non_holonomic": {"enabled": True}}
PHASE = "steady"


@dataclass(frozen=True, slots=True)
class Drive:
    """Folder of recorded tables, known parameters of the vehicle, and sets of outages as start,
    from the first sample, and length (s). `truth` is a table that is not a measurement; without it
    the withheld fixes are. `qualities` replace those that fixes state."""

    folder: str
    settings: dict[str, Any]
    outages: tuple[tuple[tuple[float, float], ...], ...]
    wheels: bool = False
    truth: str | None = None
    qualities: Mapping[int, int] = field(default_factory=dict)


BY_NMEA = {1: 4, 2: 5}
"""Fixed and float ambiguities of RTKLIB as NMEA qualities."""
_RTK: dict[str, Any] = {
    "imu": {"axes": ("-x", "+y", "-z"), "sensor_class": "mems", "rate_hz": 100.0},
    "aiding": {"gnss": {"lever_arm_m": (0.0, -0.05, 0.0)}},
    "constraints": SLIPLESS,
    "alignment": {"heading": ("gnss_course",)},
}
_EVERY_45_S = tuple(
    tuple((171.645 + shift_s + 45.0 * k, 15.0) for k in range(8)) for shift_s in (0, 9, 18, 27, 36)
)
"""Outages of the data's README: eight of 15 s, and four sets between them."""
DRIVES: dict[str, Drive] = {
    "drive_0708": Drive("drive_0708", _RTK, _EVERY_45_S),
    "drive_0708, quality 4": Drive("drive_0708", _RTK, _EVERY_45_S, qualities=BY_NMEA),
    "css_164": Drive(
        "css_164",
        {
            "imu": {"axes": ("-y", "+z", "-x"), "sensor_class": "consumer", "rate_hz": 100.0},
            "aiding": {"gnss": {}, "wheel": {}},
            "constraints": SLIPLESS,
            "alignment": {"heading": ("gnss_course",)},
        },
        (tuple((582.33 + 150.0 * k, 60.0) for k in range(12)),),
        wheels=True,
    ),
    "walk_0827": Drive(
        "walk_0827",
        {
            "imu": {"axes": ("+y", "+x", "-z"), "sensor_class": "mems", "rate_hz": 167.0},
            "aiding": {"gnss": {"lever_arm_m": (0.0, -0.05, 0.0)}},
            "alignment": ON_FOOT,
        },
        (tuple((60.0 + 15.0 * k, 5.0) for k in range(5)),),
    ),
    "comma2k19_40": Drive(
        "comma2k19_40",
        {
            "imu": {"axes": ("+x", "+y", "+z"), "sensor_class": "consumer", "rate_hz": 104.0},
            "aiding": {"gnss": {}, "wheel": {}},
            "constraints": SLIPLESS,
            "alignment": {"heading": ("gnss_course",)},
        },
        (((15.0, 45.0),),),
        wheels=True,
        truth="truth.csv",
    ),
}


@dataclass(frozen=True, slots=True)
class RealJob:
    """Drive of a data folder with one set of its outages, or None."""

    data: Path
    drive: str
    outages: int | None


def jobs(data: Path) -> list[RealJob]:
    """Jobs for the available drives; ValueError without any."""
    found = [
        RealJob(data, name, which)
        for name, drive in DRIVES.items()
        if (data / drive.folder).is_dir()
        for which in (None, *range(len(drive.outages)))
    ]
    if not found:
        folders = ", ".join(dict.fromkeys(drive.folder for drive in DRIVES.values()))
        raise ValueError(f"{data} has none of the drives {folders}")
    return found


def real_run(job: RealJob) -> dict[str, Any]:
    """Run a job and return its figures."""
    drive = DRIVES[job.drive]
    config = Config.model_validate(drive.settings)
    whole, reference, begin_s = _read(job.data / drive.folder, drive.wheels, drive.truth)
    recording = _of_quality(whole, drive.qualities) if drive.qualities else whole
    windows = () if job.outages is None else drive.outages[job.outages]
    for at_s, length_s in windows:
        recording = recording.withheld(at_s, at_s + length_s)
    states, sd, near = _at_ticks(reference, begin_s, float(whole.imu_seen[-1]) * 1e-9)
    own = _Own()
    run = errors_against(config, recording, states, sd, own.watch)
    held = np.zeros_like(near)
    for at_s, length_s in windows:
        held |= (states.t_s >= at_s) & (states.t_s < at_s + length_s)
    since = run.t_s >= run.t_s[int(np.argmax(run.navigating))]
    first_s = float(run.t_s[since][0])
    reported = Counter(
        event_name(e.code, e.text) for e in run.events if e.t_s > first_s and e.code not in USUAL
    )
    compared = near & run.there & (held if windows else np.full_like(held, drive.truth is not None))
    return {
        "drive": job.drive,
        "outages": job.outages,
        "seconds": round(float(run.t_s[-1]), 1),
        "not_navigating_s": round(float((since & ~run.navigating & ~held).sum()) * STEP_S, 1),
        "told": dict(reported),
        "isolated": sum(k for what, k in reported.items() if what.startswith("isolated")),
        "own": own.shares(),
        "compared": int(compared.sum()),
        "phases": {PHASE: moments(run, compared)},
        "largest_m": [
            float(
                run.horizontal_m[compared & (states.t_s >= a) & (states.t_s < b)].max(initial=0.0)
            )
            for a, b in _parts(windows, float(states.t_s[-1]))
        ]
        if compared.any()
        else [],
        "beyond_s": longest_s(run.beyond_in(AXES["position"]) & compared),
        "crash": run.crash,
    }


def _parts(windows: Sequence[tuple[float, float]], duration_s: float) -> list[tuple[float, float]]:
    """Start and end of each outage, or of the whole without outages."""
    return [(at_s, at_s + length_s) for at_s, length_s in windows] or [(0.0, duration_s)]


@dataclass(slots=True)
class _Own:
    """Published horizontal sigma over the filter's own, tick by tick."""

    ratios: list[float] = field(default_factory=list)

    def watch(self, navigator: Navigator) -> None:
        if navigator.started is None:
            return
        p, stated = navigator.estimator.covariance, navigator.estimator.sigmas()
        own = math.sqrt(max(float(p[6, 6] + p[7, 7]), 0.0))
        if own > 0.0:
            self.ratios.append(math.hypot(float(stated[0]), float(stated[1])) / own)

    def shares(self) -> dict[str, float | None]:
        """Median, 99th percentile and maximum."""
        if not self.ratios:
            return {"median": None, "most_99": None, "most": None}
        half, most, all_of_it = np.percentile(self.ratios, (50.0, 99.0, 100.0)).tolist()
        return {"median": half, "most_99": most, "most": all_of_it}


@lru_cache(maxsize=1)
def _read(
    folder: Path, wheels: bool, truth: str | None
) -> tuple[Recording, TrajectoryTable, float]:
    """Read the recording, its clock starting at the first sample, with the reference and the
    start."""
    path = next(p for p in (folder / "imu.csv", folder / "imu.csv.gz") if p.exists())
    imu = read_imu(path)
    stamps = np.rint(imu.t_s * 1e9).astype(np.int64)
    begin = int(stamps[0])
    received = []
    for kind in ("gnss", "wheel") if wheels else ("gnss",):
        for arrival in READERS[kind](folder / f"{kind}.csv", imu, kind)[0]:
            m = arrival.measurement
            if isinstance(m, FUSED) and isinstance(m.stamp, MonotonicStamp):
                t, seen = m.stamp.t_ns - begin, arrival.t_arrival_ns - begin
                moved = replace(m, t_seen_ns=seen, stamp=MonotonicStamp(t))
                received.append(Received(t, seen, moved))
    samples = np.hstack((imu.gyro, imu.accel))
    recording = Recording(stamps - begin, stamps - begin, samples, ()).with_received(received)
    return recording, read_truth(folder / (truth or "gnss.csv")), begin * 1e-9


def _of_quality(recording: Recording, qualities: Mapping[int, int]) -> Recording:
    received = [
        replace(item, measurement=replace(m, quality=qualities[m.quality]))
        if isinstance(m := item.measurement, PositionFix)
        else item
        for item in recording.received
    ]
    return recording.with_received(received)


def _at_ticks(
    table: TrajectoryTable, begin_s: float, length_s: float
) -> tuple[States, Array, Bools]:
    """Reference at each tick, its sigmas (n, 9), and the ticks at which it is valid.

    A sigma is zero where the reference states none; it holds near its own rows."""
    t_s = np.arange(1.0, math.floor(length_s * TICKS_PER_S) + 0.5) * STEP_S
    there_s = t_s + begin_s

    def at(values: Array) -> Array:
        return np.column_stack([np.interp(there_s, table.t_s, column) for column in values.T])

    place = at(np.column_stack((table.lat_rad, table.lon_rad, table.height_m)))
    states = States(t_s, place, at(table.v), at(np.unwrap(table.rpy, axis=0)))
    sd = np.hstack((at(table.sd_position), at(table.sd_v), at(table.sd_rpy)))
    after = np.clip(np.searchsorted(table.t_s, there_s), 1, len(table.t_s) - 1)
    gap_s = np.minimum(abs(table.t_s[after] - there_s), abs(table.t_s[after - 1] - there_s))
    return states, np.nan_to_num(sd), gap_s <= GAP_S
