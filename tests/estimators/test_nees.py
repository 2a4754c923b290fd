"""Monte Carlo: the filter's sigma is honest (NEES, NIS) for every shipped model without a clock;
those with one are in tests/estimators/test_nees_clock.py.

Each run draws its sensor errors from `fusiond.simulation.sensor_errors` with the very `Imu` that
the filter is configured with, starts from the true state plus an error drawn from P0, and feeds
back. With N runs the sum of NEES over the runs is chi-square with N x dof degrees of freedom at
each instant; NIS of all measurements of all runs is chi-square with the sum of their dimensions, as
innovations are white (Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.models.model import Model
from tests import runs
from tests.estimators.monte_carlo import (
    FIRST_FIX_S,
    MATCHED,
    RATE_HZ,
    drawn_measurements,
    interval,
)

Array = NDArray[np.float64]

SECONDS, RUNS = 240.0, 60
"""A sigma of 15 states that is 12 % too small or 11 % too large is noticed at one instant with 90 %
probability; of three states alone, 28 % too small or 23 % too large."""
INSTANTS_S = (20.0, 90.0, 160.0, 239.0)


@dataclass
class Figures:
    """NEES (runs, instants) by group of states, NIS by source as (sum, degrees)."""

    nees: dict[str, Array]
    degrees: dict[str, int]
    nis: dict[str, tuple[float, int]] = field(default_factory=dict)
    gated: int = 0


def _projection(model: Model) -> Array:
    """Rows that take the error state to the one that is compared: active navigation errors and, by
    axis, the sum of the parameters that act alike (constant and Markov part of a gyro's drift)."""
    rows = [np.eye(model.size)[i] for i in range(9) if model.active[i]]
    for column in range(9, 21):
        slots = model.parameters(column)
        if slots:
            rows.append(np.eye(model.size)[slots].sum(axis=0))
    return np.array(rows)


def monte_carlo(name: str, count: int, first_seed: int = 1000) -> Figures:
    """Run `count` drives and collect the figures."""
    imu = MATCHED[name]
    truth = runs.town_truth(SECONDS, RATE_HZ, 0.0 if name.startswith("planar") else 3.0)
    times = runs.sample_times(truth)
    fixes_s = np.arange(FIRST_FIX_S, SECONDS, 1.0)
    true_at = runs.true_nav(truth, np.array([0.0, *INSTANTS_S]))
    model, estimator = runs.make_estimator(name, imu)
    compare = _projection(model)
    horizontal = 2 if model.hold_height else 3
    groups = {
        "attitude": slice(0, 3),
        "velocity": slice(3, 3 + horizontal),
        "position": slice(3 + horizontal, 3 + 2 * horizontal),
        "navigation": slice(0, 3 + 2 * horizontal),
        "all": slice(0, len(compare)),
    }
    figures = Figures(
        {g: np.zeros((count, len(INSTANTS_S))) for g in groups},
        {g: len(compare[s]) for g, s in groups.items()},
    )
    sd = runs.initial_sd(model, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0)
    columns = sorted({int(c) for c in model.column_of[9:]})
    for k in range(count):
        run = runs.imu_run(imu, truth, first_seed + k)
        rng = np.random.default_rng([first_seed + k, 1])
        buffer = runs.filled_buffer(imu, times, run.samples)
        error = rng.standard_normal(model.size) * sd
        estimator.initialise(
            0, 0, runs.with_error(true_at[0], error[:9]), np.zeros(model.size), np.diag(sd**2)
        )
        measurements = drawn_measurements(name, truth, fixes_s, rng)
        following = 0
        for at, t_s in enumerate(INSTANTS_S):
            while following < len(fixes_s) and fixes_s[following] <= t_s:
                for measurement in measurements[following]:
                    estimator.propagate(buffer, measurement.t_ns)
                    outcome = estimator.update(measurement)
                    figures.gated += outcome.name != "fused"
                    total, degrees = figures.nis.get(measurement.source, (0.0, 0))
                    figures.nis[measurement.source] = (
                        total + outcome.nis,
                        degrees + outcome.degrees,
                    )
                following += 1
            estimator.propagate(buffer, round(t_s * 1e9))
            parameters = np.concatenate([run.biases[round(t_s * RATE_HZ) - 1], run.scales])
            uncorrected = [
                parameters[c - 9] - sum(estimator.xi[s] for s in model.parameters(c))
                for c in columns
            ]
            nav = runs.nav_error(estimator.nav, true_at[1 + at])[model.active[:9]]
            x = np.concatenate([nav, uncorrected])
            p = compare @ estimator.covariance @ compare.T
            for g, s in groups.items():
                figures.nees[g][k, at] = x[s] @ np.linalg.solve(p[s, s], x[s])
    return figures


@pytest.mark.parametrize("name", sorted(MATCHED))
def test_stated_sigma_is_honest(name: str) -> None:
    figures = monte_carlo(name, RUNS)
    assert figures.gated == 0
    # 99 % that all of a model's intervals hold at once (Bonferroni over groups and instants).
    checks = len(figures.nees) * len(INSTANTS_S) + len(figures.nis)
    probability = 1.0 - 0.01 / checks
    failures = []
    for group, nees in figures.nees.items():
        low, high = interval(RUNS * figures.degrees[group], probability)
        for t_s, total in zip(INSTANTS_S, nees.sum(axis=0), strict=True):
            print(
                f"{name} {group:10s} t={t_s:5.0f} s  mean NEES {total / RUNS:6.2f} "
                f"[{low / RUNS:.2f}, {high / RUNS:.2f}] dof {figures.degrees[group]}"
            )
            if not low <= total <= high:
                failures.append((group, t_s, total / RUNS, low / RUNS, high / RUNS))
    for source, (total, degrees) in figures.nis.items():
        low, high = interval(degrees, probability)
        print(
            f"{name} NIS {source}: {total / degrees:.4f} "
            f"[{low / degrees:.4f}, {high / degrees:.4f}]"
        )
        if not low <= total <= high:
            failures.append((source, math.nan, total / degrees, low / degrees, high / degrees))
    assert not failures
