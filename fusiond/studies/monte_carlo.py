"""Monte Carlo runs: on processes, with their progress, and what NEES may be on average."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from os import cpu_count
from typing import TypeVar

from scipy.stats import chi2

WORKERS = 2
TAIL = (1.0 - 0.95) / 2.0
"""Share of either side outside a 95 % interval."""

Progress = Callable[[int, int], None]
"""Hears how many steps are done, and of how many."""
R = TypeVar("R")


def step_counter(progress: Progress | None, total: int) -> Callable[[], None]:
    """What to call after each of `total` steps."""
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return step


def on_processes(
    work: Callable[[int], R], runs: int, progress: Callable[[], None] | None = None
) -> list[R]:
    """`work` of 0 to `runs` - 1, in order, on two processes where there are two processors."""
    found = []
    with ProcessPoolExecutor(min(WORKERS, cpu_count() or 1, runs)) as pool:
        for result in pool.map(work, range(runs)):
            found.append(result)
            if progress is not None:
                progress()
    return found


def nees_interval(runs: int, dof: int, tail: float = TAIL) -> list[float]:
    """Interval of the average over `runs` independent NEES of a matched filter; `tail` is the
    probability of either side outside it."""
    return [float(chi2.ppf(p, runs * dof)) / runs for p in (tail, 1.0 - tail)]
