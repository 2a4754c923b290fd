"""Checkpoints of a timeline lie close where measurements come late, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from fusiond.navigator.timeline import Entry, Timeline
from tests.navigator.timeline_drive import KEEP_S, START_NS, drive

MS = 1_000_000


def driven(late_ms: int, until_ms: int = 6000) -> tuple[Timeline, list[Entry]]:
    """A receiver's fixes, ten a second, each so late; all that was applied, in its order."""
    d = drive()
    applied: list[Entry] = []
    timeline = d.timeline()
    timeline._on_outcome = applied.append
    fix: Any = next(a for a in d.measurements if a.source == "gnss")
    waiting = [replace(fix, t_ns=START_NS + k * MS) for k in range(100, until_ms, 100)]
    for row, t_ns in enumerate(d.times.tolist()):
        if t_ns > START_NS + until_ms * MS:
            break
        timeline.imu.append(d.times[row : row + 1], d.samples[row : row + 1])
        while waiting and waiting[0].t_ns + late_ms * MS <= t_ns:
            timeline.insert(waiting.pop(0))
        timeline.advance()
    return timeline, applied


def gaps_ms(timeline: Timeline) -> list[tuple[float, float]]:
    """Age of each checkpoint but the last, and the time to the next."""
    instants = [c.snapshot.t_ns for c in timeline._checkpoints]
    latest = timeline.imu.latest_ns
    return [((latest - a) / MS, (b - a) / MS) for a, b in pairwise(instants)]


@pytest.mark.parametrize("late_ms", [60, 100])
def test_a_late_fix_has_few_of_those_before_to_apply_again(late_ms: int) -> None:
    timeline, applied = driven(late_ms)
    fixes = len({entry.key for entry in applied})
    assert fixes > 50
    assert timeline.counters.rewinds == fixes
    assert len(applied) <= 2 * fixes


@pytest.mark.parametrize("until_ms", [round(900 * KEEP_S), round(1500 * KEEP_S)])
def test_a_rewind_is_an_eighth_longer_than_it_must_be(until_ms: int) -> None:
    """Up to the configured half second; between two measurements no checkpoint is taken."""
    timeline, _ = driven(60, until_ms)
    found = gaps_ms(timeline)
    for age, gap in found:
        assert gap <= min(500.0, age / 8.0) + 100.0
    assert len(found) < 60
    older = [gap for age, gap in found if age > 4000.0]
    assert sum(older) > 300.0 * len(older) > 0.0  # those in between have gone


def test_without_a_rewind_checkpoints_are_as_configured() -> None:
    timeline, applied = driven(0)
    assert timeline.counters.rewinds == 0
    assert len(applied) == len({entry.key for entry in applied})
    assert all(gap >= 500.0 for _, gap in gaps_ms(timeline))
