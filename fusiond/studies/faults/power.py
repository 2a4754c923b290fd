"""How well faults of position are detected by size and rate, and how often one is where none is.

Detection: the town drive of the matrix, the fault lasts a minute and begins with another second of
the straight in each run; noticed is what the matrix calls so.

False alarms: hours of the same town, over and over, with the noise of the configuration and nothing
wrong: an IMU of 50 Hz and a receiver of 1 Hz, RDSS every 11 s. Every event counts that comes once
the mode has been `navigating`.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

from fusiond.simulation.trajectories import Leg, Path, follow
from fusiond.studies.faults import aid_faults as aid
from fusiond.studies.faults.judge import NAVIGATING, longest_lie_s
from fusiond.studies.faults.library import PHASES, Fault
from fusiond.studies.faults.recording import REST_S, TOWN_LEGS, Drive
from fusiond.studies.faults.runs import VEHICLE, navigate, run

STEPS_M = (5.0, 10.0, 20.0, 50.0)
RAMPS_M_S = (0.1, 0.2, 0.5, 1.0)
LASTS_S = 60.0
BEGINS = 10
"""Faults begin at as many different seconds."""
HOUR_S = 3600.0
RATE_HZ, GNSS_HZ = 50.0, 1.0

SIZES: tuple[tuple[str, float], ...] = (
    *(("step", size) for size in STEPS_M),
    *(("ramp", rate) for rate in RAMPS_M_S),
)


def power_of(size: tuple[str, float], seeds: Sequence[int]) -> dict[str, Any]:
    """The figures of a step (m) or a ramp (m/s), a run a seed."""
    kind, value = size
    alter = (
        partial(aid.step, north_m=value) if kind == "step" else partial(aid.drift, north_m_s=value)
    )
    found = []
    for seed in seeds:
        begin_s = PHASES["navigating"].fix_s + seed % BEGINS
        found.append(run(Fault(alter, LASTS_S, begin_s=begin_s), "navigating", seed))
    noticed = [
        row["noticed_s"]
        for row in found
        if row["noticed_s"] is not None and row["noticed_s"] <= LASTS_S
    ]
    return {
        "fault": f"{kind} {value:g} m" + ("/s" if kind == "ramp" else ""),
        "runs": len(found),
        "noticed": len(noticed),
        "median_s": statistics.median(noticed) if noticed else None,
        "slowest_s": max(noticed, default=None),
        "largest_horizontal_m": max(row["largest_horizontal_m"] or 0.0 for row in found),
        "longest_lie_s": max(row["longest_lie_s"] for row in found),
    }


def around_town(duration_s: float) -> Path:
    """The town of the matrix, over and over."""
    rounds = int(duration_s / sum(leg.duration_s for leg in TOWN_LEGS)) + 1
    return follow((Leg(REST_S), *TOWN_LEGS * rounds), duration_s, course_deg=40.0, bank_ratio=-0.08)


def alarms_of(seed: int, duration_s: float = HOUR_S) -> dict[str, Any]:
    """An hour with nothing wrong: events by code, and seconds in which the mode was another."""
    imu = VEHICLE.imu.model_copy(update={"rate_hz": RATE_HZ})
    config = VEHICLE.model_copy(update={"imu": imu})
    drive = Drive(around_town, gnss_rate_hz=GNSS_HZ, duration_s=duration_s)
    truth, recording = drive.recorded(config, seed)
    course = navigate(config, recording, truth)
    since_s = next((s.t_s for s in course.samples if s.mode == NAVIGATING), duration_s)
    codes = Counter(e.code for e in course.events if e.t_s > since_s)
    others = [s for s in course.samples if s.t_s > since_s and s.mode != NAVIGATING]
    return {
        "seed": seed,
        "hours": duration_s / 3600.0,
        "events": dict(codes),
        "not_navigating_s": len(others),
        "longest_lie_s": longest_lie_s(course.samples),
        "crash": course.crash,
    }
