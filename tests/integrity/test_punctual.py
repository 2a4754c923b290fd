"""Whether it would have shown that a receiver is late since it came back."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.integrity.punctual import LATE_S, MOST_LATE_S, MOST_SIGMAS, TOLD, Before, Punctual

Array = NDArray[np.float64]
RATE_HZ, SD_M, S = 5.0, 0.6, 1_000_000_000
Motion = Callable[[float], tuple[float, float]]
BEGUN = Punctual(100 * S)


def _after(seconds: float, velocity: Motion, begun: Punctual = BEGUN) -> Punctual:
    punctual = begun
    for k in range(round(seconds * RATE_HZ)):
        t_s = k / RATE_HZ
        punctual = punctual.with_one(100 * S + round(t_s * S), *velocity(t_s), SD_M)
    return punctual


def _straight(t_s: float) -> tuple[float, float]:
    return 20.0, -12.0


def _braking(t_s: float) -> tuple[float, float]:
    return 20.0 - 0.6 * t_s, -12.0 + 0.36 * t_s


def _bend(t_s: float) -> tuple[float, float]:
    yaw = math.radians(10.0) * max(0.0, t_s - 10.0)
    return 15.0 * math.cos(yaw), 15.0 * math.sin(yaw)


def _steady(t_s: float) -> tuple[float, float]:
    return 15.0 * math.cos(0.1 * t_s), 15.0 * math.sin(0.1 * t_s)


def _ends_braking(t_s: float) -> tuple[float, float]:
    return 20.0 - 1.5 * min(t_s, 6.0), 0.0


@pytest.mark.parametrize("motion", [_straight, _braking])
def test_an_even_acceleration_tells_nothing(motion: Motion) -> None:
    """What is late is then another motion of the same acceleration."""
    punctual = _after(30.0, motion)
    assert punctual.left == pytest.approx(0.0, abs=1e-6)
    assert not punctual.told


@pytest.mark.parametrize("motion", [_bend, _ends_braking])
def test_a_change_of_acceleration_tells(motion: Motion) -> None:
    assert _after(20.0, motion).told


@pytest.mark.parametrize("motion", [_bend, _ends_braking])
def test_what_is_left_is_what_least_squares_finds(motion: Motion) -> None:
    """Of fixes that are late by tau the estimate, beside a place and a constant velocity, has the
    sigma that is claimed."""
    n = 100
    t = np.arange(n) / RATE_HZ
    v = np.array([motion(s) for s in t.tolist()])
    line = np.column_stack((np.ones(n), t))
    w = v - line @ np.linalg.lstsq(line, v, rcond=None)[0]
    punctual = _after(n / RATE_HZ, motion)
    assert punctual.left == pytest.approx(float(np.sum(w**2)))
    rng = np.random.default_rng(4)
    found = []
    for _ in range(400):
        z = -LATE_S * v + SD_M * rng.standard_normal((n, 2))
        found.append(-float(np.sum(w * z) / np.sum(w**2)))
    claimed = SD_M / math.sqrt(punctual.left)
    assert np.mean(found) == pytest.approx(LATE_S, abs=4.0 * claimed / 20.0)
    assert np.std(found) == pytest.approx(claimed, rel=0.15)
    assert punctual.told is (claimed * TOLD <= LATE_S)


def test_of_a_start_only_the_speed_tells() -> None:
    """Its heading is that of the fixes; and what drives slowly is not off by more than a fix."""
    bend, braking = (
        _after(40.0, motion, Punctual(100 * S, started=True)) for motion in (_steady, _ends_braking)
    )
    assert bend.left == pytest.approx(0.0, abs=1e-6)
    assert not bend.told
    assert bend.matters
    assert braking.told
    slow = Punctual(0, started=True).with_one(0, 0.9 * SD_M / LATE_S, 0.0, SD_M)
    assert not slow.matters
    assert slow._replace(started=False).matters


def test_nothing_is_told_before_the_second_fix() -> None:
    assert not Punctual(0).told
    assert not Punctual(0).with_one(0, 20.0, 0.0, SD_M).told


def test_tilt_and_heading_take_their_part() -> None:
    """Of motions whose acceleration and heading are off by what an outage leaves, the estimate of a
    lateness by all that is known has the sigma that is claimed; as if both were known it would be
    less than half."""
    n, before = 75, Before(acceleration=0.08, yaw=math.radians(1.5))
    t = np.arange(n) / RATE_HZ
    v = np.array([_bend(s) for s in t.tolist()])
    way = np.vstack((np.zeros(2), np.cumsum(0.5 / RATE_HZ * (v[1:] + v[:-1]), axis=0)))
    one, zero = np.ones(n), np.zeros(n)
    rows = np.stack(
        [
            np.column_stack((one, zero, t, zero, 0.5 * t**2, zero, -way[:, 1], -v[:, 0])),
            np.column_stack((zero, one, zero, t, zero, 0.5 * t**2, way[:, 0], -v[:, 1])),
        ]
    ).reshape(2 * n, 8)
    sd = np.array([before.acceleration] * 2 + [before.yaw])
    normal = rows.T @ rows / SD_M**2 + np.diag([0.0] * 4 + (sd**-2.0).tolist() + [0.0])
    rng = np.random.default_rng(7)
    found = []
    for _ in range(400):
        x = np.concatenate(([3.0, -2.0, 0.4, 0.3], sd * rng.standard_normal(3), [LATE_S]))
        z = rows @ x + SD_M * rng.standard_normal(2 * n)
        found.append(float(np.linalg.solve(normal, rows.T @ z / SD_M**2)[-1]))
    seconds = n / RATE_HZ
    punctual, known = (
        _after(seconds, _bend, Punctual(100 * S, before=before)),
        _after(seconds, _bend),
    )
    claimed = SD_M / math.sqrt(punctual.left)
    assert np.mean(found) == pytest.approx(LATE_S, abs=4.0 * claimed / 20.0)
    assert np.std(found) == pytest.approx(claimed, rel=0.15)
    assert punctual.left < known.left / 2.0**2


def test_a_lateness_is_open_until_it_has_shown() -> None:
    """On a straight as far as all that come; less than an outage's own sigma allows; and of a
    vehicle that has braked by no more than a fix."""
    most = MOST_LATE_S / MOST_SIGMAS
    straight = _after(30.0, _straight)
    assert straight.sd_s == pytest.approx(most)
    assert straight.leaves_open == pytest.approx(
        [(20.0 * most) ** 2, (12.0 * most) ** 2, 0.0, 0.0, 0.0, 0.0], abs=1e-6
    )
    assert not straight.over
    surer = _after(30.0, _straight, Punctual(100 * S, before=Before(late_s=0.1)))
    assert surer.sd_s == pytest.approx(0.1)
    braking = _after(3.0, _braking)
    assert np.sqrt(braking.leaves_open[3:5]) == pytest.approx([0.6 * most, 0.36 * most], rel=0.01)
    shown = _after(20.0, _ends_braking)
    assert shown.over
    assert math.sqrt(shown.leaves_open[0]) < SD_M
