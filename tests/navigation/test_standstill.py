"""Windows on a grid of time, judged once each, whatever the chunks that samples come in."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.navigation.standstill import (
    LONGEST_RUN,
    QuietLimits,
    StandstillDetector,
    Window,
    next_cell,
)

WIDTH = 1_000_000_000
LIMITS = QuietLimits(WIDTH, rate_sd=0.02, force_sd=0.2, mean_rate=0.02)
COUNT = 100


def windows(samples: np.ndarray, chunk: int) -> list[Window]:
    """All windows of samples (n, 6) at 100 Hz."""
    times = WIDTH // COUNT * np.arange(len(samples), dtype=np.int64)
    detector, found = StandstillDetector(LIMITS), []
    for new in range(0, len(samples), chunk):
        found += detector.feed(times, samples, 0, new, min(new + chunk, len(samples)))
    return found


@pytest.mark.parametrize("chunk", [1, 7, 333])
def test_windows_and_runs_of_quiet_ones(chunk: int) -> None:
    rng = np.random.default_rng(2)
    samples = rng.normal(0.0, [0.01] * 3 + [0.1] * 3, (40 * COUNT + 1, 6))
    samples[15 * COUNT : 16 * COUNT, 1] += 0.03  # turns
    samples[20 * COUNT : 21 * COUNT, 4] *= 3.0  # is shaken
    samples[25 * COUNT : 35 * COUNT, 3] += 0.5  # stands otherwise
    found = windows(samples, chunk)
    parts = samples[:-1].reshape(-1, COUNT, 6)
    assert [w.end_ns for w in found] == [WIDTH * (k + 1) - WIDTH // COUNT for k in range(40)]
    assert [k for k, w in enumerate(found) if not w.quiet] == [15, 20, 25, 35]
    run: list[np.ndarray] = []
    for w, part in zip(found, parts, strict=True):
        mean = part.mean(axis=0)
        np.testing.assert_allclose(np.concatenate((w.mean_rate, w.mean_force)), mean, atol=1e-15)
        run = [*run, w.mean_rate][-LONGEST_RUN:] if w.quiet else []
        assert w.run == max(len(run), 1)
        if len(run) > 1:
            np.testing.assert_allclose(w.run_rate, np.mean(run, axis=0), atol=1e-15)
            np.testing.assert_allclose(w.scatter, np.var(run, axis=0, ddof=1), atol=1e-15)
        else:
            assert w.run_rate.tolist() == w.mean_rate.tolist()
            assert w.scatter.tolist() == [0.0, 0.0, 0.0]
    assert max(w.run for w in found) == LONGEST_RUN


def test_a_window_that_was_told_stays_as_it_was() -> None:
    samples = np.random.default_rng(3).normal(0.0, 1e-3, (30 * COUNT, 6))
    found = windows(samples, 50)
    alone = windows(samples[: 12 * COUNT], 50)
    for w, before in zip(found, alone, strict=False):
        assert w.run_rate.tolist() == before.run_rate.tolist()
        assert w.scatter.tolist() == before.scatter.tolist()


@pytest.mark.parametrize("begin", [0, -5 * WIDTH, 2**63 - 2 * WIDTH])
def test_next_cell(begin: int) -> None:
    times = begin + np.arange(0, 2 * WIDTH, WIDTH // 4, dtype=np.int64)
    cells = (times // WIDTH).tolist()
    for first in range(len(times)):
        for cell in {*cells, -1}:
            other = [i for i in range(first, len(times)) if cells[i] != cell]
            assert next_cell(times, first, len(times), WIDTH, cell) == (other[0] if other else -1)
