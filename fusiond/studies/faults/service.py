"""Loss of service by a fault of a minute, and after an outage.

A run is a random drive of `DURATION_S` with the MEMS unit of `config/vehicle.toml`, one receiver at
one fix a second, no slip, and configured noise. Each of `FAULTS` begins at an instant drawn between
`BEGINS_S` and lasts `LASTS_S`; the same drive without a fault is the steady run. Figures are of the
solution published at 10 Hz:

out        in another mode than `navigating` from the fault's begin to the run's end; `after` of it
           behind the fault's end
largest    horizontal error from the fault's begin on, in any mode that publishes
settled    from the fault's end until sigma of a quantity is within `WITHIN` of its steady value for
           `STAYS_S`; None where the run ends before
lies       error beyond five sigma unbroken for over 2 s, in any mode that publishes

Outages (`OUTAGES_S`, one behind the other on one drive) count from the first good fix that comes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from drivers.measurements import PositionFix
from fusiond.configuration.si_units import DEG
from fusiond.studies.faults import imu_faults as imu
from fusiond.studies.faults import measurement_faults as measurement
from fusiond.studies.faults.error_sigma_score import LIE_S
from fusiond.studies.faults.matched_noise_drives import (
    CODE,
    RTK,
    SHARING,
    Receiver,
    Scene,
    Share,
    Vehicle,
    part_generator,
    scene,
)
from fusiond.studies.faults.sensor_data import Alter, Received, Recording
from fusiond.studies.faults.solution_errors import (
    AXES,
    JUDGED,
    STEP_S,
    Bools,
    Published,
    lasting_from,
    longest_s,
    published_errors,
)

BEGINS_S = (150.0, 270.0)
LASTS_S = 60.0
AFTER_S = 600.0
DURATION_S = BEGINS_S[1] + LASTS_S + AFTER_S
WITHIN = 1.5
STAYS_S = 5.0
OUTAGES_S = {150.0: 10.0, 300.0: 30.0, 450.0: 60.0}
"""Length of an outage by its start."""
QUIET_S = 90.0
"""Time (s) studied after an outage."""
OUTAGE_DURATION_S = 600.0
IMU, VELOCITY, POSITION, NONE = "IMU", "velocity", "position, latency, freeze", "nothing wrong"


def stale_fixes(r: Recording, begin_s: float, length_s: float, age_s: float) -> Recording:
    """Replace fixes by positions of `age_s` before, with present stamps."""
    fixes = [item for item in r.received if isinstance(item.measurement, PositionFix)]
    t_ns = np.array([item.t_ns for item in fixes])
    received = []
    for item in r.received:
        m = item.measurement
        if isinstance(m, PositionFix) and 0.0 <= item.t_ns * 1e-9 - begin_s < length_s:
            row = int(np.searchsorted(t_ns, item.t_ns - round(age_s * 1e9), side="right")) - 1
            before = fixes[max(row, 0)].measurement
            assert isinstance(before, PositionFix)
            m = replace(before, t_seen_ns=m.t_seen_ns, stamp=m.stamp)
            received.append(Received(item.t_ns, item.seen_ns, m))
        else:
            received.append(item)
    return r.with_received(received)


def _gyro(deg_s: float, axis: int) -> Alter:
    return partial(imu.bias_step, size=deg_s * DEG, axis=axis)


def _force(m_s2: float, axis: int) -> Alter:
    return partial(imu.bias_step, size=m_s2, axis=axis)


FAULTS: dict[str, tuple[str, Alter]] = {
    "yaw gyro off by 0.3 deg/s": (IMU, _gyro(0.3, 2)),
    "yaw gyro off by 1 deg/s": (IMU, _gyro(1.0, 2)),
    "roll gyro off by 0.3 deg/s": (IMU, _gyro(0.3, 0)),
    "forward force off by 0.5 m/s^2": (IMU, _force(0.5, 3)),
    "sideways force off by 0.5 m/s^2": (IMU, _force(0.5, 4)),
    "position off by 2 m": (POSITION, partial(measurement.position_step, north_m=2.0)),
    "position off by 10 m": (POSITION, partial(measurement.position_step, north_m=10.0)),
    "position off by 500 m": (POSITION, partial(measurement.position_step, north_m=500.0)),
    "position runs away, 0.1 m/s": (POSITION, partial(measurement.drift, north_m_s=0.1)),
    "position runs away, 0.2 m/s": (POSITION, partial(measurement.drift, north_m_s=0.2)),
    "position runs away, 0.5 m/s": (POSITION, partial(measurement.drift, north_m_s=0.5)),
    "position runs away, 2 m/s": (POSITION, partial(measurement.drift, north_m_s=2.0)),
    "velocity off by 0.5 m/s": (VELOCITY, partial(measurement.velocity_bias, north_m_s=0.5)),
    "velocity off by 2 m/s": (VELOCITY, partial(measurement.velocity_bias, north_m_s=2.0)),
    "velocity runs away, 0.1 m/s^2": (VELOCITY, measurement.velocity_ramp),
    "fixes 1 s late": (POSITION, partial(stale_fixes, age_s=1.0)),
    "fixes 3 s late": (POSITION, partial(stale_fixes, age_s=3.0)),
    "fixes frozen": (POSITION, measurement.frozen_fix),
    "velocity reversed": (VELOCITY, measurement.velocity_reversed),
}
"""Group and change of each fault; offsets of receivers are to the north."""
RECEIVERS = {receiver.name: receiver for receiver in (CODE, SHARING)}
AFTER_OUTAGES = {
    f"{receiver.name}, {rate:g} Hz": replace(receiver, rate_hz=rate)
    for receiver in (RTK, CODE)
    for rate in (10.0, 1.0)
}


@dataclass(frozen=True, slots=True)
class Job:
    """Fault ("" for none) or outages (None) of a drive, and the receiver on board."""

    number: int
    receiver: str
    fault: str | None


def jobs(drives: int) -> list[Job]:
    """Jobs of all faults; those with the same drive and receiver share the steady run."""
    found = []
    for number in range(drives):
        for receiver in RECEIVERS:
            found += [Job(number, receiver, fault) for fault in ("", *FAULTS)]
        found += [Job(number, receiver, None) for receiver in AFTER_OUTAGES]
    return found


def service_run(job: Job, share: Share) -> dict[str, Any]:
    """Run a job and return its figures."""
    if job.fault is None:
        return _outages(job, share)
    group, alter = FAULTS[job.fault] if job.fault else (NONE, None)
    on, steady = _steady(RECEIVERS[job.receiver], job.number, share, DURATION_S)
    draws = part_generator(share, job.number, 4, ["", *FAULTS].index(job.fault))
    begin_s = round(float(draws.uniform(*BEGINS_S)), 1)
    run = steady
    if alter is not None:
        run = published_errors(on.config, alter(on.recording, begin_s, LASTS_S), on.truth)
    return {
        "part": "fault",
        "drive": job.number,
        "receiver": job.receiver,
        "group": group,
        "fault": job.fault or NONE,
        "begin_s": begin_s,
        **figures(run, steady, begin_s, begin_s + LASTS_S),
    }


@lru_cache(maxsize=1)
def _steady(
    receiver: Receiver, number: int, share: Share, duration_s: float
) -> tuple[Scene, Published]:
    """Drive, and its published solution without a fault."""
    vehicle = Vehicle("data sheet", receiver, told="noise")
    on = scene(vehicle, share, number, duration_s)
    return on, published_errors(on.config, on.recording, on.truth)


def figures(run: Published, steady: Published, begin_s: float, end_s: float) -> dict[str, Any]:
    """Figures of a run with a fault from `begin_s` to `end_s`, against the same without it."""
    since, after = run.t_s >= begin_s - 1e-6, run.t_s >= end_s - 1e-6
    out, beyond = ~run.navigating & since, run.beyond & since
    ratios = run.ratios
    by_quantity = {
        name: longest_s(run.beyond_in(axes) & since)
        for name, axes in AXES.items()
        if name != "velocity"
    }
    lie_s = longest_s(beyond)
    worst = float(ratios[since][:, JUDGED].max(initial=0.0))
    codes = Counter(event.code for event in run.events if event.t_s >= begin_s)
    return {
        "out_s": _seconds(out),
        "out_after_s": _seconds(out & after),
        "steady_out_s": _seconds(~steady.navigating & since),
        "largest_m": _largest(run.horizontal_m[since & run.there]),
        "end_m": _finite(float(run.horizontal_m[-1])),
        "settled_s": settled(run, steady, after),
        "beyond_s": _seconds(beyond),
        "longest_lie_s": lie_s,
        "longest_lie_of_s": by_quantity,
        "lies": lie_s > LIE_S,
        "largest_ratio": _finite(worst),
        "lie_modes": dict(Counter(run.modes[beyond].tolist())),
        "events": dict(codes),
        "crash": run.crash,
    }


def settled(run: Published, steady: Published, after: Bools) -> dict[str, float | None]:
    """Seconds until sigma of each quantity stays within `WITHIN` of its steady value."""
    samples, first = round(STAYS_S / STEP_S), int(np.argmax(after))
    found = {}
    for name in AXES:
        with np.errstate(invalid="ignore"):
            near = run.sigma(name)[after] <= WITHIN * steady.sigma(name)[after]
        row = lasting_from(near & run.there[after], samples)
        found[name] = None if row is None else (run.t_s[first + row] - run.t_s[first]).item()
    return {name: value if value is None else round(value, 1) for name, value in found.items()}


def _outages(job: Job, share: Share) -> dict[str, Any]:
    """Result of each outage, from the first fix after it on."""
    receiver = AFTER_OUTAGES[job.receiver]
    on, steady = _steady(receiver, job.number, share, OUTAGE_DURATION_S)
    recording = on.recording
    for begin_s, length_s in OUTAGES_S.items():
        recording = recording.withheld(begin_s, begin_s + length_s)
    run = published_errors(on.config, recording, on.truth)
    found = []
    for begin_s, length_s in OUTAGES_S.items():
        end_s = begin_s + length_s
        back_s = min(i.seen_ns for i in recording.received if i.t_ns >= end_s * 1e9) * 1e-9
        after = (run.t_s >= back_s - 1e-6) & (run.t_s < back_s + QUIET_S)
        during = (run.t_s >= begin_s) & (run.t_s < back_s)
        row = lasting_from(run.navigating[after], round(STAYS_S / STEP_S))
        found.append(
            {
                "length_s": length_s,
                "navigating_s": None if row is None else round(row * STEP_S, 1),
                "settled_s": settled(run, steady, after),
                "largest_m": _largest(run.horizontal_m[during & run.there]),
                "longest_lie_s": longest_s(run.beyond & (during | after)),
            }
        )
    return {
        "part": "outages",
        "drive": job.number,
        "receiver": job.receiver,
        "outages": found,
        "events": dict(Counter(event.code for event in run.events)),
        "crash": run.crash,
    }


def _seconds(where: Bools) -> float:
    return round(float(where.sum()) * STEP_S, 1)


def _largest(values: Any) -> float | None:
    return _finite(float(values.max(initial=0.0)))


def _finite(value: float) -> float | None:
    """Value if finite, else None, since JSON has no other numbers."""
    return value if np.isfinite(value) else None
