"""Speeds without a course and speeds held at 0: what is known of the velocity is its sigma."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from drivers.measurements import PositionFix
from drivers.nmea.printed_velocity import (
    AT_REST_M_S,
    NOISE_M_S,
    PINNED_M_S,
    PrintedSpeed,
    VelocityReader,
)
from tests.drivers.nmea.sentences import decoder, made, wire

KNOT = 1852.0 / 3600.0


def read(*printed: tuple[float, float, float | None]) -> list[tuple[bool, float]]:
    """Whether there is a velocity, and its open sigma, of each speed (kn), step (kn), course."""
    reader = VelocityReader(Counter())
    found = [reader.velocity_of(PrintedSpeed(s * KNOT, q * KNOT, c)) for s, q, c in printed]
    return [(v is not None, sd) for v, sd in found]


def test_the_course_of_a_speed_is_used() -> None:
    v, sd = VelocityReader(Counter()).velocity_of(PrintedSpeed(10.0, 0.01, 120.0))
    assert v == pytest.approx((-5.0, 10.0 * math.sin(math.radians(120.0)), None))
    assert sd == 0.0


@pytest.mark.parametrize(("speed_kn", "known"), [(0.013, True), (0.7, True), (0.75, False)])
def test_without_a_course_what_noise_explains_is_rest(speed_kn: float, known: bool) -> None:
    ((found, sd),) = read((speed_kn, 0.001, None))
    assert found == known
    assert math.hypot(NOISE_M_S, sd) >= speed_kn * KNOT / math.sqrt(2.0) or not known


def test_sigma_is_that_of_a_velocity_of_any_direction() -> None:
    """At rest and in creep, over the directions: an axis' error over its sigma has the variance 1
    at the most, and no less than the receiver's noise has by itself."""
    rng = np.random.default_rng(40)
    for true_m_s in (0.0, 0.1, 0.2):
        squares = []
        for _ in range(4000):
            noise_n, noise_e = rng.normal(0.0, NOISE_M_S, 2)
            printed = math.hypot(true_m_s + noise_n, noise_e)
            v, sd = VelocityReader(Counter()).velocity_of(PrintedSpeed(printed, 5e-4, None))
            if v is not None:
                turned = rng.uniform(0.0, math.tau)
                squares.append((true_m_s * math.cos(turned)) ** 2 / (NOISE_M_S**2 + sd * sd))
        assert np.mean(squares) <= 1.0


def test_a_run_of_one_unknown_direction_says_no_more_than_one_of_it() -> None:
    speed_m_s = 0.3
    reader = VelocityReader(Counter())
    sds = [reader.velocity_of(PrintedSpeed(speed_m_s, 5e-4, None))[1] for _ in range(500)]
    beyond = speed_m_s**2 / 2.0 - NOISE_M_S**2
    information = sum(1.0 / (sd * sd) for sd in sds)
    assert 0.99 < information * beyond < 1.0
    # A course ends the run.
    assert reader.velocity_of(PrintedSpeed(speed_m_s, 5e-4, 10.0))[1] == 0.0
    assert reader.velocity_of(PrintedSpeed(speed_m_s, 5e-4, None))[1] == sds[0]


@pytest.mark.parametrize(("step_kn", "free"), [(0.001, 1), (0.01, 7), (0.1, 100), (1.0, 100)])
@pytest.mark.parametrize("course", [None, 87.5])
def test_zeros_that_noise_does_not_print_are_held(
    step_kn: float, free: int, course: float | None
) -> None:
    sds = [sd for _, sd in read(*[(0.0, step_kn, course)] * 100)]
    assert sds[:free] == [0.0] * free
    assert all(sd > PINNED_M_S / 2.0 for sd in sds[free:])
    assert sum(1.0 / (sd * sd) for sd in sds if sd) <= (2.0 / PINNED_M_S) ** 2


def test_one_zero_among_speeds_is_a_speed() -> None:
    row = read(*[(0.0, 0.01, None), (0.02, 0.01, None)] * 5)
    assert row == [(True, 0.0)] * 10


def test_limit_of_rest_is_a_quantile_of_noise() -> None:
    draws = np.hypot(*np.random.default_rng(3).normal(0.0, NOISE_M_S, (2, 400_000)))
    assert np.mean(draws > AT_REST_M_S) == pytest.approx(1e-3, rel=0.2)


def test_what_is_lost_or_held_is_named() -> None:
    place = "4712.3456,N,00812.3456,E"
    for speed, course, name in (
        ("9.70", "", "course_missing"),
        ("0.00", "", "speed_held_at_zero"),
        ("0.000", "12.0", "speed_held_at_zero"),
        ("0.02", "", ""),
    ):
        one, fixes = decoder(), list[PositionFix]()
        for second in range(10):
            at = f"0733{second:02d}.00"
            rmc = made(f"GPRMC,{at},A,{place},{speed},{course},240326,,,A")
            gga = made(f"GPGGA,{at},{place},1,13,0.9,412.1,M,47.1,M,,")
            found = one.feed(wire(gga, rmc), 1)
            fixes += [m for m in found if isinstance(m, PositionFix)]
        assert list(one.cautions) == [name] * bool(name)
        assert {fix.v_ned_m_s is None for fix in fixes} == {name == "course_missing"}
