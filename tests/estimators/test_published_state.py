"""What a filter publishes by the receiver's clock: sigma against the Jacobian of the values.

The kernel leaves out what tau itself turns and moves, here 0.004 rad and 12 ms: a part in a
hundred.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.estimators.published_state import in_fix_time, sigmas
from fusiond.estimators.update import feed_back
from fusiond.navigation.earth import gravity, meridian_radius, transverse_radius
from fusiond.navigation.rotation import dcm_from_quaternion, quaternion_from_rpy, rpy_from_dcm
from fusiond.navigation.strapdown import (
    NAV_SIZE,
    STEP_DCM,
    STEP_RATE_B,
    STEP_SIZE,
    STEP_SMOOTH_N,
)

Array = NDArray[np.float64]
STATES, TIME_SLOT = 12, 10
LAT, HEIGHT = 0.53, 38.0
SIZES = np.array([*(1e-6,) * 3, *(1e-4,) * 3, *(1e-3,) * 3, *(1e-6,) * 3])
"""Of a difference in each state: small against what is linear, large against rounding."""


def bend() -> tuple[Array, Array, Array]:
    """nav (10,), parameters (n,) and step (27,) of a bend at 20 m/s and 20 deg/s."""
    nav, xi, step = np.zeros(NAV_SIZE), np.zeros(STATES), np.zeros(STEP_SIZE)
    nav[:6] = LAT, 2.0, HEIGHT, 15.0, -12.0, 0.4
    nav[6:] = quaternion_from_rpy(-0.06, 0.05, 0.7)
    xi[TIME_SLOT] = 0.012
    step[STEP_DCM : STEP_DCM + 9] = dcm_from_quaternion(nav[6:]).ravel()
    step[STEP_RATE_B : STEP_RATE_B + 3] = 0.02, -0.03, 0.35
    step[STEP_SMOOTH_N : STEP_SMOOTH_N + 3] = 3.0, 2.5, -gravity(LAT, HEIGHT) + 0.1
    return nav, xi, step


def published(nav: Array, xi: Array, step: Array) -> Array:
    """Position (m), velocity (m/s), roll, pitch, yaw (rad)."""
    out = np.empty(NAV_SIZE)
    in_fix_time(nav, xi, step, TIME_SLOT, out)
    east_m = (transverse_radius(LAT) + HEIGHT) * np.cos(LAT)
    place = out[:3] * (meridian_radius(LAT) + HEIGHT, east_m, -1.0)
    return np.array([*place, *out[3:6], *rpy_from_dcm(dcm_from_quaternion(out[6:]))])


def jacobian(nav: Array, xi: Array, step: Array) -> Array:
    """(9, n) of what is published, by the error state: what its feedback changes."""
    columns = []
    for k, size in enumerate(SIZES):
        sides = []
        for sign in (1.0, -1.0):
            dx, n, x = np.zeros(STATES), nav.copy(), xi.copy()
            dx[k] = sign * size
            feed_back(n, x, dx)
            sides.append(published(n, x, step))
        columns.append((sides[0] - sides[1]) / (2.0 * size))
    return np.array(columns).T


@pytest.mark.parametrize("seed", range(5))
def test_sigmas_are_those_of_what_is_published(seed: int) -> None:
    nav, xi, step = bend()
    rng = np.random.default_rng(seed)
    scale = np.array([*(2e-3,) * 3, *(0.05,) * 3, *(0.5,) * 3, 1e-3, 0.01, 1e-3])
    root = scale[:, None] * rng.standard_normal((STATES, STATES))
    cov = root @ root.T
    j = jacobian(nav, xi, step)
    said = np.empty(9)
    sigmas(cov, nav, step, TIME_SLOT, 0.0, 0.0, said)
    np.testing.assert_allclose(said, np.sqrt(np.diag(j @ cov @ j.T)), rtol=1e-2)


@pytest.mark.parametrize("seed", range(5))
def test_sigmas_by_its_own_clock_are_those_of_an_offset_that_nothing_estimates(seed: int) -> None:
    nav, xi, step = bend()
    xi[TIME_SLOT] = 0.0
    rng = np.random.default_rng(seed)
    scale = np.array([*(2e-3,) * 3, *(0.05,) * 3, *(0.5,) * 3, 1e-3, 0.01, 1e-3])
    root = scale[:, None] * rng.standard_normal((STATES, STATES))
    cov = root @ root.T
    beside = cov.copy()
    beside[TIME_SLOT], beside[:, TIME_SLOT] = 0.0, 0.0
    beside[TIME_SLOT, TIME_SLOT] = 0.1**2
    by_offset, by_clock, without = np.empty(9), np.empty(9), np.empty(9)
    sigmas(beside, nav, step, TIME_SLOT, 0.0, 0.0, by_offset)
    sigmas(cov, nav, step, -1, 0.1, 0.0, by_clock)
    sigmas(cov, nav, step, -1, 0.0, 0.0, without)
    np.testing.assert_allclose(by_clock, by_offset, rtol=1e-12)
    np.testing.assert_allclose(np.hypot(without[:2], 0.1 * np.abs(nav[3:5])), by_clock[:2])


@pytest.mark.parametrize("seed", range(5))
def test_axes_that_are_askew_are_three_more_errors_of_the_attitude(seed: int) -> None:
    nav, xi, step = bend()
    rng = np.random.default_rng(seed)
    scale = np.array([*(2e-3,) * 3, *(0.05,) * 3, *(0.5,) * 3, 1e-3, 0.01, 1e-3])
    root = scale[:, None] * rng.standard_normal((STATES, STATES))
    cov = root @ root.T
    turned = cov.copy()
    turned[:3, :3] += 0.02**2 * np.eye(3)
    j = jacobian(nav, xi, step)
    said = np.empty(9)
    sigmas(cov, nav, step, TIME_SLOT, 0.0, 0.02, said)
    np.testing.assert_allclose(said, np.sqrt(np.diag(j @ turned @ j.T)), rtol=1e-2)
