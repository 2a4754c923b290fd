"""Units of the IMU: told of a running vehicle by what `fusiond process` refuses files for."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.measurements import PositionFix
from fusiond.configuration.schema import Config
from fusiond.navigation.solution import Mode
from fusiond.navigator.imu_unit_check import (
    CourseTurns,
    RateUnits,
    force_unit,
    other_unit,
    rms_unit,
)
from fusiond.navigator.navigator import Navigator
from tests.navigator.vehicle import CONFIG, RATE_HZ, START_NS, Array, drive, started

GRAVITY_M_S2 = 9.80665
SHEET_RAD_S = math.radians(0.1)
"""One sigma of the gyro's bias by the default of [imu]."""


def _driven(
    change: Callable[[Array], Array], settings: dict[str, Any] = CONFIG
) -> tuple[Navigator, list[tuple[str, str]]]:
    """The drive, its samples (n, 6) changed once the filter runs, and what was told."""
    told: list[tuple[str, str]] = []
    navigator, row = started(settings, on_event=lambda code, text: told.append((code, text)))
    d = drive()
    samples = change(d.samples.copy())
    waiting = list(d.measurements)
    while row < len(d.times):
        navigator.add_imu(d.times[row : row + 10], samples[row : row + 10])
        row += 10
        while waiting and waiting[0].t_seen_ns <= navigator.imu.latest_ns:
            navigator.add(waiting[0], waiting.pop(0).t_seen_ns)
        navigator.advance()
    return navigator, told


def test_rates_in_deg_s_are_told_in_the_first_bend_and_nothing_is_vouched_for() -> None:
    def in_degrees(samples: Array) -> Array:
        samples[:, :3] *= 180.0 / math.pi
        return samples

    navigator, told = _driven(in_degrees)
    texts = [text for code, text in told if code == "imu_units"]
    assert len(texts) == 1
    factor = int(texts[0].split("Rates are ")[1].split(" times")[0])
    assert 40 <= factor <= 65  # 57, less what the course's noise takes off
    mode, why = navigator.mode(navigator.imu.latest_ns)
    assert mode is Mode.INVALID
    assert "they look like deg/s" in why


@pytest.mark.parametrize(
    ("block", "axis", "bias", "said"),
    [
        ("gyro_bias", 2, math.radians(-0.6), "Gyro bias of 0.6 deg/s is 6 sigma of [imu]"),
        ("accel_bias", 0, 0.49, "Accelerometer bias of 0.49 m/s^2 is 5 sigma of [imu]"),
    ],
)
def test_a_bias_of_no_data_sheet_is_not_vouched_for_until_a_bend_shows_the_unit(
    block: str, axis: int, bias: float, said: str
) -> None:
    """Rates in deg/s have such a bias; so has a gyro that is worse than its sheet."""
    d, navigator = drive(), started()[0]
    estimator, units = navigator.estimator, RateUnits(SHEET_RAD_S, lambda code, text: None)
    assert units.unproven(estimator)[0] is None
    estimator.xi[navigator.model.slots_of(block)[axis]] = bias
    assert str(units.unproven(estimator)[0]).startswith(said)
    navigator.imu.append(d.times[navigator.imu.end :], d.samples[navigator.imu.end :])
    fixes = [m for m in d.measurements if isinstance(m, PositionFix)]
    for m in fixes:
        units.fix(m, m.t_seen_ns, navigator.imu, ())
        turning = m.t_seen_ns > START_NS + 19_000_000_000  # 30 deg of the first bend
        assert (units.unproven(estimator)[0] is None) == turning
    units.change()  # of the spare's unit nothing is known
    assert str(units.unproven(estimator)[0]).startswith(said)


def test_good_rates_are_not_spoken_of() -> None:
    navigator, told = _driven(lambda samples: samples)
    assert [code for code, _ in told if code.startswith("imu")] == []
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.NAVIGATING


