"""Power of fault detection, by kind and size.

The town drive of the matrix; the fault lasts a minute, in which there are a straight, a bend of 180
deg and a stop, and begins with another second of the straight in each run. Noticed is what the
matrix calls so, while the fault lasts. `largest_ratio` is the largest error over sigma that a mode
`navigating` vouched for from the fault's begin on, and a lie is one beyond five for over two
seconds.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

from fusiond.configuration.si_units import DEG
from fusiond.studies.faults import imu_faults as imu
from fusiond.studies.faults import measurement_faults as measurement
from fusiond.studies.faults.error_sigma_score import LIE_S
from fusiond.studies.faults.library import PHASES, Fault
from fusiond.studies.faults.runs import run_fault
from fusiond.studies.faults.sensor_data import Alter, Drive

LASTS_S = 60.0
BEGINS = 10
"""Number of different seconds at which faults begin."""
DRIVE = Drive(duration_s=PHASES["navigating"].fix_s + BEGINS + LASTS_S + 10.0)


@dataclass(frozen=True, slots=True)
class Sweep:
    """Kind of fault: its sizes in `unit`, and the change of a recording by a size."""

    unit: str
    sizes: tuple[float, ...]
    altered_by: Callable[[float], Alter]


SWEEPS: dict[str, Sweep] = {
    "position steps": Sweep(
        "m",
        (2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0),
        lambda size: partial(measurement.position_step, north_m=size),
    ),
    "position runs away": Sweep(
        "m/s",
        (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
        lambda size: partial(measurement.drift, north_m_s=size),
    ),
    "velocity is off": Sweep(
        "m/s",
        (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
        lambda size: partial(measurement.velocity_bias, north_m_s=size),
    ),
    "fix is frozen": Sweep("", (1.0,), lambda _: measurement.frozen_fix),
    "stated sigma too small": Sweep(
        "times",
        (1.5, 2.0, 3.0, 5.0, 10.0, 30.0),
        lambda size: partial(measurement.small_sigma, factor=size),
    ),
    "fixes late": Sweep(
        "s",
        (0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 2.0, 3.0),
        lambda size: partial(measurement.stamped_too_new, delay_s=size),
    ),
    "yaw gyro off": Sweep(
        "deg/s",
        (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
        lambda size: partial(imu.bias_step, size=size * DEG),
    ),
    "roll gyro off": Sweep(
        "deg/s",
        (0.05, 0.1, 0.2, 0.5, 1.0),
        lambda size: partial(imu.bias_step, size=size * DEG, axis=0),
    ),
    "forward accelerometer off": Sweep(
        "m/s^2",
        (0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
        lambda size: partial(imu.bias_step, size=size, axis=3),
    ),
}
CELLS = tuple((name, size) for name, sweep in SWEEPS.items() for size in sweep.sizes)


def jobs(runs: int, seed: int) -> list[tuple[str, float, int]]:
    """Kind, size and seed of every run, ordered by seed: runs of a seed share the fault-free drive,
    and an unfinished study covers every size."""
    return [(name, size, k) for k, (name, size) in product(range(seed, seed + runs), CELLS)]


def power_run(job: tuple[str, float, int]) -> dict[str, Any]:
    """Make one run and return its figures."""
    name, size, seed = job
    alter = SWEEPS[name].altered_by(size)
    begin_s = PHASES["navigating"].fix_s + seed % BEGINS
    found = run_fault(Fault(alter, LASTS_S, begin_s=begin_s, drive=DRIVE), "navigating", seed)
    kept = ("verdict", "noticed_s", "largest_horizontal_m", "largest_ratio", "largest_ratio_of")
    return {
        "fault": name,
        "size": size,
        "seed": seed,
        **{key: found[key] for key in kept},
        "longest_lie_s": found["longest_lie_s"],
        "by": found["events"][0]["code"] if found["events"] else "",
    }


def powers(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Detection power by kind and size, from the runs of `power_run`."""
    lines = []
    for name, size in CELLS:
        rows = [row for row in found if (row["fault"], row["size"]) == (name, size)]
        if not rows:
            continue
        noticed = [
            row["noticed_s"]
            for row in rows
            if row["noticed_s"] is not None and row["noticed_s"] <= LASTS_S
        ]
        lines.append(
            {
                "fault": name,
                "size": f"{size:g} {SWEEPS[name].unit}" if SWEEPS[name].unit else "-",
                "runs": len(rows),
                "noticed": len(noticed),
                "median_s": statistics.median(noticed) if noticed else None,
                "slowest_s": max(noticed, default=None),
                "largest_horizontal_m": largest(rows, "largest_horizontal_m"),
                "largest_ratio": largest(rows, "largest_ratio"),
                "lies": sum(row["longest_lie_s"] > LIE_S for row in rows),
                "longest_lie_s": max(row["longest_lie_s"] for row in rows),
            }
        )
    return lines


def largest(rows: list[dict[str, Any]], key: str) -> float | None:
    """Largest value of a key; None if one is not finite."""
    values = [row[key] for row in rows]
    return None if any(value is None for value in values) else max(values)
