"""What rounding leaves of a speed, against speeds that were rounded."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drivers.quantization import SHARED_SD, Rounding, rounded_speed

STEP = 1.0 / 3.6


@pytest.mark.parametrize("rounding", ["nearest", "down"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_mean_and_sigma_are_those_of_rounded_speeds(rounding: Rounding, sign: float) -> None:
    true = np.random.default_rng(2).uniform(5.0, 30.0, 20_000)
    count = np.floor(true / STEP) if rounding == "down" else np.round(true / STEP)
    found = [rounded_speed(sign * float(c) * STEP, STEP, rounding) for c in count]
    error = np.array([r.mean_m_s for r in found]) - sign * true
    (sd,) = {r.sd_m_s for r in found}
    assert abs(error.mean()) < 4.0 * sd / math.sqrt(len(error))
    assert error.std() == pytest.approx(sd, rel=0.02)


def test_where_it_is_not_known_which_both_are_within_its_sigma() -> None:
    true = np.random.default_rng(3).uniform(5.0, 30.0, 20_000)
    count = np.where(np.arange(20_000) % 2, np.floor(true / STEP), np.round(true / STEP))
    found = [rounded_speed(float(c) * STEP, STEP, "unknown") for c in count]
    error = np.array([r.mean_m_s for r in found]) - true
    assert abs(error.mean()) < 0.01 * STEP
    assert error.std() == pytest.approx(found[0].sd_m_s, rel=0.02)
    # What those of one manner share.
    assert {r.shared_step_m_s for r in found} == {STEP}
    shared = [error[0::2].mean(), error[1::2].mean()]
    assert np.abs(shared) == pytest.approx([SHARED_SD * STEP] * 2, rel=0.05)


def test_zero_is_a_speed_below_one_step_either_way() -> None:
    true = np.random.default_rng(4).uniform(-STEP, STEP, 20_000)
    mean, sd, shared = rounded_speed(0.0, STEP, "unknown")
    assert (mean, shared) == (0.0, 0.0)
    assert true.std() == pytest.approx(sd, rel=0.02)


def test_a_device_without_steps() -> None:
    assert rounded_speed(0.3, 0.0) == (0.3, 0.0, 0.0)
    assert rounded_speed(0.0, 0.0) == (0.0, 0.0, 0.0)
