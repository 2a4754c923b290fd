"""What a receiver that is believed again may be off by: open until another device has told."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from fusiond.integrity.action import Action
from fusiond.integrity.hedge import MOVED
from fusiond.integrity.kept import runs
from fusiond.integrity.moved import VOUCHED_NS, Moved, Parted, left
from fusiond.integrity.returns import Begun, Coming, prove
from fusiond.integrity.series import Series
from fusiond.studies.faults import aid_faults as aid
from fusiond.studies.faults.hours import around_town
from fusiond.studies.faults.library import Fault
from fusiond.studies.faults.recording import Alter, Drive, Recording
from fusiond.studies.faults.runs import run
from tests.integrity.journey import Journey
from tests.integrity.series_bench import Bench, S

OUT_NS = 20 * S
SQUARES = (16.0, 9.0, 1.0)


def test_what_has_lasted_for_so_long_goes_on_as_long_in_one_case_of_two() -> None:
    moved = Moved("gnss", 100 * S, OUT_NS, SQUARES)
    assert moved.leaves_open(100 * S).tolist() == [*SQUARES, *(0.0,) * 6]
    assert moved.leaves_open(120 * S).tolist() == [8.0, 4.5, 0.5, *(0.0,) * 6]
    assert moved.leaves_open(280 * S)[0] == pytest.approx(1.6)
    assert moved.leaves_open(90 * S)[0] == 16.0  # a rewind to before its return


def test_the_share_is_that_of_durations_nobody_knows_the_scale_of() -> None:
    """Faults of all durations, looked at when they have lasted for 20 s at least."""
    lasts = 20.0 / np.random.default_rng(5).random(100_000)  # p(T) ~ 1 / T^2 given T > 20
    moved = Moved("gnss", 0, OUT_NS, (1.0, 1.0, 1.0))
    for t_s in (10, 60, 300):
        share = float(moved.leaves_open(t_s * S)[0])
        assert share == pytest.approx(np.mean(lasts > 20.0 + t_s), abs=0.005)


@pytest.mark.parametrize(
    ("device", "sd_m", "away_m", "fused_ns", "tells"),
    [
        ("second", 1.0, 1.0, 101 * S, True),
        ("gnss", 1.0, 1.0, 101 * S, False),  # its own position
        ("second", 1.1, 1.0, 101 * S, False),  # too coarse for 5 m
        ("second", 1.0, 3.0, 101 * S, False),  # nearer to the other place
        ("second", 1.0, 1.0, 99 * S, False),  # before
    ],
)
def test_another_device_tells_if_it_can(
    device: str, sd_m: float, away_m: float, fused_ns: int, tells: bool
) -> None:
    other = Series(device, locates=True, moves=False, heard_ns=fused_ns)
    other.fused_ns, other.sd_m, other.away_m = fused_ns, sd_m, away_m
    moved = Moved("gnss", 100 * S, OUT_NS, SQUARES)
    assert moved.told([other]) is tells


RUNS = Moved("gnss", 10 * S, 10 * S, (0.0, 0.0, 0.0), (0.25, 0.0))
"""A velocity that had parted by 0.5 m/s to the north, believed again after ten seconds."""


def test_a_velocity_that_was_followed_may_run_away_with_the_position() -> None:
    assert RUNS.leaves_open(10 * S, 20.0).tolist() == pytest.approx(
        [25.0, 0.0, 0.0, 0.25, *(0.0,) * 4, 0.25 / 400.0]
    )
    assert RUNS.leaves_open(30 * S)[[0, 3]].tolist() == pytest.approx([75.0, 0.25 / 3.0])
    # Slow, a heading is told by no less than five times the velocity that may be wrong.
    assert RUNS.leaves_open(10 * S, 0.1)[8] == pytest.approx(1.0 / 25.0)
    assert RUNS.leaves_open(199 * S)[0] == pytest.approx(0.25 * 199.0**2 * 10.0 / 199.0)
    assert not RUNS.leaves_open(201 * S).any()  # one case in twenty and less


def test_as_far_as_drifts_of_all_durations_have_gone() -> None:
    """Drifts that had lasted for ten seconds at least, looked at when that was known: those that go
    on are off by all of the way, the others are seen to come back."""
    lasts = 10.0 / np.random.default_rng(6).random(100_000)
    for t_s in (10.0, 60.0, 120.0):
        off = np.where(lasts > 10.0 + t_s, 0.5 * (10.0 + t_s), 0.0)
        opened = RUNS.leaves_open(round((10.0 + t_s) * S))[0]
        assert opened == pytest.approx(np.mean(off**2), rel=0.05)


@pytest.mark.parametrize(
    ("device", "sd_m_s", "tells"),
    [("second", 0.1, True), ("gnss", 0.1, False), ("second", 0.2, False), ("wheel", 0.0, False)],
)
def test_another_devices_velocity_tells(device: str, sd_m_s: float, tells: bool) -> None:
    """One as fine; a wheel's speed has none across, and no sigma of a velocity."""
    other = Series(device, locates=False, moves=True, heard_ns=20 * S)
    other.fused_ns, other.sd_m_s = 20 * S, sd_m_s
    assert RUNS.told([other]) is tells