def test_a_spare_with_such_a_bias_is_not_vouched_for_before_a_bend() -> None:
    """The unit of the first IMU has been shown, and says nothing of the spare's."""
    imu = {**CONFIG["imu"], "spare": {"source": "second"}}
    navigator, _ = _driven(lambda samples: samples, {**CONFIG, "imu": imu})
    gyro_z = navigator.model.slots_of("gyro_bias")[2]
    navigator.estimator.xi[gyro_z] = math.radians(0.6)
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.NAVIGATING
    navigator.change_imu()
    navigator.estimator.xi[gyro_z] = math.radians(0.6)
    mode, why = navigator.mode(navigator.imu.latest_ns)
    assert mode is Mode.COASTING
    assert "Gyro bias of 0.6 deg/s is 6 sigma of [imu]" in why


def test_a_unit_that_is_corrected_is_believed_after_the_next_bend() -> None:
    half = round(22.0 * RATE_HZ)  # between the two bends

    def in_degrees_first(samples: Array) -> Array:
        samples[:half, :3] *= 180.0 / math.pi
        return samples

    codes = [code for code, _ in _driven(in_degrees_first)[1]]
    assert [code for code in codes if "units" in code] == ["imu_units", "imu_units_well"]


def test_a_carousel_of_12_rad_s_needs_no_fix() -> None:
    def carousel(samples: Array) -> Array:
        samples[:, 2] += 12.0
        return samples

    navigator = Navigator(Config.model_validate(CONFIG), on_event=lambda *e: told.append(e))
    told: list[tuple[str, str]] = []
    d = drive()
    navigator.add_imu(d.times, carousel(d.samples.copy()))
    texts = [text for code, text in told if code == "imu_units"]
    assert texts[0].startswith("Rates of 12 rad/s RMS exceed a vehicle's: they look")


@pytest.mark.parametrize(
    ("factor", "name", "code"),
    [
        (1.0 / GRAVITY_M_S2, "g", "imu_no_gravity"),
        (1e3 / GRAVITY_M_S2, "milli-g", "imu_out_of_range"),
    ],
)
def test_forces_in_another_unit_are_named_where_they_are_refused(
    factor: float, name: str, code: str
) -> None:
    def scaled(samples: Array) -> Array:
        samples[:, 3:] *= factor
        return samples

    texts = dict(_driven(scaled)[1])
    assert f"looks like {name}: multiply the accelerometer's figures by" in texts[code]


def test_free_fall_is_no_unit() -> None:
    def fall(samples: Array) -> Array:
        samples[:, 3:] *= 1e-3
        return samples

    assert "looks like" not in dict(_driven(fall)[1])["imu_no_gravity"]


@pytest.mark.parametrize("magnitude", [4.95, 9.81, 19.5])
def test_forces_of_a_vehicle_are_no_other_unit(magnitude: float) -> None:
    assert force_unit(magnitude) is None
    assert other_unit(magnitude) is None


def test_the_sentence_says_what_to_do() -> None:
    assert "it looks like g; multiply the accelerometer's figures by 9.80665" in str(
        force_unit(1.0)
    )
    assert "cm/s^2" in str(force_unit(981.0)) or "milli-g" in str(force_unit(981.0))
    assert str(force_unit(0.02)).endswith("another unit, or gravity removed")
    assert rms_unit(1.0) is None


@pytest.mark.parametrize("k", [0.5, 1.0, 5.0, -1.0])
def test_a_poor_gyro_is_not_taken_for_another_unit(k: float) -> None:
    """Half, five times, the wrong sign: something else is wrong with it."""
    turns = CourseTurns()
    for second in range(40):
        course = 0.1 * second
        velocity = (10.0 * math.cos(course), 10.0 * math.sin(course))
        turns.fix(second * 1_000_000_000, velocity, lambda a, b: k * 0.1 * (b - a) * 1e-9)
    assert turns.decided
    assert turns.said() is None


def test_straight_on_with_a_noisy_course_nothing_is_decided() -> None:
    turns, rng = CourseTurns(), np.random.default_rng(3)
    for second in range(30):
        turns.fix(second * 1_000_000_000, (20.0, 0.1 * rng.standard_normal()), lambda a, b: 1.0)
    assert not turns.decided
    assert turns.said() is None
