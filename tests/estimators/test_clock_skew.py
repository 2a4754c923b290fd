"""A receiver whose clock runs faster than that of the inertial unit: offsets in time that grow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.models.vehicle_parameter_blocks import (
    CLOCK_SKEW,
    CLOCK_SKEW_SD,
    FIX_TIME,
    RATED_TIME_WALK_S_SQRT_S,
    TIME_WALK_S_SQRT_S,
    VELOCITY_TIME,
)
from fusiond.navigator.assembly import model_of
from fusiond.navigator.intake import Intake
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.matched_noise_drives import CODE, RTK, Vehicle, scene
from fusiond.studies.faults.sensor_data import Recording
from fusiond.studies.faults.solution_errors import errors_against

SKEW = 250e-6
"""As of the unit of drive_0708: 0.1 s in 400 s."""
LENGTH_S = 300.0


def test_it_is_the_rate_of_both_offsets() -> None:
    config = Vehicle("mems", CODE, told="noise").config()
    model = model_of(config, *Intake(config.aiding, config.plausibility).extra_blocks())
    [skew] = model.slots_of(CLOCK_SKEW)
    offsets = [*model.slots_of(FIX_TIME), *model.slots_of(VELOCITY_TIME)]
    assert model.rate_terms.tolist() == [offsets, [skew, skew]]
    assert model.initial[skew] == CLOCK_SKEW_SD
    assert model.noise[1, offsets].tolist() == [RATED_TIME_WALK_S_SQRT_S**2] * 2


def test_it_goes_first_where_there_is_no_room() -> None:
    """Of a car with wheels and a lever arm that nobody gave, 41 states; 40 fit."""
    config = Config.model_validate(
        {
            "imu": {"axes": ("+x", "+y", "+z"), "sensor_class": "consumer", "rate_hz": 100.0},
            "aiding": {"gnss": {}, "wheel": {}},
            "constraints": {"non_holonomic": {"enabled": True}},
            "estimator": {"model": "ins21"},
        }
    )
    model = Navigator(config).model
    assert not model.slots_of(CLOCK_SKEW)
    assert model.slots_of("gnss_wander")
    assert model.rate_terms.shape == (2, 0)
    offsets = [*model.slots_of(FIX_TIME), *model.slots_of(VELOCITY_TIME)]
    assert model.noise[1, offsets].tolist() == [TIME_WALK_S_SQRT_S**2] * 2


@pytest.mark.parametrize("skew", [SKEW, 0.0])
def test_fixes_of_a_fast_clock_are_followed_and_nobody_is_accused(skew: float) -> None:
    """Stamps that grow late by 0.25 ms a second: 75 ms in the end."""
    on = scene(Vehicle("mems", RTK, told="noise"), "looked", 5, LENGTH_S)
    ns = (on.recording.stamps * (1.0 + skew)).astype(np.int64)
    seen = (on.recording.imu_seen * (1.0 + skew)).astype(np.int64)
    by_its_clock = Recording(ns, seen, on.recording.samples, on.recording.received)
    seen_states = []

    def watch(navigator: Navigator) -> None:
        if navigator.started is not None:
            e = navigator.estimator
            [slot], [offset] = e.model.slots_of(CLOCK_SKEW), e.model.slots_of(FIX_TIME)
            variance = float(e.covariance[slot, slot])
            seen_states.append((e.xi.item(slot), np.sqrt(variance), e.xi.item(offset)))

    ticks = np.arange(1.0, 10.0 * LENGTH_S - 5.0) * 0.1
    run = errors_against(on.config, by_its_clock, on.truth.at(ticks), None, watch)
    found, sd, offset_s = seen_states[-1]
    assert found == pytest.approx(skew, abs=4.0 * sd)
    assert sd < 0.7 * CLOCK_SKEW_SD
    assert offset_s == pytest.approx(LENGTH_S * skew, abs=0.03)
    assert not {e.code for e in run.events} & {"isolated", "sensor_fault"}


def test_a_rate_that_steps_is_followed_and_steady_clocks_cost_nothing() -> None:
    """By 200 ppm in the middle of the drive, or not at all: horizontal sigma of ten fixes a second
    of 2 cm was 1.4 times the error while each offset walked by 1 ms/sqrt(s) beside its rate."""
    receiver = replace(RTK, rate_hz=10.0)
    on = scene(Vehicle("mems", receiver, told="class"), "looked", 5, LENGTH_S)
    ticks = np.arange(1.0, 10.0 * LENGTH_S - 5.0) * 0.1
    for step in (200e-6, 0.0):
        ns, seen = on.recording.stamps, on.recording.imu_seen
        late = [np.maximum(t - 150_000_000_000, 0) * step for t in (ns, seen)]
        ns, seen = ns + late[0].astype(np.int64), seen + late[1].astype(np.int64)
        stepped = Recording(ns, seen, on.recording.samples, on.recording.received)
        run = errors_against(on.config, stepped, on.truth.at(ticks))
        steady = run.t_s > 60.0
        error, sigma = run.errors[steady, :2], run.sigmas[steady, :2]
        over = float(np.sqrt((sigma**2).mean() / (error**2).mean()))
        print(f"{step:g}: sigma over RMS {over:.2f}")
        assert 0.85 < over < 1.25
        assert not {e.code for e in run.events} & {"isolated", "sensor_fault"}
