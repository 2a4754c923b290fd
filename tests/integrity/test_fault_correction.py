"""What is taken out of a filter's state for hypotheses that nobody can tell apart."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.estimators.fault_bank_interface import Estimated
from fusiond.integrity.fault_correction import mixed

N = 15
VELOCITY = slice(3, 6)


def _told(log_likelihood: float, mean: list[float]) -> Estimated:
    whole = np.array([*mean, *[0.0] * (N - len(mean))])
    size, covariance = np.zeros(3), np.eye(3)
    return Estimated(0, 0.0, 9.0, log_likelihood, size, covariance, whole, 1e-4 * np.eye(N))


def test_what_fits_alike_is_taken_by_its_mean_and_open_by_the_rest() -> None:
    one, other = _told(50.0, [0.0] * 3 + [1.0]), _told(50.0, [0.0] * 3 + [3.0])
    found = mixed([one, other])
    assert found.mean[3] == pytest.approx(2.0)
    assert found.spread[3, 3] == pytest.approx(1.0 + 1e-4)
    worse = _told(30.0, [0.0] * 3 + [90.0])
    assert mixed([one, worse]).mean[3] == pytest.approx(1.0, abs=1e-6)


def test_a_turn_leaves_open_what_a_straight_line_leaves_out() -> None:
    """18 deg of a heading that has carried a velocity of 20 m/s along: 1 - cos is a metre a
    second."""
    turn, speed = np.radians(18.0), 20.0
    found = mixed([_told(50.0, [0.0, 0.0, turn, 0.0, turn * speed])])
    left_out = speed * (1.0 - np.cos(turn))
    open_m_s = np.sqrt(np.diag(found.spread)[VELOCITY])
    assert open_m_s == pytest.approx(np.full(3, left_out), rel=0.02)
    of_attitude = np.sqrt(np.diag(found.spread)[:3] - 1e-4)
    assert of_attitude == pytest.approx([0.0, 0.0, turn**2 / 2.0])
