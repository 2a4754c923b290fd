"""A few seconds at rest of an inertial unit: how good it is, and that it is none of its class."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.sensor_class import CLASSES, SensorClass
from fusiond.configuration.si_units import imu_noise
from fusiond.navigator.imu_grade import AS_ITS_CLASS, GRID, Values, graded_at_rest
from fusiond.navigator.imu_worse_than_class import grades_of, widened, worse_than_said
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.matched_noise_drives import CODE, Vehicle, scene
from fusiond.studies.faults.solution_errors import errors_against, longest_s

UNITS, UNSEEN = 400, 0.02
END_S = 45.0


@pytest.mark.parametrize("share", [0.2, 1.0 / 3.0, 1.0])
@pytest.mark.parametrize("apart", [1.0, 1.4])
def test_the_accelerometers_that_nothing_shows_are_as_good_as_what_is_seen(
    share: float, apart: float
) -> None:
    """Of 400 units whose accelerometers are of the gyros' share of their class, or 1.4 times as
    good or as bad: the square of what is not seen is right by the grade in the mean."""
    rng, squares = np.random.default_rng(7), []
    for unit in range(UNITS):
        of_forces = share * apart ** (unit % 3 - 1)
        rates = share * rng.standard_normal(3) + UNSEEN * rng.standard_normal(3)
        force = of_forces * rng.standard_normal(1) + UNSEEN * rng.standard_normal(1)
        seen = [
            Values(each, np.ones(len(each)), np.full(len(each), UNSEEN**2))
            for each in (rates, force)
        ]
        grades = graded_at_rest(*seen)
        assert grades.shape == AS_ITS_CLASS.shape
        assert GRID[0] < grades.min() <= grades.max() < GRID[-1]
        squares.append(of_forces**2 / grades[3])
    print(share, apart, np.mean(squares).round(2))
    assert 0.5 < np.mean(squares) < 1.4


def test_units_of_their_class_are_taken_for_such_and_others_are_not() -> None:
    """Two rates of a class of one: 998 of a thousand are left alone; of units ninety and 540 times
    as bad 98 of a hundred are known to within a factor of three of their sigma."""
    rng = np.random.default_rng(8)
    own = [worse_than_said(rng.standard_normal(2), 1.0, UNSEEN**2) for _ in range(1000)]
    assert sum(grade > 1.0 for grade in own) <= 2
    for times in (90.0, 540.0):
        found = [
            math.sqrt(worse_than_said(times * rng.standard_normal(2), 1.0, UNSEEN**2)) / times
            for _ in range(200)
        ]
        print(times, np.percentile(found, (1, 50, 99)).round(2))
        assert np.mean(np.array(found) > 1.0 / 3.0) > 0.95
        assert np.percentile(found, 99) < 6.0


def test_what_is_worse_in_its_gyros_is_so_in_all_else() -> None:
    """A step of the ladder is the class there, and what a sheet has worse stays."""
    noises = {name: imu_noise(Imu.model_validate({"sensor_class": name})) for name in CLASSES}
    told, true = noises["tactical"], noises["consumer"]
    grade = (true.rate_bias_initial / told.rate_bias_initial) ** 2
    found = widened(told, grade)
    assert found.force_bias_initial == pytest.approx(true.force_bias_initial)
    assert found.rate_scale == pytest.approx(true.rate_scale)
    assert found.bias_correlation_s == told.bias_correlation_s
    coarse = replace(told, force_bias_initial=10.0 * true.force_bias_initial)
    assert widened(coarse, grade).force_bias_initial == coarse.force_bias_initial
    assert widened(told, 1.0) is told
    axes = math.radians(CLASSES["tactical"]["misalignment_deg"])
    assert grades_of(found, told, axes)[-1] == pytest.approx(16.0)
    assert np.array_equal(grades_of(told, told, axes), AS_ITS_CLASS)


@pytest.mark.parametrize(("sensor", "told"), [("consumer", "tactical"), ("mems", "tactical")])
@pytest.mark.parametrize("drive", [0, 1])
def test_a_class_that_is_too_good_costs_no_lie(
    sensor: SensorClass, told: SensorClass, drive: int
) -> None:
    """Fifteen seconds at rest, and half a minute. Of a consumer unit that was called tactical the
    start was one on the move, after 85 s, and lied for half a minute. The yaw gyro of drive 960 is
    off by more than 2 deg/s: it is met on the move, where it fits no tactical unit."""
    on = scene(Vehicle(sensor, CODE, told="class"), "looked", 960 + drive, END_S)
    imu = {**on.config.imu.model_dump(include={"axes", "rate_hz"}), "sensor_class": told}
    own = {**on.config.model_dump(exclude_unset=True), "imu": imu}
    starts: list[str] = []

    def watch(navigator: Navigator) -> None:
        if navigator.started is not None:
            starts.append(navigator.started.how)

    ticks = on.truth.at(np.arange(0.1, END_S, 0.1))
    run = errors_against(Config.model_validate(own), on.recording, ticks, watch=watch)
    nees = np.nanmean(np.square(run.errors[run.there] / run.sigmas[run.there]), axis=0)
    print(sensor, told, drive, nees.round(2))
    moving = sensor == "consumer" and drive == 0
    assert set(starts) == {"GNSS course, on the move" if moving else "GNSS course"}
    assert longest_s(run.beyond) == 0.0
    assert nees.max() < 5.0
