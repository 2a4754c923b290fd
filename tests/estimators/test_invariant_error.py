"""The kernels of an update in the heading's coordinates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.estimators.invariant_error import rotation_vector, solve
from fusiond.navigation.rotation import turn_to_dcm


@pytest.mark.parametrize("rows", [1, 2, 3, 5])
def test_an_innovation_is_solved(rows: int) -> None:
    rng = np.random.default_rng(rows)
    root, h, r = rng.normal(size=(9, 9)), rng.normal(size=(rows, 9)), rng.uniform(0.1, 2.0, rows)
    p, nu = root @ root.T, rng.normal(size=rows)
    white, gain = np.empty(rows), np.empty((rows, 9))
    nis, log = solve(nu, h, r, p, white, gain)
    s = h @ p @ h.T + np.diag(r)
    assert gain == pytest.approx(np.linalg.solve(s, h @ p))
    assert white == pytest.approx(np.linalg.solve(np.linalg.cholesky(s), nu))
    assert nis == pytest.approx(nu @ np.linalg.solve(s, nu))
    assert log == pytest.approx(np.linalg.slogdet(s)[1])


def test_no_covariance_solves_nothing() -> None:
    h, white, gain = np.eye(2), np.zeros(2), np.zeros((2, 2))
    nis, log = solve(np.ones(2), h, np.zeros(2), np.diag([1.0, -1.0]), white, gain)
    assert (nis, log) == (math.inf, 0.0)


@pytest.mark.parametrize("phi", [(0.2, -0.1, 2.9), (0.0, 0.0, 1e-12), (0.0, 0.0, math.pi)])
def test_the_vector_of_a_turn(phi: tuple[float, float, float]) -> None:
    turn, found = np.empty((3, 3)), np.empty(3)
    turn_to_dcm(*phi, turn)
    rotation_vector(turn, found)
    assert found == pytest.approx(phi, abs=1e-9)
