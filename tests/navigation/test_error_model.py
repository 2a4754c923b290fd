"""The linear error model against numerical differentiation of the strapdown step itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.navigation.error_model import dense_transition
from fusiond.navigation.rotation import dcm_from_rpy, quaternion_from_rpy
from fusiond.navigation.strapdown import STEP_SIZE, strapdown_step
from tests import runs

Array = NDArray[np.float64]

H = 0.01
# Steps of the central difference: attitude (rad), velocity (m/s), position (m), rate, force error.
# Small enough for their cubes, large against the rounding of latitude (7e-10 m).
PERTURBATION = np.repeat([1e-4, 1.0, 100.0, 1e-3, 0.1], 3)
# What may differ, by block of (attitude, velocity, position) x (the same, rate error, force error).
# The model is of first order in the rates of the axes, w_in ~ 1e-4 rad/s, and of the body, w ~ 0.6,
# over h. f ~ 10 m/s^2. Left out, and so allowed:
ALLOWED = np.array(
    [
        # phi: (w_in h)^2, its change by dv and dr / R; e: h (w h)^2 / 12
        [3e-10, 3e-14, 2e-15, 5e-8, 1e-10],
        # f h w_in h; Coriolis of the mean velocity; gravity gradient to 0.4 %; f w h^3 / 6; w^2 h^3
        [2e-7, 5e-10, 2e-10, 3e-6, 2e-7],
        # rounding 7e-10 m / 2e-4 rad; w_in h^2; (w_in h)^2; f h^3 / 6; h^3 w
        [1e-5, 3e-8, 3e-10, 3e-6, 3e-8],
    ]
)
STATES = [
    pytest.param(30.5, 40.0, (10.0, 5.0, 0.5), (0.02, 0.03, 0.7), id="car"),
    pytest.param(80.0, 10000.0, (250.0, -150.0, 5.0), (0.3, 0.1, 2.0), id="flight, far north"),
    pytest.param(-45.0, 9000.0, (-200.0, 220.0, -10.0), (-0.5, 0.2, -2.5), id="flight, south"),
    pytest.param(0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), id="at rest on the equator"),
    pytest.param(52.0, 300.0, (60.0, 20.0, -80.0), (2.8, -1.2, 0.3), id="steep, nearly inverted"),
]
RATE = np.array([0.3, -0.2, 0.5])


def _advance(
    nav: Array, rate: Array, force: Array, h: float, steps: int = 1
) -> tuple[Array, Array]:
    nav, step, none = nav.copy(), np.zeros(STEP_SIZE), np.zeros(3)
    for _ in range(steps):
        strapdown_step(nav, rate, force, none, none, h, False, step)
    return nav, step


def _differentiated(nav: Array, rate: Array, force: Array, h: float, steps: int) -> Array:
    """Transition (9, 15) of `steps` intervals by central differences."""
    true, _ = _advance(nav, rate, force, h, steps)
    columns = []
    for k, size in enumerate(PERTURBATION):
        outcome = []
        for sign in (1.0, -1.0):
            error = np.zeros(15)
            error[k] = sign * size
            computed, _ = _advance(
                runs.with_error(nav, error[:9]), rate + error[9:12], force + error[12:], h, steps
            )
            outcome.append(runs.nav_error(computed, true))
        columns.append((outcome[0] - outcome[1]) / (2.0 * size))
    return np.array(columns).T


def _start(
    lat_deg: float, height: float, v: tuple[float, ...], rpy: tuple[float, float, float]
) -> tuple[Array, Array]:
    nav = np.array([math.radians(lat_deg), 1.0, height, *v, *quaternion_from_rpy(*rpy)])
    force = dcm_from_rpy(*rpy).T @ np.array([2.0, -3.0, -9.8]) + [0.5, 0.2, -0.1]
    return nav, force


@pytest.mark.parametrize(("lat_deg", "height", "v", "rpy"), STATES)
def test_one_interval(
    lat_deg: float, height: float, v: tuple[float, ...], rpy: tuple[float, float, float]
) -> None:
    nav, force = _start(lat_deg, height, v, rpy)
    after, step = _advance(nav, RATE, force, H)
    difference = dense_transition(after, step, H)[:, :15] - _differentiated(nav, RATE, force, H, 1)
    difference *= math.cos(nav[0])  # terms with tan(lat) grow towards the pole, and so what is left
    worst = np.abs(difference).reshape(3, 3, 5, 3).max(axis=(1, 3)) / ALLOWED
    assert worst.max() < 1.0, worst


def test_scale_factor_columns_are_the_errors_times_rate_and_force() -> None:
    nav, force = _start(30.0, 100.0, (10.0, 5.0, 0.5), (0.1, 0.2, 0.7))
    after, step = _advance(nav, RATE, force, H)
    m = dense_transition(after, step, H)
    scaled, _ = _advance(nav, RATE * [1.0, 1.0 + 1e-4, 1.0], force * [1.0 + 1e-4, 1.0, 1.0], H)
    error = runs.nav_error(scaled, after) / 1e-4
    expected = m[:, 15 + 1] + m[:, 18]
    # Attitude and velocity; the position gained in one interval is below its rounding.
    assert error[:6] == pytest.approx(expected[:6], rel=2e-4, abs=1e-7)


@pytest.mark.parametrize(("lat_deg", "height", "v", "rpy"), STATES)
def test_product_over_a_second(
    lat_deg: float, height: float, v: tuple[float, ...], rpy: tuple[float, float, float]
) -> None:
    """100 intervals: against differentiation of the whole second, and against 1000 intervals.

    The error of first order in h adds up to 0.1 % of each block's largest element.
    """
    nav, force = _start(lat_deg, height, v, rpy)

    def product(steps: int) -> Array:
        phi, at = np.eye(15), nav
        for _ in range(steps):
            at, step = _advance(at, RATE, force, 1.0 / steps)
            one = np.eye(15)
            one[:9] = dense_transition(at, step, 1.0 / steps)[:, :15]
            phi = one @ phi
        return phi[:9]

    coarse = product(100)
    for other in (_differentiated(nav, RATE, force, 0.001, 1000), product(1000)):
        blocks = np.abs(coarse - other).reshape(3, 3, 5, 3).max(axis=(1, 3))
        size = np.abs(other).reshape(3, 3, 5, 3).max(axis=(1, 3))
        checked = np.array([[1, 0, 0, 1, 0], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1]], dtype=bool)
        assert (blocks[checked] < 1.5e-3 * size[checked]).all(), blocks / size