def test_one_that_may_be_carried_off_as_well_does_not_tell() -> None:
    other = Series("second", locates=False, moves=True, heard_ns=20 * S)
    other.fused_ns, other.sd_m_s = 20 * S, 0.1
    position = Series("second", locates=True, moves=False, heard_ns=20 * S)
    assert RUNS.told([other, position])
    position.moved = RUNS._replace(device="second")
    assert not RUNS.told([other, position])
    position.moved, other.parted = None, Parted(10 * S, 0.5, 0.0)
    assert not RUNS.told([other, position])


def test_a_fine_position_tells_once_it_would_be_far_away() -> None:
    other = Series("second", locates=True, moves=False, heard_ns=0)
    other.sd_m, other.away_m = 2.0, 1.0
    told = []
    for t_s in (18, 22):  # it would be 9 and 11 m away
        other.fused_ns = t_s * S
        told.append(RUNS.told([other]))
    assert told == [False, True]


def test_what_ran_away_before_is_kept_where_it_had_got_to() -> None:
    again = Parted(25 * S, 0.0, 0.4).followed("gnss", 30 * S).joined(RUNS)
    assert again.since_ns == 25 * S + VOUCHED_NS
    assert again.squares == pytest.approx((0.25 * 35.0 * 10.0, 0.0, 0.0))
    assert again.speeds == pytest.approx((0.25 / 3.5, 0.16))


def test_what_was_open_before_is_open_after_another_failure() -> None:
    first = left("gnss", 100 * S, OUT_NS, 10.0)
    assert first.squares == (50.0, 50.0, 50.0)
    again = left("gnss", 120 * S, OUT_NS, 10.0).joined(first)
    assert again.squares == (75.0, 75.0, 75.0)


