"""What a unit shows of its noise: a share of what shakes it, and its grade within its class."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from fusiond.configuration.schema import Config
from fusiond.configuration.sensor_class import CLASSES
from fusiond.models.model import Model
from fusiond.navigator.assembly import model_of
from fusiond.navigator.imu_grade import UnitGrade
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.matched_noise_drives import (
    RATE_HZ,
    RTK,
    Vehicle,
    part_generator,
    scene,
)
from fusiond.studies.faults.sensor_data import Recording
from fusiond.studies.faults.solution_errors import errors_against

Array = NDArray[np.float64]

DURATION_S = 300.0
SHAKEN_RAD_S = 0.02
"""One sigma of a sample of gyro: some twenty times the noise of a `mems` unit at 50 Hz."""


def _shares(added: Array, number: int) -> tuple[list[float], Array]:
    """Shares that counted on a drive with `added` (n, 3) in its gyros, and published sigmas."""
    on = scene(Vehicle("mems", RTK, told="noise"), "looked", number, DURATION_S)
    samples = on.recording.samples.copy()
    samples[:, :3] += added[: len(samples)]
    recording: Recording = replace(on.recording, samples=samples)
    found: list[float] = []

    def watch(navigator: Navigator) -> None:
        vibration = navigator.imu.vibration
        assert vibration is not None
        now = np.array([navigator.imu.latest_ns])
        found.extend(float(shares[:2].max()) for _, shares in vibration.shares.rows(now))

    ticks = on.truth.at(np.arange(0.1, DURATION_S, 0.1))
    run = errors_against(on.config, recording, ticks, watch=watch)
    return found, run.sigmas


@pytest.mark.parametrize("number", [950, 951])
def test_white_noise_is_noise_and_motion_that_comes_back_is_not(number: int) -> None:
    """Both shake every sample by as much, and means of up to 16 of them. The gyros really turn with
    the second: a body that road and springs rock at 2 to 6 Hz."""
    rng = part_generator("looked", number, 7)
    white = rng.standard_normal((round(DURATION_S * RATE_HZ) + 1, 3)) * SHAKEN_RAD_S
    b, a = butter(2, (2.0, 6.0), "bandpass", fs=RATE_HZ)
    rocked = lfilter(b, a, white, axis=0)
    rocked *= SHAKEN_RAD_S / rocked.std(axis=0)
    of_white, _ = _shares(white, number)
    of_rocked, _ = _shares(rocked, number)
    print(np.round(of_white[::100], 2), np.round(of_rocked[::100], 2))
    assert min(of_white) > 0.6
    assert min(of_rocked) < 0.4  # it rises where a bend makes an error of what rocks


def _model(sensor: str) -> Model:
    config = {"imu": {"sensor_class": sensor}, "estimator": {"model": "ins21"}}
    return model_of(Config.model_validate(config))


@pytest.mark.parametrize("sensor", CLASSES)
@pytest.mark.parametrize("share", [0.2, 1.0 / 3.0, 1.0])
def test_a_unit_is_as_good_as_its_biases(sensor: str, share: float) -> None:
    """What no drive shows is of the same grade; by the one that is found its square is right in the
    mean, of 400 units whose biases are known to a tenth of what they are, and whose scale factors,
    but for that of the vertical gyro, are not."""
    model, rng = _model(sensor), np.random.default_rng(42)
    grade = UnitGrade(model)
    prior = model.initial.copy()
    p = np.square(prior)
    biases = model.slots_of("gyro_bias") + model.slots_of("accel_bias")
    shown = [*biases, model.slots_of("gyro_scale")[2]]
    p[shown] = np.square(0.1 * share * prior[shown])
    squares = []
    for _ in range(400):
        xi = np.zeros(model.size)
        true = share * prior[shown] * rng.standard_normal(len(shown))
        r = p[shown] * prior[shown] ** 2 / (prior[shown] ** 2 - p[shown])
        seen = true + np.sqrt(r) * rng.standard_normal(len(shown))
        xi[shown] = seen * p[shown] / r
        squares.append(share**2 / grade.of(xi, np.diag(p)))
    print(sensor, share, np.mean(squares).round(2))
    assert 0.6 < np.mean(squares) < 1.4


def test_before_anything_is_shown_a_unit_is_about_what_its_class_says() -> None:
    model = _model("mems")
    nothing = UnitGrade(model).of(np.zeros(model.size), np.diag(np.square(model.initial)))
    assert 0.5 < nothing < 1.0
