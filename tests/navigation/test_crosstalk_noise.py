"""Axes out of square: what is noise of it, by sums of what drawn matrices do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.navigation.crosstalk_noise import STOP_M_S, Crosstalk

PERIOD_S, G = 0.02, 9.8
MISALIGNED = math.radians(0.2)
REST = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -G], (6000, 1))


def stamps(samples: np.ndarray) -> NDArray[np.int64]:
    return np.arange(len(samples)) * round(PERIOD_S * 1e9)


def densities(samples: np.ndarray, misalignment: float = MISALIGNED) -> np.ndarray:
    """After each of `samples`, behind two minutes at rest."""
    out = np.zeros((len(REST) + len(samples), 6))
    said = np.vstack((REST, samples))
    Crosstalk(PERIOD_S, misalignment).follow(stamps(said), said, out)
    return out[len(REST) :]


def turning(axis: int, rate: float, seconds: float) -> np.ndarray:
    samples = REST[: round(seconds / PERIOD_S)].copy()
    samples[:, axis] = rate
    return samples


def test_a_vehicle_that_turns_about_its_vertical_learns_nothing_wrong() -> None:
    """Its gyros tell the turn of a body that is turned by a constant."""
    corner = turning(2, 0.4, 4.0)
    assert densities(corner)[:, :3].max() < 1e-3 * densities(turning(0, 0.4, 4.0))[:, :3].max()


def test_gyros_out_of_square_tell_the_turn_of_a_turned_body() -> None:
    """The claim itself: the attitude that they tell is the true one times a constant turn."""
    rng = np.random.default_rng(1)
    m = rng.normal(0.0, MISALIGNED, (3, 3))
    told, true = np.eye(3), np.eye(3)

    def turned(c: np.ndarray, w: np.ndarray, h: float) -> np.ndarray:
        angle = float(np.linalg.norm(w) * h)
        x, y, z = w / np.linalg.norm(w)
        k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        step: np.ndarray = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * k @ k
        return c @ step

    w = np.array([0.0, 0.0, 0.4])
    np.fill_diagonal(m, 0.0)
    apart = []
    for _ in range(4000):
        told, true = turned(told, w + m @ w, PERIOD_S), turned(true, w, PERIOD_S)
        apart.append(np.linalg.norm((told @ true.T - np.eye(3))[2, :2]))
    assert max(apart) < 2.1 * float(np.linalg.norm(m[:2, 2]))  # five turns, and no more than this
    assert np.linalg.norm((told - true)[:, 2]) < 2.1 * float(np.linalg.norm(m[:2, 2]))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_bend_about_another_axis_leaves_the_angle_across_it(axis: int) -> None:
    bend = densities(turning(axis, 0.5, math.pi))
    across = math.sqrt(float(bend[:, 2].sum()) * PERIOD_S)
    assert across == pytest.approx(0.5 * math.pi * MISALIGNED, rel=0.15)
    assert bend[:, axis].max() < 1e-3 * bend[:, 2].max()


def test_a_stop_leaves_a_velocity_down_and_little_along() -> None:
    stop = REST[: round(2.5 / PERIOD_S)].copy()
    stop[:, 3] = -STOP_M_S / 2.5
    stop = np.vstack((stop, REST[:100]))
    left = np.sqrt(densities(stop)[:, 3:].sum(axis=0) * PERIOD_S)
    assert left[2] == pytest.approx(math.sqrt(2.0) * MISALIGNED * STOP_M_S, rel=0.15)
    assert left[1] < 0.5 * left[2]


def test_a_bias_is_no_motion_and_square_axes_have_no_noise() -> None:
    """A class's gyro bias of half a degree a second once counted as a turn without end."""
    biased = REST.copy()
    biased[:, :3] = 0.01
    out = np.zeros_like(biased)
    Crosstalk(PERIOD_S, MISALIGNED).follow(stamps(biased), biased, out)
    assert out.max() < 1e-9 * G
    assert not densities(turning(2, 0.4, 4.0), 0.0).any()


def test_pieces_are_as_the_whole() -> None:
    rng = np.random.default_rng(3)
    samples = REST + rng.normal(0.0, 0.3, REST.shape)
    whole, parts = np.zeros_like(samples), np.zeros_like(samples)
    Crosstalk(PERIOD_S, MISALIGNED).follow(stamps(samples), samples, whole)
    in_parts, times = Crosstalk(PERIOD_S, MISALIGNED), stamps(samples)
    for begin, end in ((0, 1), (1, 700), (700, len(samples))):
        in_parts.follow(times[begin:end], samples[begin:end], parts[begin:end])
    assert np.array_equal(whole, parts)