def test_a_return_takes_nothing_back_that_was_open() -> None:
    """A short outage later, whose first fix is off by a little: it fades no sooner for that."""
    first = Moved("gnss", 100 * S, OUT_NS, SQUARES)
    again = Moved("gnss", 120 * S, OUT_NS // 2, (1.0, 0.0, 0.0)).joined(first)
    assert again.leaves_open(120 * S)[:3].tolist() == [9.0, 4.5, 0.5]
    assert again.leaves_open(140 * S)[0] == 4.5
    assert first.joined(None) is first


def test_nor_does_a_first_fix_after_an_outage() -> None:
    offer, nav = Journey(1).at(600)
    record = Series("gnss", locates=True, moves=False, heard_ns=offer.t_ns)
    record.fused_ns, record.every_ns, record.sd_m = offer.t_ns - OUT_NS, OUT_NS, 0.8
    record.moved = Moved("gnss", record.fused_ns, OUT_NS, SQUARES)
    comes = Coming(beyond=(1.0, 0.0, 0.0), tilt=1e-6)
    prove({"gnss": record}, record, offer, nav, None, Begun(), comes, 1.0 - 1e-6)
    opened = record.moved.leaves_open(offer.t_ns).tolist()
    assert opened == [9.0, 4.5, 0.5, 0.0, 0.0, 0.0, 1e-6, 1e-6, 0.0]
    again = Moved("gnss", offer.t_ns, OUT_NS, (1.0, 0.0, 0.0), tilt=2e-6).joined(record.moved)
    assert again.leaves_open(offer.t_ns)[6:8].tolist() == pytest.approx([3e-6] * 2)


def returned(off_m: float) -> tuple[Bench, int]:
    """A receiver that stepped away, and is believed again `off_m` from a filter whose own error may
    be 4 m by then; and for how many seconds it was left out. A second later it is fused."""
    bench = Bench()
    bench.covariance = np.diag([16.0 if 6 <= k < 9 else 1e-4 for k in range(9)])
    bench.both(range(60))
    bench.both(range(60, 80), north_m=30.0)
    assert bench.isolation.excluded == {"gnss": "jumped"}
    t = 80
    while bench.isolation.excluded:
        bench.both(range(t, t + 1), north_m=off_m)
        t += 1
    bench.both(range(t, t + 1))
    return bench, t - 1 - 60


def test_a_receiver_that_is_believed_again_leaves_open_what_it_may_be_off_by() -> None:
    for off_m in (0.0, 1.5):
        bench, out_s = returned(off_m)
        wider = (out_s + 1) / out_s * bench.isolation.hedge.wider["gnss" + MOVED]
        # Of some fifteen fixes of 1 m the mean.
        assert math.sqrt(wider[0] - 16.0) == pytest.approx(off_m, abs=0.75)
        assert wider[1:3] == pytest.approx(16.0, abs=0.6)
        assert not wider[3:].any()


def test_a_filter_that_starts_anew_knows_no_more_of_it() -> None:
    bench, out_s = returned(1.5)
    moved = bench.isolation.moved
    assert moved is not None
    assert (moved.device, moved.lasted_ns) == ("gnss", out_s * S)
    bench.isolation.reset(moved=moved)
    assert bench.isolation.moved == moved
    t = 60 + out_s + 2
    bench.both(range(t, t + 1))
    assert "gnss" + MOVED in bench.isolation.hedge.wider
    bench.fix(t + 1, source="second", sd_m=0.5)
    bench.both(range(t + 2, t + 3))
    assert bench.isolation.moved is None


def test_what_goes_on_after_the_process_knows_of_one_that_is_left_out() -> None:
    bench = Bench()
    bench.both(range(60))
    assert bench.isolation.handed_on(60 * S) is None
    for t in range(60, 70):
        bench.fix(t, north_m=40.0)
        bench.fix(t, source="second")
    handed = bench.isolation.handed_on(70 * S)
    assert handed is not None
    assert handed.device == "gnss"
    assert handed.lasted_ns == 10 * S
    assert handed.squares[0] == pytest.approx(0.5 * 40.0**2, rel=0.3)
    # It is what the next one begins with.
    bench.isolation.reset(moved=handed)
    assert bench.isolation.handed_on(75 * S) == handed


def test_it_is_over_once_another_device_has_told() -> None:
    bench, out_s = returned(0.0)
    t = 60 + out_s + 2
    bench.fix(t, source="second", sd_m=1.0)
    bench.both(range(t + 1, t + 2))
    assert "gnss" + MOVED not in bench.isolation.hedge.wider


def test_it_is_taken_back_by_a_rewind() -> None:
    bench, out_s = returned(0.0)
    t = 60 + out_s + 2
    memory = bench.isolation.snapshot()
    bench.fix(t, source="second", sd_m=1.0)
    bench.both(range(t + 1, t + 2))
    bench.isolation.restore(memory)
    bench.both(range(t, t + 1))
    assert "gnss" + MOVED in bench.isolation.hedge.wider


def test_without_a_fault_nothing_is_open() -> None:
    bench = Bench()
    bench.covariance = np.diag([16.0] * 9)
    bench.both(range(600))
    assert not any(name.endswith(MOVED) for name in bench.isolation.hedge.wider)


def parted(north_m_s: float, seconds: range) -> Bench:
    """A velocity that parts, is left out, and passes again while it is still off."""
    bench = Bench()
    bench.covariance = np.diag([1e-4] * 9)
    bench.both(range(seconds.start))
    for t in seconds:
        bench.fix(t)
        bench.velocity(t, bias=12.0 if t < seconds.start + 3 else 0.0, east_m_s=3.0 + north_m_s)
    return bench


def test_a_velocity_that_parted_leaves_its_device_open_once_it_is_believed_again() -> None:
    bench = parted(0.5, range(60, 63))
    assert bench.isolation.excluded == {"gnss_velocity": "disagrees"}
    assert "gnss" + MOVED not in bench.isolation.hedge.wider
    bench = parted(0.5, range(60, 75))
    assert not bench.isolation.excluded
    wider = bench.isolation.hedge.wider["gnss" + MOVED]
    assert wider[:6] == pytest.approx([0.0, 0.25 * 14.0**2 / 1.4, 0.0, 0.0, 0.25 / 1.4, 0.0])
    assert wider[8] == pytest.approx(0.25 / 1.4 / (8.0**2 + 3.0**2))


def test_it_is_taken_back_by_a_rewind_to_before_its_return() -> None:
    bench = parted(0.5, range(60, 64))
    memory = bench.isolation.snapshot()
    for t in range(64, 75):
        bench.both(range(t, t + 1))
    assert "gnss" + MOVED in bench.isolation.hedge.wider
    bench.isolation.restore(memory)
    bench.fix(64)
    assert "gnss" + MOVED not in bench.isolation.hedge.wider


def test_a_position_that_no_velocity_goes_with_leaves_open_how_fast_it_may_go() -> None:
    """A mean of 2.5 m within eleven fixes is a quarter of a metre a second, or twice that; a mean
    that is no chance is enough, before anything is doubted."""
    bench = Bench()
    bench.covariance = np.diag([1e-4] * 9)
    for t in range(60):
        bench.fix(t)
    t, acted = 60, Action.NONE
    while bench.isolation.moved is None:
        acted = bench.fix(t, north_m=2.5)
        t += 1
    assert acted is Action.NONE
    while bench.fix(t, north_m=2.5) is not Action.DOUBT_FILTER:
        t += 1
    assert not bench.isolation.excluded
    north, east = bench.isolation.moved.speeds
    assert 0.15**2 < north < 1.0
    assert east < 0.25 * north


def staying(alter: Alter, duration_s: float) -> dict[str, Any]:
    """The figures of a fault of the receiver that stays, in town."""
    drive = Drive(around_town, duration_s=duration_s)
    return run(Fault(alter, duration_s, drive=drive), "navigating", seed=0)


@pytest.mark.parametrize(("step_m", "duration_s"), [(2.0, 140.0), (10.0, 240.0)])
def test_a_step_that_stays_is_never_vouched_for(step_m: float, duration_s: float) -> None:
    """Of one receiver nobody can tell: it is back once the filter's own bound has grown over two
    metres, and after ten a new start is made of it."""
    found = staying(partial(aid.step, north_m=step_m), duration_s)
    assert found["verdict"] == "degraded and said so", found
    assert found["largest_horizontal_m"] > 0.8 * step_m  # it is believed again, and is off


def off_after_an_outage(r: Recording, begin_s: float, length_s: float) -> Recording:
    """No fixes for 15 s, and from then on they are too far to the north."""
    return aid.step(aid.absent(r, begin_s, 15.0), begin_s + 15.0, length_s, north_m=5.0)


def test_nor_is_one_that_begins_in_an_outage() -> None:
    """It is within the outage's bound, of which chance makes such a part one time in twenty."""
    found = staying(off_after_an_outage, 180.0)
    assert found["verdict"] == "degraded and said so", found
    assert found["largest_horizontal_m"] > 4.0


def test_nor_is_one_of_the_height() -> None:
    found = staying(partial(aid.too_high, up_m=5.0), 140.0)
    assert found["verdict"] == "degraded and said so", found
    assert "readmitted" in {event["code"] for event in found["events"]}


@pytest.mark.parametrize(
    "alter",
    [
        aid.carried_off,
        partial(aid.carried_off, north_m_s=2.0),
        partial(aid.velocity_bias, north_m_s=0.5),
    ],
)
def test_nor_is_one_that_carries_the_filter_off(alter: Alter) -> None:
    """Position and velocity that drift away together, as of a receiver that is spoofed, and a
    velocity alone: the velocity is left out, and follows once the motion was doubted."""
    found = staying(alter, 130.0)
    assert found["verdict"] == "degraded and said so", found
    assert "readmitted" in {event["code"] for event in found["events"]}


def test_positions_alone_may_go_on_as_fast_as_they_left() -> None:
    before = left("gnss", 100 * S, 5 * S, 10.0)
    alone = left("gnss", 100 * S, 5 * S, 10.0, alone=True)
    assert not any(before.leaves_open(100 * S)[3:5])
    runs = alone.leaves_open(100 * S)[3:5]
    assert np.sum(runs) == pytest.approx((10.0 / 5.0) ** 2)


def test_a_coarse_position_does_not_tell_of_a_drift() -> None:
    step = left("gnss", 100 * S, 20 * S, 300.0)
    drift = left("gnss", 100 * S, 20 * S, 300.0, alone=True)
    coarse = Series("rdss", True, False, 110 * S)
    coarse.fused_ns, coarse.sd_m, coarse.away_m = 110 * S, 20.0, 10.0
    assert step.told([coarse])
    assert not drift.told([coarse])
    coarse.sd_m = 2.0
    assert drift.told([coarse])


@pytest.mark.parametrize(("away_m", "lags"), [(0.5, 1.0), (2.5, 1.0), (7.5, 3.0)])
def test_how_fast_a_position_goes_is_what_the_mean_shows_or_the_last_fix(
    away_m: float, lags: float
) -> None:
    """Twice 2.5 m within eleven seconds, and more where the mean lags behind."""
    record = Series("gnss", True, False, 100 * S)
    record.every_ns, record.away_m = S, away_m
    parted = runs(record, 100 * S, (1.5, -2.0, 9.0))
    expected = (2.0 * lags * 1.5 / 11.0, -2.0 * lags * 2.0 / 11.0)
    assert (parted.north, parted.east) == pytest.approx(expected)
