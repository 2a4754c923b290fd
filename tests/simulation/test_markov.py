"""Processes that follow first-order ones: as large as they say, and smooth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.simulation.markov import gauss_markov, smooth_markov

STEP_S, TAU_S, SIGMA = 1.0, 100.0, 2.0
OPTIONS = {"step_s": STEP_S, "correlation_s": TAU_S, "sigma": SIGMA}


def test_smooth_processes_are_steady_and_of_their_sigma() -> None:
    """6 sigma of the mean square of 20 000 draws are 6 %."""
    process = smooth_markov(np.random.default_rng(1), (300, 20_000), **OPTIONS)
    for k in (0, 1, 20, 100, 299):
        assert np.mean(process[k] ** 2) == pytest.approx(SIGMA**2, rel=0.06), k
    # E[s(t) s(t + T)] = sigma^2 (1 + T / T) exp(-T / T).
    both = np.mean(process[0] * process[100])
    assert both == pytest.approx(2.0 * SIGMA**2 * math.exp(-1.0), rel=0.06)


def test_their_rate_is_theirs_and_not_noise() -> None:
    """sigma / T, whatever the step; that of a first-order one is 2 sigma^2 / (T dt), 14 times as
    much here."""
    smooth = np.diff(smooth_markov(np.random.default_rng(2), (200, 2000), **OPTIONS), axis=0)
    rough = np.diff(gauss_markov(np.random.default_rng(2), (200, 2000), **OPTIONS), axis=0)
    assert np.sqrt(np.mean(smooth**2)) == pytest.approx(SIGMA / TAU_S, rel=0.05)
    assert np.sqrt(np.mean(rough**2)) == pytest.approx(SIGMA * math.sqrt(2.0 / TAU_S), rel=0.05)


def test_other_draws_stay_what_they_were() -> None:
    ours, theirs = np.random.default_rng(3), np.random.default_rng(3)
    smooth_markov(ours, (5, 3), **OPTIONS)
    gauss_markov(theirs, (5, 3), **OPTIONS)
    assert ours.standard_normal() == theirs.standard_normal()
