"""Advanced RAIM: the reference's worked examples, closed forms, and what the levels promise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from fusiond.integrity.araim import (
    LPV_200,
    Epoch,
    Protection,
    Requirement,
    detect,
    exclude,
    fault_modes,
    protect,
    protection_level,
)

Array = NDArray[np.float64]

# Reference Airborne Algorithm Description Document v3.1, appendix D: two constellations of five.
SIGHT = -np.array(
    [
        [0.0225, 0.9951, -0.0966],
        [0.6750, -0.6900, -0.2612],
        [0.0723, -0.6601, -0.7477],
        [-0.9398, 0.2553, -0.2269],
        [-0.5907, -0.7539, -0.2877],
        [-0.3236, -0.0354, -0.9455],
        [-0.6748, 0.4356, -0.5957],
        [0.0938, -0.7004, -0.7075],
        [0.5571, 0.3088, -0.7709],
        [0.6622, 0.6958, -0.2780],
    ]
)
V31_INT = (3.2899, 1.2792, 0.7901, 1.4430, 1.1847, 0.7737, 0.8233, 0.7962, 0.7871, 1.2166)
V31_ACC = (2.9774, 0.9667, 0.4776, 1.1305, 0.8722, 0.4612, 0.5108, 0.4837, 0.4746, 0.9041)
V30_INT = (3.8865, 1.4377, 0.8604, 1.6383, 1.3229, 0.8434, 0.8963, 0.8669, 0.8573, 1.3616)
V30_ACC = (3.5740, 1.1252, 0.5479, 1.3258, 1.0104, 0.5309, 0.5838, 0.5544, 0.5448, 1.0491)
# Coarse enough to be counted.
COARSE = Requirement(1e-3, 1e-3, 0.01, 0.01, 1e-3, 1e-5, 1e-3)


def epoch(
    variance: tuple[float, ...] = V31_INT,
    accuracy: tuple[float, ...] = V31_ACC,
    p_satellite: float = 1e-5,
    p_constellation: float = 1e-4,
    bias: float = 0.5,
) -> Epoch:
    return Epoch(
        SIGHT,
        np.repeat([0, 1], 5),
        np.sqrt(variance),
        np.sqrt(accuracy),
        np.full(10, bias),
        np.full(10, p_satellite),
        np.full(2, p_constellation),
    )


def protected(e: Epoch, requirement: Requirement = LPV_200) -> Protection:
    found = protect(e, requirement)
    assert found is not None
    return found


# Printed to 0.1 m or 0.01 m, each axis found to TOL_PL = 0.05 m there.
@pytest.mark.parametrize(
    ("variances", "levels", "emt", "accuracy", "sigma", "apart", "bias"),
    [
        (
            (V31_INT, V31_ACC),
            (13.45, 18.3),
            7.2998,
            1.3694,
            (2.4600, 2.4359),
            (1.4290, 1.4217),
            (2.8915, 2.0875),
        ),
        (
            (V30_INT, V30_ACC),
            (14.5, 19.2),
            7.8,
            1.47,
            (2.5760, 2.5577),
            (1.5307, 1.5292),
            (2.8935, 2.0875),
        ),
    ],
    ids=["v3.1", "v3.0"],
)
def test_worked_examples_of_the_reference(
    variances: tuple[tuple[float, ...], tuple[float, ...]],
    levels: tuple[float, float],
    emt: float,
    accuracy: float,
    sigma: tuple[float, float],
    apart: tuple[float, float],
    bias: tuple[float, float],
) -> None:
    p = protected(epoch(*variances))
    assert len(p.modes) == 12
    assert p.hpl_m == pytest.approx(levels[0], abs=0.05 * math.sqrt(2.0) + 0.05)
    assert p.vpl_m == pytest.approx(levels[1], abs=0.05)
    assert p.effective_monitor_threshold_m == pytest.approx(emt, abs=0.05)
    assert p.vertical_accuracy_m == pytest.approx(accuracy, abs=0.005)
    s = p.separation
    assert s.sigma[-2:, 2] == pytest.approx(sigma, abs=2e-4)
    assert s.separation_sigma[-2:, 2] == pytest.approx(apart, abs=2e-4)
    assert s.bias[-2:, 2] == pytest.approx(bias, abs=2e-4)
    assert s.threshold[-1, 2] / s.separation_sigma[-1, 2] == pytest.approx(5.1083, abs=1e-4)


def test_without_faults_the_level_is_k_sigma_and_bias() -> None:
    p = protected(epoch(p_satellite=0.0, p_constellation=0.0))
    assert p.modes == ()
    s = p.separation
    assert p.vpl_m == pytest.approx(-norm.ppf(9.8e-8 / 2) * s.sigma[0, 2] + s.bias[0, 2], abs=1e-3)
    level = -norm.ppf(2e-9 / 4) * s.sigma[0, :2] + s.bias[0, :2]
    assert p.hpl_m == pytest.approx(math.hypot(*level), abs=2e-3)


@given(
    st.lists(
        st.tuples(st.floats(1e-7, 2.0), st.floats(0.0, 50.0), st.floats(1e-3, 100.0)),
        min_size=1,
        max_size=8,
    ),
    st.floats(1e-9, 1e-3),
)
@settings(max_examples=200, deadline=None)
def test_the_level_is_the_root_of_the_risk(
    terms: list[tuple[float, float, float]], risk: float
) -> None:
    weight, offset, sigma = np.array(terms).T
    level = protection_level(weight, offset, sigma, risk)

    def risk_at(x: float) -> float:
        return float((weight * norm.sf((x - offset) / sigma)).sum())

    assert risk_at(level) <= risk * (1.0 + 1e-9)
    assert level == 0.0 or level <= 2e-3 or risk_at(level - 2e-3) > risk


def test_an_infinite_sigma_or_no_risk_left_has_no_bound() -> None:
    one = np.ones(1)
    assert protection_level(one, one, np.array([math.inf]), 1e-3) == math.inf
    assert protection_level(one, one, one, 0.0) == math.inf


@pytest.mark.parametrize("factor", [3.0, 10.0])
def test_likelier_faults_raise_the_levels(factor: float) -> None:
    base = protected(epoch())
    for more in (epoch(p_satellite=factor * 1e-5), epoch(p_constellation=factor * 1e-4)):
        p = protected(more)
        assert p.hpl_m > base.hpl_m
        assert p.vpl_m > base.vpl_m


def test_a_poorer_sky_raises_the_levels() -> None:
    whole = protected(epoch())
    for k in range(10):
        out = np.arange(10) == k
        p = protected(epoch().without(out))
        # Least squares does not make the least level: a weak satellite less is a mode less.
        assert p.hpl_m > 0.99 * whole.hpl_m
        assert p.vpl_m > 0.99 * whole.vpl_m
        assert p.hpl_m + p.vpl_m > whole.hpl_m + whole.vpl_m
    worse = protected(
        epoch(tuple(4.0 * v for v in V31_INT), tuple(4.0 * v for v in V31_ACC), bias=1.0)
    )
    assert worse.hpl_m == pytest.approx(2.0 * whole.hpl_m, abs=5e-3)
    assert worse.vpl_m == pytest.approx(2.0 * whole.vpl_m, abs=5e-3)


def test_modes_that_cannot_be_monitored_cost_the_budget() -> None:
    """Four satellites of one constellation: without any of them there is no solution."""
    e = replace(epoch(p_constellation=0.0).without(np.arange(10) < 6))
    p = protected(e)
    assert p.modes == ()
    assert p.not_monitored == pytest.approx(4e-5, rel=1e-3)
    assert p.vpl_m == p.hpl_m == math.inf
    assert protect(e.without(np.arange(4) == 0), LPV_200) is None


def test_modes_hold_all_probability_that_is_not_left_over() -> None:
    e = epoch(p_satellite=0.01, p_constellation=0.02)
    modes, left = fault_modes(e, 1e-3)
    assert left <= 1e-3
    healthy = 0.99**10 * 0.98**2
    assert healthy + sum(m.prior for m in modes) + left == pytest.approx(1.0, abs=1e-12)
    assert len({m.out.tobytes() for m in modes}) == len(modes)
    # A satellite together with its constellation is the constellation.
    whole = next(m for m in modes if m.out[:5].all() and not m.out[5:].any())
    assert whole.prior > 0.02 * 0.99**10 * 0.98


def test_false_alarms_are_no_more_than_allocated() -> None:
    e = epoch(bias=0.0)
    p = protected(e, COARSE)
    rng = np.random.default_rng(1)
    y = rng.standard_normal((10, 100_000)) * e.accuracy_sigma_m[:, None]
    apart = np.abs(np.einsum("kqi,in->kqn", p.separation.gain[1:] - p.separation.gain[0], y))
    beyond = (apart > p.separation.threshold[1:, :, None]).any(axis=0)
    horizontal, vertical = beyond[:2].any(axis=0).mean(), beyond[2].mean()
    # Modes overlap: Boole's inequality, by which the threshold is made, gives more than there is.
    assert 0.002 < horizontal < 0.01
    assert 0.002 < vertical < 0.01
    few = [detect(e, p, y[:, k], COARSE).passed for k in range(3000)]
    assert np.mean(few) == pytest.approx(1.0 - 0.02, abs=0.015)


def test_errors_beyond_the_levels_are_as_rare_as_stated() -> None:
    """Of each fault the worst size, times its prior, with the fault-free share: below the risk.

    Satellites are a hundredth likely to be wrong, so that their terms weigh.
    """
    e = epoch(p_satellite=0.01, p_constellation=0.0, bias=0.0)
    requirement = replace(COARSE, unmonitored_risk=6e-3, horizontal_risk=0.02, vertical_risk=0.02)
    p = protected(e, requirement)
    assert p.not_monitored < 6e-3
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((10, 40_000)) * e.integrity_sigma_m[:, None]
    s = p.separation
    apart_gain = s.gain[1:] - s.gain[0]

    def missed(y: Array) -> tuple[float, float]:
        """Rates of an error beyond the level that no test has seen: horizontal, vertical."""
        error = s.gain[0] @ y
        apart = np.abs(np.einsum("kqi,in->kqn", apart_gain, y))
        silent = (apart <= s.threshold[1:, :, None]).all(axis=(0, 1))
        horizontal = silent & (np.hypot(error[0], error[1]) > p.hpl_m)
        return float(horizontal.mean()), float((silent & (np.abs(error[2]) > p.vpl_m)).mean())

    horizontal, vertical = missed(noise)
    for mode in p.modes:
        if mode.out.sum() > 1:
            continue
        k = int(np.flatnonzero(mode.out)[0])
        worst = [0.0, 0.0]
        for size in np.linspace(2.0, 30.0, 12):
            biased = noise.copy()
            biased[k] += size
            worst = np.maximum(worst, missed(biased)).tolist()
        horizontal += mode.prior * worst[0]
        vertical += mode.prior * worst[1]
    assert horizontal < 0.02
    assert 1e-5 < vertical < 0.02


def test_the_satellite_that_is_wrong_is_left_out() -> None:
    rng = np.random.default_rng(3)
    # Constellation faults aside: without five of ten the solution is too poor for the levels.
    e = epoch(p_satellite=1e-4, p_constellation=0.0)
    clean = rng.standard_normal(10) * 0.3
    found = exclude(e, LPV_200, clean)
    assert found is not None
    assert not found.out.any()
    for k in range(10):
        y = clean.copy()
        y[k] += 60.0
        found = exclude(e, LPV_200, y)
        assert found is not None
        assert np.flatnonzero(found.out).tolist() == [k]
        assert math.isfinite(found.protection.vpl_m)
        assert found.protection.vpl_m > protected(e).vpl_m


def test_what_no_mode_explains_is_not_excluded() -> None:
    e = epoch()
    y = np.where(np.arange(10) % 2 == 0, 200.0, -150.0) * (1.0 + np.arange(10) / 7.0)
    assert exclude(e, LPV_200, y) is None
