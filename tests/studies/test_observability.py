"""Observability over a trajectory: rank, Gramian, estimable states, the Lyapunov form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov

from fusiond.studies.covariance_analysis import joseph, optimal_gain
from fusiond.studies.observability import (
    Epoch,
    gramian_over,
    gramian_stable,
    observability,
)

Array = NDArray[np.float64]


def varying(steps: int = 30, n: int = 5) -> list[Epoch]:
    """A system whose transition and rows change from epoch to epoch; some epochs have no rows."""
    rng = np.random.default_rng(4)
    epochs = []
    for k in range(steps):
        rows = k % 3
        epochs.append(
            Epoch(
                np.eye(n) + 0.1 * rng.standard_normal((n, n)),
                rng.standard_normal((rows, n)),
                rng.uniform(0.5, 2.0, rows),
            )
        )
    return epochs


def test_gramian_is_the_sum_over_the_epochs() -> None:
    epochs = varying()
    theta, total = np.eye(5), np.zeros((5, 5))
    for phi, h, r in epochs:
        theta = phi @ theta
        total += (h @ theta).T @ np.diag(1.0 / r) @ (h @ theta)
    found = observability(epochs, np.array([1.0, 3.0, 0.1, 20.0, 5.0]))
    np.testing.assert_allclose(found.gramian, total, rtol=1e-9, atol=1e-9 * np.abs(total).max())
    np.testing.assert_allclose(found.theta, theta, rtol=1e-12)
    assert found.rank == 5
    assert found.rows == sum(len(e.r) for e in epochs)


def test_prior_and_gramian_give_what_a_filter_without_process_noise_ends_with() -> None:
    epochs = varying(8)
    sigma = np.array([1.0, 3.0, 0.1, 20.0, 5.0])
    p = np.diag(sigma**2)
    for phi, h, r in epochs:
        p = phi @ p @ phi.T
        if len(r):
            p = joseph(p, optimal_gain(p, h, r), h, r)
    found = observability(epochs, sigma)
    with_them, without = found.sigma_end
    np.testing.assert_allclose(with_them, np.sqrt(np.diag(p)), rtol=1e-6)
    expected = found.theta @ np.diag(sigma**2) @ found.theta.T
    np.testing.assert_allclose(without, np.sqrt(np.diag(expected)), rtol=1e-12)
    start = np.linalg.inv(np.diag(sigma**-2) + found.gramian)
    np.testing.assert_allclose(found.start, start, rtol=1e-6, atol=1e-12)


def drifting(seconds: int, extra: bool = False) -> list[Epoch]:
    """Position, velocity and a fixed bias of the position sensor; `extra` sees the velocity."""
    phi = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rows = [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]] if extra else [[1.0, 0.0, 1.0]]
    return [Epoch(phi, np.array(rows), np.full(len(rows), 0.25))] * seconds


def test_position_and_bias_cannot_be_told_apart() -> None:
    names = ["position", "velocity", "bias"]
    found = observability(drifting(100), np.array([10.0, 10.0, 10.0]))
    assert (found.rank, found.informative) == (2, 2)
    weakest = found.directions[-1]
    # Scaled by equal sigma, the direction is position against bias, and nothing is learnt of it.
    np.testing.assert_allclose(np.abs(weakest.vector), np.sqrt([0.5, 0.0, 0.5]), atol=1e-9)
    assert weakest.vector[0] * weakest.vector[2] < 0.0
    assert weakest.sigma_left == pytest.approx(1.0, abs=1e-9)
    assert set(weakest.states(names)) == {"position", "bias"}
    # Half of their variance goes, that of the sum: sigma / sqrt(2).
    assert found.sigma_left[[0, 2]] == pytest.approx(math.sqrt(0.5), abs=1e-3)
    assert found.sigma_left[1] < 1e-2
    assert found.not_estimated(names) == []


def test_a_state_that_the_measurements_leave_as_it_was_may_go() -> None:
    names = ["position", "velocity", "bias"]
    # A bias known far better than the position: the measurements say nothing more of it.
    found = observability(drifting(100), np.array([10.0, 10.0, 0.1]))
    assert found.not_estimated(names) == ["bias"]
    assert found.sigma_left[2] == pytest.approx(1.0, abs=1e-3)


def test_rank_does_not_depend_on_units() -> None:
    """Position in metres or in radians of latitude: the same directions, the same rank."""
    epochs = drifting(200, extra=True)
    unit = np.array([6.4e6, 1.0, 1.0])
    other = [Epoch(e.phi * unit[None, :] / unit[:, None], e.h * unit, e.r) for e in epochs]
    sigma = np.array([50.0, 1.0, 5.0])
    a, b = observability(epochs, sigma), observability(other, sigma / unit)
    assert a.rank == b.rank == 2
    np.testing.assert_allclose(a.sigma_left, b.sigma_left, rtol=1e-9)


def test_a_state_without_prior_is_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        observability(drifting(2), np.array([1.0, 0.0, 1.0]))


def stable(n: int = 6) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(7)
    f = rng.standard_normal((n, n))
    f -= (np.linalg.eigvals(f).real.max() + 0.3) * np.eye(n)
    return f, rng.standard_normal((2, n)), np.array([0.5, 2.0])


def test_lyapunov_form_of_a_stable_system() -> None:
    f, h, r = stable()
    found = gramian_stable(f, h, r)
    weighted = h.T @ np.diag(1.0 / r) @ h
    expected = solve_continuous_lyapunov(f.T, -weighted)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    residual = f.T @ found + found @ f + weighted
    np.testing.assert_allclose(residual, 0.0, atol=1e-9 * np.abs(weighted).max())


def test_gramian_over_a_time_is_the_integral() -> None:
    f, h, r = stable(4)
    f += 0.5 * np.eye(4)  # no longer stable: over a finite time that is no obstacle
    found, phi = gramian_over(f, h, r, 2.5)
    weighted = h.T @ np.diag(1.0 / r) @ h
    expected, _ = quad_vec(lambda t: expm(f.T * t) @ weighted @ expm(f * t), 0.0, 2.5)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    np.testing.assert_allclose(phi, expm(2.5 * f), rtol=1e-12)


def test_the_printed_order_of_the_integral_is_a_slip() -> None:
    """e^{Ft} H H^T e^{F^T t} solves the other Lyapunov equation, not the printed one."""
    f, h, r = stable(3)
    weighted = h.T @ np.diag(1.0 / r) @ h
    printed = solve_continuous_lyapunov(f, -weighted)
    assert np.abs(f.T @ printed + printed @ f + weighted).max() > 0.1 * np.abs(weighted).max()


@pytest.mark.parametrize("shift", [0.0, 0.2])
def test_an_oscillation_has_no_gramian_to_infinity(shift: float) -> None:
    schuler = 1.24e-3
    f = np.array([[shift, 1.0], [-(schuler**2), 0.0]])
    with pytest.raises(ValueError, match="stable"):
        gramian_stable(f, np.array([[1.0, 0.0]]), np.ones(1))
