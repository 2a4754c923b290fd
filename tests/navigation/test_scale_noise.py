"""Scale factors without states: what is noise of them, by what a bend and a stop leave."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.configuration.schema import Config
from fusiond.navigation.crosstalk_noise import STOP_M_S, WITHIN_FIXES_M_S, Crosstalk
from fusiond.navigator.navigator import Navigator

PERIOD_S, G = 0.02, 9.8
RATE_SCALE, FORCE_SCALE = 5e-3, 3e-3
REST = np.tile([0.002, 0.0, -0.003, 0.0, 0.0, -G], (6000, 1))
"""Two minutes with gyros that are biased."""


def left(samples: np.ndarray, chunk: int = 1 << 20) -> np.ndarray:
    """One sigma (6,) of what it adds over `samples`, behind two minutes at rest."""
    said = np.vstack((REST, samples))
    out, times = np.zeros_like(said), np.arange(len(said)) * round(PERIOD_S * 1e9)
    noise = Crosstalk(PERIOD_S, 0.0, RATE_SCALE, FORCE_SCALE)
    for start in range(0, len(said), chunk):
        part = slice(start, start + chunk)
        noise.follow(times[part], said[part], out[part])
    sd: np.ndarray = np.sqrt(out[len(REST) :].sum(axis=0) * PERIOD_S)
    return sd


def bend(axis: int, rate: float, seconds: float) -> np.ndarray:
    """A turn, and five seconds at rest."""
    samples = np.tile(REST[0], (round((seconds + 5.0) / PERIOD_S), 1))
    samples[: round(seconds / PERIOD_S), axis] += rate
    return samples


@pytest.mark.parametrize("axis", range(3))
def test_a_corner_leaves_its_share_of_the_turn_about_its_axis(axis: int) -> None:
    found = left(bend(axis, math.pi / 8.0, 4.0))
    assert found[axis] == pytest.approx(RATE_SCALE * math.pi / 2.0, rel=0.15)
    others = [k for k in range(3) if k != axis]
    assert found[others].max() < 0.05 * found[axis]


def test_a_stop_leaves_its_share_of_what_counts_between_fixes() -> None:
    stop = bend(0, 0.0, 2.5)
    stop[: round(2.5 / PERIOD_S), 3] -= STOP_M_S / 2.5
    counts = math.sqrt(STOP_M_S * WITHIN_FIXES_M_S)
    assert left(stop)[3] == pytest.approx(FORCE_SCALE * counts, rel=0.15)


def test_biases_and_gravity_are_none_of_it_and_chunks_do_not_count() -> None:
    assert left(REST[:3000]).max() < 1e-9
    corner = bend(2, 0.4, 4.0)
    assert np.array_equal(left(corner), left(corner, 7))


@pytest.mark.parametrize(("model", "noisy"), [("ins15", True), ("ins20", True), ("ins21", False)])
def test_a_model_with_states_for_them_has_no_such_noise(model: str, noisy: bool) -> None:
    """Of the configuration's default the axes are square."""
    navigator = Navigator(Config.model_validate({"estimator": {"model": model}}))
    assert (navigator.imu.crosstalk is not None) is noisy
    assert navigator.model.scale_factors is not noisy


def test_one_mean_serves_axes_out_of_square_and_scale_factors() -> None:
    """Together they add what each adds alone; a grade of the axes is none of the scale factors."""
    samples = np.vstack((REST, bend(0, 0.4, 4.0)))
    times = np.arange(len(samples)) * round(PERIOD_S * 1e9)

    def added(misalignment: float, scales: tuple[float, float], square: float) -> np.ndarray:
        out = np.zeros_like(samples)
        noise = Crosstalk(PERIOD_S, misalignment, *scales)
        noise.squares.add(0, np.array([square]))
        noise.follow(times, samples, out)
        return out

    both = added(3e-3, (RATE_SCALE, FORCE_SCALE), 0.25)
    alone = added(3e-3, (0.0, 0.0), 0.25) + added(0.0, (RATE_SCALE, FORCE_SCALE), 1.0)
    assert both == pytest.approx(alone, rel=1e-12)
    assert added(3e-3, (0.0, 0.0), 0.25) == pytest.approx(0.25 * added(3e-3, (0.0, 0.0), 1.0))
