"""Protection levels of a filter: closed forms, what a separation does, and what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from fusiond.integrity.protection import (
    AXIS_SHARE,
    INDEPENDENT_PER_HOUR,
    IntegrityRisk,
    axis_level,
    filter_protection,
)

Array = NDArray[np.float64]

RISK = IntegrityRisk(1e-5, 1e-4, (1e-3, 1e-3))
APART = np.zeros(2)


def level(
    variance: tuple[float, ...], separation: Array = APART, risk: IntegrityRisk = RISK
) -> float:
    return axis_level(np.array(variance), separation, AXIS_SHARE[0], risk).level_m


def test_without_likely_faults_the_level_is_k_sigma() -> None:
    risk = IntegrityRisk(1e-5, 1e-4, (0.0,))
    k = -norm.ppf(1e-5 * AXIS_SHARE[0] / INDEPENDENT_PER_HOUR / 2.0)
    assert level((4.0, 1e6), np.zeros(1), risk) == pytest.approx(2.0 * k, abs=2e-3)


def test_a_poor_subset_determines_the_level() -> None:
    """A fault of p = 1e-3: the subset's own K is of a risk a thousand times as large."""
    risk = IntegrityRisk(1e-5, 1e-4, (1e-3,))
    k = -norm.ppf(1e-5 * AXIS_SHARE[0] / INDEPENDENT_PER_HOUR / 1e-3 / 2.0)
    k_fa = -norm.ppf(1e-4 / (2.0 * 3.0 * INDEPENDENT_PER_HOUR))
    expected = k * 100.0 + k_fa * math.sqrt(1e4 - 1.0)
    assert level((1.0, 1e4), np.zeros(1), risk) == pytest.approx(expected, abs=0.01)


def test_the_level_grows_with_sigma_and_prior() -> None:
    base = level((1.0, 100.0, 1.2))
    assert level((1.0, 144.0, 1.2)) > base
    assert level((1.0, 100.0, 1.2), risk=IntegrityRisk(1e-5, 1e-4, (3e-3, 1e-3))) > base
    assert level((1.0, 100.0, 1.2), risk=IntegrityRisk(1e-6 * 3, 1e-4, (1e-3, 1e-3))) > base


def test_a_separation_counts_once_it_is_beyond_its_threshold() -> None:
    variance = np.array([1.0, 100.0, 1.2])
    base = axis_level(variance, APART, 0.25, RISK)
    within = axis_level(variance, np.array([40.0, 0.0]), 0.25, RISK)
    assert within.level_m == base.level_m
    assert not within.apart.any()
    beyond = axis_level(variance, np.array([-150.0, 0.0]), 0.25, RISK)
    assert beyond.apart.tolist() == [True, False]
    further = axis_level(variance, np.array([-151.0, 0.0]), 0.25, RISK)
    assert further.level_m == pytest.approx(beyond.level_m + 1.0)
    assert beyond.level_m > 150.0


def test_faults_that_come_together_leave_nothing() -> None:
    assert RISK.monitored == pytest.approx(9e-6)
    assert level((1.0, 4.0, 4.0), risk=IntegrityRisk(1e-5, 1e-4, (1e-2, 1e-2))) == math.inf


def test_horizontal_is_of_both_axes_and_vertical_may_be_held() -> None:
    covariances = np.array([np.eye(3), 100.0 * np.eye(3), 2.0 * np.eye(3)])
    found = filter_protection(covariances, np.zeros((2, 3)), RISK)
    north = axis_level(np.array([1.0, 100.0, 2.0]), APART, 0.25, RISK).level_m
    assert found.hpl_m == pytest.approx(north * math.sqrt(2.0))
    # Twice the risk.
    assert found.vpl_m is not None
    assert found.vpl_m < north
    assert filter_protection(covariances, np.zeros((2, 3)), RISK, vertical=False).vpl_m is None


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_errors_beyond_the_level_are_as_rare_as_stated(share: float) -> None:
    """Two devices of unequal sigma on one axis, the better one off by any amount.

    The risk is that of a sample, made coarse: prior 0.1, so that an error beyond the level may come
    in a tenth of `risk` / prior of the samples with a fault.
    """
    sigma = np.array([1.0, 3.0])
    prior, wanted = 0.1, 2e-3
    risk = IntegrityRisk(
        wanted * INDEPENDENT_PER_HOUR / share, 1e-2 * INDEPENDENT_PER_HOUR, (prior, 1e-9)
    )
    information = 1.0 / sigma**2
    variance = np.array([1.0 / information.sum(), sigma[1] ** 2, sigma[0] ** 2])
    rng = np.random.default_rng(4)
    z = rng.standard_normal((2, 40_000)) * sigma[:, None]
    total = 0.0
    levels = {}
    for name, sizes in (("none", [0.0]), ("fault", np.linspace(0.0, 60.0, 13).tolist())):
        worst = 0.0
        for size in sizes:
            measured = z + np.array([[size], [0.0]])
            x = (information @ measured) / information.sum()
            apart = np.array([measured[1] - x, measured[0] - x])
            level_m = np.array(
                [axis_level(variance, apart[:, k], share, risk).level_m for k in range(4000)]
            )
            levels[name] = float(level_m.mean())
            worst = max(worst, float((np.abs(x[:4000]) > level_m).mean()))
        total += worst * (prior if name == "fault" else 1.0)
    # Three sigma of a count of 4000 above what is stated.
    assert total < wanted + 3.0 * math.sqrt(wanted / 4000)
    assert levels["fault"] > levels["none"] + 20.0
