"""Consistency tests of innovations: their law, their verdicts, the sliding window, the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2

from fusiond.integrity.consistency import (
    FEWEST,
    LAGS,
    ConsistencyOptions,
    judge,
    whiten,
)
from fusiond.integrity.innovation_window import ConsistencyMonitor
from fusiond.studies import consistency_verdict_errors as study
from fusiond.studies.single_axis_ins import AidedAxis, Fault, innovations

Array = NDArray[np.float64]
PAPER_RHO = (-0.4054, -0.0259, -0.0411, -0.0881, 0.1637, -0.1903, 0.0842, 0.1781)
WINDOWS = 6000


def _inside_its_interval(hits: int, trials: int, level: float) -> bool:
    interval = binomtest(hits, trials).proportion_ci(0.99)
    return bool(interval.low <= level <= interval.high)


def _verdicts(nu: Array, k: int, alpha: float) -> NDArray[np.int64]:
    return study.window_verdicts(*study.window_statistics(nu, k), nu.shape[2], k, alpha)


# The paper's figures


def test_paper_average_inside_and_first_lag_outside() -> None:
    found = judge(50, 100, 0.893, PAPER_RHO, alpha=0.05, whitened=False)
    assert found.nis_interval == pytest.approx((0.74, 1.3), abs=0.005)
    assert found.nis_inside
    assert found.rho_interval == pytest.approx((-0.2772, 0.2772), abs=5e-5)
    assert found.rho_inside == (False, *[True] * 7)


def test_paper_innovations_are_coloured_once_two_components_count_as_two() -> None:
    found = judge(50, 100, 0.893, PAPER_RHO, alpha=0.05)
    assert found.rho_interval[1] == pytest.approx(1.96 / math.sqrt(100), abs=1e-3)
    assert found.verdict == "coloured"
    assert found.portmanteau_p < 0.01


def test_judge_refuses_what_is_no_window() -> None:
    with pytest.raises(ValueError, match="8 lags"):
        judge(50, 100, 1.0, [0.0] * 7)
    with pytest.raises(ValueError, match="K = 0"):
        judge(0, 100, 1.0, [0.0] * 8)
    assert judge(FEWEST - 1, 2 * FEWEST, 9.0, [0.0] * 8).verdict == "too_few"


def test_verdicts_and_their_order() -> None:
    quiet, loud = [0.0] * LAGS, [0.6, *[0.0] * 7]
    assert judge(50, 100, 1.0, quiet).verdict == "consistent"
    assert judge(50, 100, 1.0, loud).verdict == "coloured"
    assert judge(50, 100, 2.0, loud).verdict == "optimistic"
    assert judge(50, 100, 0.4, loud).verdict == "pessimistic"


@given(
    k=st.integers(FEWEST, 300),
    m=st.integers(1, 3),
    average=st.floats(0.2, 3.0),
    rho=st.lists(st.floats(-0.9, 0.9), min_size=8, max_size=8),
    alpha=st.sampled_from([0.001, 0.01, 0.05]),
)
@settings(max_examples=100, deadline=None)
def test_limits_and_p_values_agree(
    k: int, m: int, average: float, rho: list[float], alpha: float
) -> None:
    found = judge(k, k * m, average, rho, alpha=alpha)
    level = 1.0 - math.sqrt(1.0 - alpha)
    low, high = found.nis_limits
    assert (found.nis_p < level) == (not low <= average <= high)
    assert (found.portmanteau_p < level) == (found.portmanteau > found.portmanteau_limit)
    assert (found.verdict == "consistent") == (min(found.nis_p, found.portmanteau_p) >= level)


# The law under a matched filter


@pytest.mark.parametrize("k", [20, 50, 200])
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("alpha", [0.01, 0.05])
def test_false_alarm_rate_of_white_innovations(k: int, m: int, alpha: float) -> None:
    nu = np.random.default_rng([1, k, m, round(1000 * alpha)]).standard_normal(
        (WINDOWS, k + LAGS, m)
    )
    hits = np.count_nonzero(_verdicts(nu, k, alpha))
    assert _inside_its_interval(int(hits), WINDOWS, alpha), hits / WINDOWS


@pytest.mark.parametrize("k", [20, 50, 200])
@pytest.mark.parametrize("source", study.SOURCES, ids=lambda s: s.name)
def test_false_alarm_rate_of_a_matched_kalman_filter(k: int, source: AidedAxis) -> None:
    rng = np.random.default_rng([2, k, int(source.sigma_m)])
    nu = innovations(source, Fault("none"), WINDOWS, k + LAGS, 0, rng)
    hits = np.count_nonzero(_verdicts(nu, k, 0.01))
    assert _inside_its_interval(int(hits), WINDOWS, 0.01), hits / WINDOWS


def test_eight_lags_at_five_percent_each_would_cry_wolf() -> None:
    nu = np.random.default_rng(3).standard_normal((4000, 50 + LAGS, 2))
    _, rho = study.window_statistics(nu, 50)
    each = judge(50, 100, 1.0, [0.0] * LAGS).rho_interval[1]
    assert 0.25 < float((np.abs(rho[:, 0]) > each).any(axis=1).mean()) < 0.4


@pytest.mark.parametrize("lag", [1, 4, 8])
def test_variance_of_rho_in_a_short_window(lag: int) -> None:
    k, runs = 20, 60_000
    nu = np.random.default_rng(4).standard_normal((runs, k + LAGS, 1))
    rho = study.window_statistics(nu, k)[1][:, 0, lag - 1]
    expected = 1.0 / (k + 2.0 * (1.0 - lag / k))
    assert float(np.mean(rho**2)) == pytest.approx(expected, rel=4.0 * math.sqrt(2.0 / runs))


def _truncated(gate: float, runs: int, k: int, m: int) -> Array:
    """Innovations that passed a gate, (runs, k, m)."""
    rng = np.random.default_rng(5)
    nu = rng.standard_normal((int(runs * k / gate * 1.05), m))
    passed = nu[np.einsum("km,km->k", nu, nu) < chi2.ppf(gate, m)]
    return np.asarray(passed[: runs * k].reshape(runs, k, m))


@pytest.mark.parametrize("m", [1, 2, 3])
def test_gate_is_accounted_for(m: int) -> None:
    """At 0.9 the average falls far below one; with the gate told, its interval follows."""
    gate, k, runs = 0.9, 100, 3000
    average = np.sum(_truncated(gate, runs, k, m) ** 2, axis=(1, 2)) / (k * m)
    told, untold = (judge(k, k * m, 1.0, [0.0] * 8, gate=g) for g in (gate, 1.0))
    outside = [
        np.count_nonzero((average < low) | (average > high))
        for low, high in (told.nis_interval, untold.nis_interval)
    ]
    assert _inside_its_interval(int(outside[0]), runs, 0.05)
    assert outside[1] > 0.3 * runs


def test_usual_gate_matters_little() -> None:
    told, untold = (judge(100, 200, 1.0, [0.0] * 8, gate=g) for g in (0.9999, 1.0))
    assert told.nis_interval == pytest.approx(untold.nis_interval, abs=0.002)


def test_detectable_figures_are_noticed_as_often_as_stated() -> None:
    k, m, runs = 50, 2, 4000
    stated = judge(k, k * m, 1.0, [0.0] * LAGS)
    nu = np.random.default_rng(6).standard_normal((runs, k + LAGS, m))
    for ratio in stated.detectable_ratio:
        average = study.window_statistics(nu * math.sqrt(ratio), k)[0]
        low, high = stated.nis_limits
        assert float(((average < low) | (average > high)).mean()) == pytest.approx(0.9, abs=0.02)


# The monitor


def test_monitor_gives_eq_8_as_printed() -> None:
    k, m = 30, 3
    nu = np.random.default_rng(7).standard_normal((k + LAGS + 77, m))
    monitor = ConsistencyMonitor(ConsistencyOptions(window=k))
    for row in nu:
        monitor.add(row)
    found = monitor.report()
    last = np.arange(len(nu) - k, len(nu))
    assert (found.k, found.dof) == (k, k * m)
    assert found.nis_average == pytest.approx(float(np.sum(nu[last] ** 2)) / (k * m))
    for lag in range(1, LAGS + 1):
        a, b = nu[last], nu[last - lag]
        rho = np.sum(a * b) / math.sqrt(np.sum(a * a) * np.sum(b * b))
        assert found.rho[lag - 1] == pytest.approx(float(rho))


@given(
    k=st.integers(FEWEST, 60), m=st.integers(1, 3), epochs=st.integers(0, 260), seed=st.integers(0)
)
@settings(max_examples=25, deadline=None)
def test_monitor_agrees_with_cumulative_sums(k: int, m: int, epochs: int, seed: int) -> None:
    nu = np.random.default_rng(seed).standard_normal((epochs, m))
    monitor = ConsistencyMonitor(ConsistencyOptions(window=k))
    for row in nu:
        monitor.add(row)
    found = monitor.report()
    held = min(k, max(0, epochs - LAGS))
    assert found.k == monitor.k == held
    if held < FEWEST:
        assert found.verdict == found.window_verdict == "too_few"
        assert math.isnan(found.nis_average)
        return
    average, rho = study.window_statistics(nu[None], held)
    assert found.nis_average == pytest.approx(float(average[0, -1]), rel=1e-9)
    assert found.rho == pytest.approx(rho[0, -1].tolist(), abs=1e-9)
    verdict = int(study.window_verdicts(average, rho, m, held, 0.01)[0, -1])
    assert found.window_verdict == study.VERDICTS[verdict]


def test_a_huge_innovation_leaves_no_trace_behind_the_window() -> None:
    options = ConsistencyOptions(window=40)
    tainted, clean = ConsistencyMonitor(options), ConsistencyMonitor(options)
    nu = np.random.default_rng(8).standard_normal((200, 2))
    for i, row in enumerate(nu):
        tainted.add(row * (1e9 if i == 30 else 1.0))
        clean.add(row)
    assert tainted.report().nis_average == pytest.approx(clean.report().nis_average, rel=1e-12)
    assert tainted.report().rho == pytest.approx(clean.report().rho, abs=1e-12)


def test_whitening_by_a_full_covariance() -> None:
    s = np.array([[4.0, 1.5], [1.5, 9.0]])
    nu = np.random.default_rng(9).multivariate_normal(np.zeros(2), s, 150)
    assert np.sum(whiten(nu[0], s) ** 2) == pytest.approx(nu[0] @ np.linalg.inv(s) @ nu[0])
    given_s, whitened = ConsistencyMonitor(), ConsistencyMonitor()
    for row in nu:
        given_s.add(row, s)
        whitened.add(whiten(row, s))
    assert given_s.report() == whitened.report()


def test_unwhitened_form_correlates_metres() -> None:
    """A large white component hides a small coloured one, unless the innovation is whitened."""
    rng = np.random.default_rng(10)
    s = np.diag([900.0, 1.0])
    nu = np.stack([30.0 * rng.standard_normal(200), np.tile([1.0, -1.0], 100)], axis=1)
    paper = ConsistencyMonitor(ConsistencyOptions(whitened=False))
    usual = ConsistencyMonitor()
    for row in nu:
        paper.add(row, s)
        usual.add(row, s)
    assert paper.report().nis_average == pytest.approx(usual.report().nis_average)
    assert usual.report().rho[0] < -0.3
    assert abs(paper.report().rho[0]) < 0.3
    assert paper.report().rho_interval[1] == pytest.approx(1.96 / 10.0, abs=1e-3)
    with pytest.raises(ValueError, match="covariance"):
        paper.add(nu[0])


def test_bad_innovations_are_named_counted_and_left_out() -> None:
    monitor = ConsistencyMonitor()
    good = np.random.default_rng(11).standard_normal((60, 2))
    for row in good:
        monitor.add(row)
    before = monitor.report()
    monitor.add(np.array([math.nan, 0.0]))
    monitor.add(np.array([math.inf, 0.0]))
    monitor.add(np.array([1e200, 0.0]))
    monitor.add(good[0], np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert monitor.rejected == {"not_finite": 3, "not_positive_definite": 1}
    assert monitor.report() == before


def test_zero_innovations_are_pessimistic_not_an_error() -> None:
    monitor = ConsistencyMonitor()
    for _ in range(200):
        monitor.add(np.zeros(2))
    assert monitor.verdict == "pessimistic"
    assert monitor.report().rho == (0.0,) * LAGS


def test_verdict_changes_only_after_half_a_window_of_contradiction() -> None:
    k = 50
    monitor = ConsistencyMonitor(ConsistencyOptions(window=k))
    rng = np.random.default_rng(12)
    for row in rng.standard_normal((300, 2)):
        monitor.add(row)
    assert monitor.verdict == "consistent"
    held = 0
    while monitor.verdict == "consistent":
        monitor.add(3.0 * rng.standard_normal(2))
        held = held + 1 if monitor.window_verdict != "consistent" else 0
    assert monitor.verdict == monitor.report().verdict == "optimistic"
    assert held == k // 2
    for row in rng.standard_normal((k // 2, 2)):  # good again: the window still holds the fault
        monitor.add(row)
    assert monitor.verdict == "optimistic"
    for row in rng.standard_normal((2 * k, 2)):
        monitor.add(row)
    assert monitor.verdict == "consistent"


def test_a_short_excess_does_not_change_the_verdict() -> None:
    k = 50
    monitor = ConsistencyMonitor(ConsistencyOptions(window=k))
    rng = np.random.default_rng(13)
    seen = set()
    for i in range(600):
        scale = 30.0 if i == 300 else 1.0
        monitor.add(scale * rng.standard_normal(2))
        if i >= 300:
            seen.add(monitor.window_verdict)
        if 200 <= i < 300 + k // 2 - 1:
            assert monitor.verdict == "consistent"
    assert "optimistic" in seen


def test_reporting_often_or_never_makes_no_difference() -> None:
    often, never = ConsistencyMonitor(), ConsistencyMonitor()
    for row in 1.5 * np.random.default_rng(14).standard_normal((150, 2)):
        often.add(row)
        often.report()
        never.add(row)
    assert often.report() == never.report()


def test_first_verdict_comes_before_the_window_is_full() -> None:
    monitor = ConsistencyMonitor(ConsistencyOptions(window=200))
    epochs = 0
    for row in np.random.default_rng(15).standard_normal((200, 2)):
        monitor.add(row)
        epochs += 1
        if monitor.verdict != "too_few":
            break
    assert monitor.verdict == "consistent"
    assert FEWEST + LAGS < epochs <= 2 * FEWEST + LAGS


def test_reset_and_a_changed_dimension_start_over() -> None:
    monitor = ConsistencyMonitor()
    rng = np.random.default_rng(16)
    for row in rng.standard_normal((150, 3)):
        monitor.add(row)
    assert (monitor.verdict, monitor.restarts) == ("consistent", 0)
    monitor.add(np.zeros(2))
    assert (monitor.verdict, monitor.k, monitor.restarts) == ("too_few", 0, 1)
    for row in rng.standard_normal((150, 2)):
        monitor.add(row)
    assert (monitor.verdict, monitor.report().dof) == ("consistent", 200)
    monitor.reset()
    assert (monitor.report().verdict, monitor.k, monitor.restarts) == ("too_few", 0, 1)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"window": FEWEST - 1}, "window"),
        ({"alpha": 0.0}, "alpha"),
        ({"alpha": 1.0}, "alpha"),
        ({"gate": 0.0}, "gate"),
        ({"gate": 1.1}, "gate"),
    ],
)
def test_options_that_cannot_be(wrong: dict[str, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        ConsistencyOptions(**wrong)  # type: ignore[arg-type]
