"""A recorder's stamps on monotonic time: steps of its clock, pauses, damage, two controllers."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest

from fusiond.clock.recorder_clock import ENOUGH_REPORTS, FOLLOWING, RecorderClock, set_by

S, MS = 1_000_000_000, 1_000_000
BEGIN = 1_760_000_000 * S
PERIOD = 10 * MS


def replayed(
    stamps: Sequence[int],
    utc: Callable[[int], int | None] = lambda k: None,
    channel: Callable[[int], int] = lambda k: 0,
) -> tuple[RecorderClock, list[int], Counter[str]]:
    """The clock at the end, monotonic instants of the frames that are taken, and the verdicts;
    `utc(k)` is what reports say of a step before frame k."""
    clock, times, verdicts = RecorderClock(), [], Counter[str]()
    for k, stamp in enumerate(stamps):
        of = channel(k), 9
        if clock.is_odd(stamp, of):
            following = stamps[k + 1 : k + 1 + FOLLOWING]
            verdict = clock.take(stamp, of, following, lambda k=k: utc(k))  # type: ignore[misc]
        else:
            clock.next(stamp, of)
            verdict = "taken"
        verdicts[verdict] += 1
        if verdict == "taken":
            times.append(clock.t_ns)
    return clock, times, verdicts


def even(n: int = 1000) -> list[int]:
    return [BEGIN + k * PERIOD for k in range(n)]


STEPS = [86_400 * S, -86_400 * S, -3600 * S, 5 * S, -5 * S, 1_750_000_000 * S, 300 * MS, -700 * MS]


@pytest.mark.parametrize("by", STEPS)
def test_a_step_that_utc_shows_is_none_of_time(by: int) -> None:
    """Reports are off by some milliseconds: between frames passes what passes between them."""
    stamps = [t + (by if k >= 500 else 0) for k, t in enumerate(even())]
    clock, times, verdicts = replayed(stamps, lambda k: by + 7 * MS)
    assert times == even()
    assert [step.set_ns for step in clock.steps] == [by]
    assert clock.steps[0].stamp_ns == stamps[500]
    assert verdicts == {"taken": 1000}


def test_steps_add_up() -> None:
    by = {300: 5 * S, 600: -3600 * S, 800: 86_400 * S}
    stamps = [t + sum(s for at, s in by.items() if k >= at) for k, t in enumerate(even())]
    clock, times, _ = replayed(stamps, by.get)
    assert times == even()
    assert clock.ahead_ns == sum(by.values())
    assert clock.t_ns + clock.ahead_ns == stamps[-1]


def test_without_utc_what_goes_back_was_set_and_what_leaps_was_a_pause() -> None:
    back = [t - (3600 * S if k >= 500 else 0) for k, t in enumerate(even())]
    clock, times, _ = replayed(back)
    assert (times, clock.ahead_ns) == (even(), -3600 * S)
    leap = [t + (3600 * S if k >= 500 else 0) for k, t in enumerate(even())]
    clock, times, _ = replayed(leap)
    assert (times, clock.steps) == (leap, [])


def test_a_pause_that_utc_shows_is_one_and_may_hide_a_step() -> None:
    leap = [t + (3600 * S if k >= 500 else 0) for k, t in enumerate(even())]
    clock, times, _ = replayed(leap, lambda k: 20 * MS)
    assert (times, clock.steps) == (leap, [])
    # The clock was set back by a day while nothing was recorded for five minutes.
    hidden = [t + (300 * S - 86_400 * S if k >= 500 else 0) for k, t in enumerate(even())]
    clock, times, _ = replayed(hidden, lambda k: -86_400 * S)
    assert times == [t + (300 * S if k >= 500 else 0) for k, t in enumerate(even())]


def test_stamps_before_the_trigger_are_no_step() -> None:
    """Two logs in the wrong order: UTC went back as well."""
    stamps = [*even(), *(t - 7200 * S for t in even())]
    clock, _, verdicts = replayed(stamps, lambda k: 0)
    assert clock.steps == []
    assert verdicts == {"taken": 1000, "time_backwards": 1000}


@pytest.mark.parametrize("wrong", [-(10**6) * S, -2 * S, 2 * S, 10**6 * S])
@pytest.mark.parametrize("at", [0, 1, 500, 998])
def test_a_stamp_alone_is_damage(wrong: int, at: int) -> None:
    stamps = even()
    stamps[at] += wrong
    clock, times, verdicts = replayed(stamps, lambda k: wrong if at else None)
    assert clock.steps == []
    if at == 0 and wrong < 0:  # a pause, for all that one can see
        assert times == stamps
        return
    name = "time_backwards" if wrong < 0 else "time_ahead"
    assert verdicts == {"taken": 999, name: 1}
    assert times == [t for k, t in enumerate(even()) if k != at]


def test_another_channel_may_be_a_little_behind() -> None:
    """By its controller's clock, or because it is written in blocks: its frames have come."""
    stamps = [t - (400 * MS if k % 2 else 0) for k, t in enumerate(even())]
    clock, times, verdicts = replayed(stamps, lambda k: 0 // 0, lambda k: k % 2)
    assert (clock.steps, verdicts) == ([], {"taken": 1000})
    assert times == [even()[k - k % 2] for k in range(1000)]
    first, second = even()[0::2], even()[1::2]
    blocks = [t for k in range(0, 500, 50) for t in first[k : k + 50] + second[k : k + 50]]
    clock, times, verdicts = replayed(blocks, lambda k: 0 // 0, lambda k: k // 50 % 2)
    assert (clock.steps, verdicts) == ([], {"taken": 1000})
    assert times == sorted(times)


def test_another_channel_that_is_far_behind_is_left_out() -> None:
    stamps = [t - (7 * S if k % 2 else 0) for k, t in enumerate(even())]
    clock, times, verdicts = replayed(stamps, lambda k: None, lambda k: k % 2)
    assert (clock.steps, times) == ([], even()[::2])
    assert verdicts == {"taken": 500, "time_backwards": 500}


def test_controllers_that_disagree_are_no_steps() -> None:
    """A second one is 400 ms behind, and its frames come in turn with those of the first."""
    stamps = [t - (400 * MS if k % 2 else 0) for k, t in enumerate(even())]
    asked = 0

    def utc(k: int) -> int:
        nonlocal asked
        asked += 1
        return 0

    clock, times, _ = replayed(stamps, utc)
    assert clock.steps == []
    assert times == even()[::2]
    assert asked <= 2


def test_a_sparse_bus_is_not_asked_at_each_frame() -> None:
    stamps = [BEGIN + k * S for k in range(100)]
    asked: list[int] = []
    replayed(stamps, asked.append)  # type: ignore[arg-type]
    assert len(asked) <= 1


def test_reports_of_utc_on_both_sides() -> None:
    before, after = [5 * S + k * MS for k in range(5)], [9 * S + k * MS for k in range(3)]
    assert set_by(before, after) == pytest.approx(4 * S, abs=3 * MS)
    assert set_by([], after) is None
    assert set_by(before, after[: ENOUGH_REPORTS - 1]) is None
    # Reports of whole seconds that come any time later: what they hide is not known.
    rough = [5 * S, 5 * S + 900 * MS, 5 * S + 300 * MS]
    assert set_by(rough, [t + 700 * MS for t in rough]) is None
    assert set_by(rough, [t + 5 * S for t in rough]) == 5 * S


def test_a_log_that_begins_within_a_second_before_its_trigger() -> None:
    """Its first stamps are below zero, where no time has passed yet."""
    stamps = [-300 * MS + k * PERIOD for k in range(100)]
    _, times, verdicts = replayed(stamps)
    assert times == stamps
    assert verdicts == {"taken": 100}


def test_any_stamps_at_all() -> None:
    """Monotonic time never goes back, and every frame ends in a verdict."""
    draw = random.Random(40)
    for _ in range(300):
        stamps, t = [], BEGIN
        for _ in range(60):
            kind = draw.random()
            t += draw.randrange(20 * MS) if kind < 0.8 else draw.randrange(-9 * S, 9 * S)
            stamps.append(t + (draw.randrange(-(2**62), 2**62) if kind > 0.97 else 0))
        told = draw.choice([None, 0, 5 * S, -5 * S])
        _, times, verdicts = replayed(stamps, lambda k, told=told: told)  # type: ignore[misc]
        assert verdicts.total() == len(stamps)
        assert all(after >= before for before, after in pairwise(times))
