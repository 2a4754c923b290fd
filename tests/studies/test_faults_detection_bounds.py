"""Bounds: what a filter that trusts all hears of a fault, and when any test could tell."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
import pytest

from fusiond.studies.faults import imu_faults as imu
from fusiond.studies.faults import measurement_faults as measurement
from fusiond.studies.faults.detection_bounds import (
    DETECTED,
    OPEN,
    ROWS,
    UngatedRun,
    bound,
    detection_information,
    jobs,
    ungated_run,
)
from fusiond.studies.faults.matched_noise_drives import CODE, Scene, Vehicle, scene
from fusiond.studies.faults.sensor_data import Alter
from fusiond.studies.faults.service import FAULTS
from fusiond.studies.faults.tables import TABLES

BEGIN_S, END_S = 80.0, 110.0


@lru_cache(maxsize=1)
def drive() -> tuple[Scene, UngatedRun]:
    on = scene(Vehicle("data sheet", CODE, told="noise"), "looked", 0, END_S + 1.0)
    return on, ungated_run(on.config, on.recording, on.truth, END_S)


def faulty(alter: Alter) -> UngatedRun:
    on, _ = drive()
    return ungated_run(on.config, alter(on.recording, BEGIN_S, 60.0), on.truth, END_S)


def test_without_a_fault_nothing_is_heard_and_all_is_fused() -> None:
    sound = drive()[1]
    assert sound.run.crash is None
    assert detection_information(sound, sound, BEGIN_S)[1].max() == 0.0
    assert all(y for (_, source), y in sound.whitened.items() if source.startswith("gnss"))
    found = bound(sound, sound, BEGIN_S, END_S)
    assert (found["beyond_s"], found["detected_s"], found["least_m"]) == (None, None, 0.0)


def test_twice_a_fault_says_four_times_as_much() -> None:
    """The filter is linear as long as the fault is small."""
    sound = drive()[1]
    one, two = (faulty(partial(measurement.position_step, north_m=size)) for size in (1.0, 2.0))
    (times, single), (same, double) = (
        detection_information(sound, each, BEGIN_S) for each in (one, two)
    )
    assert np.array_equal(times, same)
    assert (np.diff(single) >= 0.0).all()
    assert double[-1] == pytest.approx(4.0 * single[-1], rel=0.1)


def test_a_force_is_told_at_once_and_a_step_of_two_metres_is_not() -> None:
    """What fixes of 1.5 m say of 2 m, once a second, is less than a filter believes of itself."""
    sound = drive()[1]
    force = bound(sound, faulty(partial(imu.bias_step, size=0.5, axis=3)), BEGIN_S, END_S)
    assert force["beyond_s"] < 1.0
    assert force["beyond_s"] < force["open_s"] <= force["detected_s"] < 3.0
    assert not force["lies"]
    step = bound(sound, faulty(partial(measurement.position_step, north_m=2.0)), BEGIN_S, END_S)
    assert step["detected_s"] is None
    assert step["information"] == sorted(step["information"])


def test_what_is_asked_is_every_fault_and_the_rows_that_lie() -> None:
    found = jobs(2)
    assert len(found) == 2 * 2 * len(FAULTS) + len(ROWS)
    assert OPEN < DETECTED


def test_its_table_has_a_line_a_fault() -> None:
    row = {
        "fault": "force",
        "where": "code",
        "beyond_s": 0.4,
        "open_s": 1.0,
        "detected_s": None,
        "lie_s": 2.5,
        "lies": True,
        "least_m": 1.25,
    }
    text = TABLES["bounds"]([row, {**row, "detected_s": 3.0, "lie_s": 0.6, "lies": False}])
    assert "| force | code | 2 | 0.4, 0.4 | 1, 1 | never, 3 | 1 | 2.5 | 1.25 |" in text
    assert text.endswith("2 runs; in 1 no test keeps from a lie.\n")
