"""Typed white noise of wheels, side slip and compasses, as innovations show it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.measurements import MonotonicStamp, WheelSpeed
from fusiond.aiding.body_velocity import WheelSpeedMeasurement
from fusiond.configuration.aiding import WheelAiding
from fusiond.configuration.schema import Config
from fusiond.navigator.aiding_drift_sigma_estimation import DriftLevels
from fusiond.navigator.assembly import model_of
from fusiond.navigator.imu_vibration_noise_share import COUNTS_NS, EVERY_NS
from fusiond.navigator.intake import Intake
from fusiond.navigator.sensor_white_noise import FIRST, LEAST, WhiteNoise

SD, LASTS_S, RATE_HZ = 0.1, 1.0, 10.0
NAME = "wheel"


def _shown(
    seed: int,
    white: float,
    drift: float = 0.0,
    rounding: float = 0.0,
    seconds: float = 300.0,
    moving: bool = True,
) -> tuple[WhiteNoise, int]:
    """After so many seconds of a series with white noise and a drift of these sigmas, and when."""
    rng, found = np.random.default_rng(seed), WhiteNoise()
    found.counts(NAME, 0, SD, LASTS_S, rounding)
    kept, slow, until_ns = math.exp(-1.0 / (RATE_HZ * LASTS_S)), 0.0, EVERY_NS
    for k in range(round(seconds * RATE_HZ)):
        t_ns = round(k * 1e9 / RATE_HZ)
        slow = kept * slow + math.sqrt(1.0 - kept * kept) * drift * rng.standard_normal()
        if t_ns > until_ns:
            found.settle(until_ns, until_ns + COUNTS_NS, moving)
            until_ns += EVERY_NS
        noise = math.hypot(white, rounding) * rng.standard_normal()
        found.receive(NAME, t_ns, slow + noise)
    return found, until_ns + COUNTS_NS


def _counts(found: WhiteNoise, t_ns: int) -> float:
    return found.counts(NAME, t_ns, SD, LASTS_S)


@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_white_noise_counts_as_much_as_there_is(share: float) -> None:
    """Variances of 20 sensors, five minutes each, with steps whose rounding is no part of them."""
    shown = [_shown(seed, share * SD, rounding=0.05) for seed in range(20)]
    squares = [_counts(*each) ** 2 for each in shown]
    n = shown[0][0].shown[NAME][0]
    expected = (n * share**2 + FIRST) / (n + FIRST)
    print(share, np.mean(squares), expected)
    assert max(squares) <= 1.0
    assert np.mean(squares) == pytest.approx(expected, rel=0.1)


def test_a_drift_is_never_less_noise_but_more() -> None:
    """What lasts for less than its state says is counted as white, not forgotten."""
    steady, drifts = (_counts(*_shown(3, 0.02, drift)) for drift in (0.0, 0.05))
    assert steady < drifts < 0.6
    assert _counts(*_shown(3, 0.3)) == 1.0


def test_one_that_repeats_itself_keeps_an_eighth() -> None:
    found, t_ns = _shown(1, 0.0)
    n = found.shown[NAME][0]
    assert _counts(found, t_ns) == pytest.approx(math.sqrt((n * LEAST + FIRST) / (n + FIRST)))


def test_a_vehicle_at_rest_shows_nothing() -> None:
    found, t_ns = _shown(1, 0.0, moving=False)
    assert _counts(found, t_ns) == 1.0
    assert found.shown[NAME] == (0.0, 0.0)


def test_what_a_rewind_takes_back_does_not_count_and_what_it_changes_counts_once() -> None:
    found = WhiteNoise()
    found.counts(NAME, 0, SD, LASTS_S)
    for k, innovation in enumerate((0.0, 5.0, 0.1)):
        found.receive(NAME, k * 500_000_000, innovation)
    found.receive(NAME, 500_000_000, math.nan)  # gated now
    found.receive(NAME, 1_000_000_000, 0.2)
    found.settle(EVERY_NS, COUNTS_NS, moving=True)
    assert found.shown[NAME] == pytest.approx((1.0, 0.5 * 0.2**2 / SD**2))


def test_gaps_are_no_pairs() -> None:
    found = WhiteNoise()
    found.counts(NAME, 0, SD, LASTS_S)
    for k in range(4):
        found.receive(NAME, k * 2_000_000_000, float(k))
    found.settle(EVERY_NS, COUNTS_NS, moving=True)
    assert found.shown[NAME] == (0.0, 0.0)


def test_it_counts_once_nothing_earlier_comes_and_is_kept_for_the_next_start() -> None:
    found, t_ns = _shown(2, 0.02, seconds=20.0)
    assert _counts(found, COUNTS_NS) == 1.0
    assert _counts(found, t_ns) < 1.0
    after = WhiteNoise()
    after.take_up(found.shown)
    assert _counts(after, 0) == _counts(found, t_ns)
    assert after.counts("another", 0, SD, LASTS_S) == 1.0


def test_the_door_states_what_is_shown_beside_the_rounding() -> None:
    config = Config.model_validate({"aiding": {"gnss": {}, "wheel": {}}})
    intake, levels = Intake({"wheel": WheelAiding()}), DriftLevels(model_of(config))
    levels.white.take_up({"wheel": (600.0, 0.0)})
    intake.count_drifts(levels)
    wheel = WheelSpeed("wheel", 5, MonotonicStamp(5), 10.0, rounding_sd_m_s=0.08)
    (one,) = intake.measurements_of(wheel, 5, 0.0)
    assert isinstance(one, WheelSpeedMeasurement)
    c = math.sqrt((600.0 * LEAST + FIRST) / (600.0 + FIRST))
    assert one.sd_m_s == pytest.approx(math.hypot(0.1 * c, 0.08))
