"""Parallel Monte Carlo runs with progress, and the bounds of their mean NEES.

Each run has its own generator, made of the study's seed and the run's number, so that results do
not depend on the order of runs or on the number of processes. `run_generator` makes it by a spawn
key, as numpy intends. The papers' studies mix [seed, number] instead, which keeps runs as far apart
(numpy hashes both into the same pool of 128 bits) but pads with zeros: [5] and [5, 0] are one
stream. None of them has two such lists, and their printed figures stand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.stats import chi2

from fusiond.workers.runner_interface import Outcome, Runner

if TYPE_CHECKING:
    from fusiond.studies.stored_runs import StoredRuns

TAIL = (1.0 - 0.95) / 2.0
"""Share of either side outside a 95 % interval."""
MOST_AT_ONCE = 100
"""Runs handed to a worker at once, so that the hand-over takes a negligible share of the time."""
SHARES = 4
"""Least chunks a worker, given enough runs, so that all end at about the same time."""

Progress = Callable[[int, int], None]
"""Callback with the number of finished steps and of all steps."""
R = TypeVar("R")
T = TypeVar("T")


class RunsLostError(Exception):
    """Error: too few runs succeeded for an average."""


@dataclass(frozen=True, slots=True)
class LostRun:
    """Run without a result: number, outcome and reason (`fusiond.workers.runner_interface`)."""

    number: int
    ended: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Given:
    runner: Runner
    kept: StoredRuns | None
    lost: list[LostRun] = field(default_factory=list)


_GIVEN: ContextVar[_Given | None] = ContextVar("runner of Monte Carlo runs", default=None)


@contextmanager
def runner_context(runner: Runner, kept: StoredRuns | None = None) -> Iterator[list[LostRun]]:
    """Context in which runs are made by `runner`, except those in `kept`, where new ones are added;
    the lost runs."""
    given = _Given(runner, kept)
    token = _GIVEN.set(given)
    try:
        yield given.lost
    finally:
        _GIVEN.reset(token)


def step_counter(progress: Progress | None, total: int) -> Callable[[], None]:
    """Callback after each of `total` steps."""
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return step


def map_runs(
    work: Callable[[int], R], runs: int, progress: Callable[[], None] | None = None
) -> list[R]:
    """Results of `work` for 0 to `runs` - 1 in order, by workers of `runner_context` or in this
    process.

    Workers leave out the runs that they lost. Raises `RunsLostError` if fewer than two are left.
    """
    return map_items(work, range(runs), progress)


def map_items(
    work: Callable[[T], R], items: Sequence[T], progress: Callable[[], None] | None = None
) -> list[R]:
    """Results of `work` for each item, as in `map_runs`."""
    given = _GIVEN.get()
    found: dict[int, R] = {}
    if given is None:
        for number, item in enumerate(items):
            found[number] = work(item)
            if progress is not None:
                progress()
        return list(found.values())
    lost_before = len(given.lost)
    for outcome in _outcomes(given, work, items):
        if outcome.ended == "done":
            found[outcome.index] = outcome.result  # type: ignore[assignment]  # None may be an R
        else:
            given.lost.append(LostRun(outcome.index, outcome.ended, outcome.reason))
        if progress is not None:
            progress()
    if len(found) < min(2, len(items)):
        last = given.lost[-1]
        raise RunsLostError(
            f"{len(given.lost) - lost_before} of {len(items)} runs lost; run {last.number}: "
            f"{last.ended}: {last.reason}"
        )
    return [found[number] for number in sorted(found)]


def _outcomes(given: _Given, work: Callable[[T], R], items: Sequence[T]) -> Iterator[Outcome[R]]:
    """Stored outcomes, then new ones, which are stored."""
    part = None if given.kept is None else given.kept.of(work)
    known = {} if part is None else part.known(len(items))
    yield from known.values()
    todo = [number for number in range(len(items)) if number not in known]
    chunk = max(1, min(MOST_AT_ONCE, len(todo) // (SHARES * given.runner.workers)))
    for outcome in given.runner.outcomes(work, [items[number] for number in todo], chunk):
        numbered = replace(outcome, index=todo[outcome.index])
        if part is not None:
            part.add(numbered.index, numbered)
        yield numbered


def run_generator(seed: int, number: int) -> np.random.SeedSequence:
    """Random generator of run `number`: child `number` of the seed's sequence, made without the
    other children."""
    return np.random.SeedSequence(seed, spawn_key=(number,))


def nees_interval(runs: int, dof: int, tail: float = TAIL) -> list[float]:
    """Interval of the average over `runs` independent NEES of a matched filter; `tail` is the
    probability of either side outside it."""
    return [float(chi2.ppf(p, runs * dof)) / runs for p in (tail, 1.0 - tail)]
