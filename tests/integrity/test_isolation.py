"""Isolation of series: false alarms at nominal noise, and what a fault of each shape leads to."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.estimators.base import Outcome
from fusiond.integrity.action import MOTION, Action
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.means import ASSUMED, WHITE_SLOW, Means
from tests.integrity.series_bench import GATE, LEVER, NAV, SD_M, Bench, S


@pytest.mark.parametrize("shared", [0.0, 0.3])
def test_no_false_alarm_in_six_hours_of_fixes(shared: float) -> None:
    """An epoch a second; with `shared`, a part of the variance that lasts for a minute."""
    bench = Bench()
    slow, keep = 0.0, math.exp(-1.0 / 60.0)
    for t in range(21_600):
        slow = keep * slow + math.sqrt((1.0 - keep**2) * shared) * bench.rng.standard_normal()
        bench.fix(t, slow)
        bench.velocity(t)
        assert not bench.isolation.excluded, t
    assert bench.isolation.lost(21_600 * S) is None


def test_a_jump_is_the_source_s_and_comes_back_only_with_the_filter() -> None:
    bench = Bench()
    bench.both(range(60))
    actions = bench.both(range(60, 90), north_m=500.0)
    assert bench.isolation.excluded == {"gnss": "jumped"}
    assert actions == {Action.NONE}
    lost = bench.isolation.lost(89 * S)
    assert lost is not None
    assert (lost.cause, lost.since_ns, lost.device) == ("source", 60 * S, "gnss")
    assert "gnss_velocity" not in bench.isolation.excluded
    bench.both(range(90, 140))
    assert not bench.isolation.excluded
    assert bench.isolation.lost(139 * S) is None


def test_a_kilohertz_of_false_fixes_is_not_let_in_by_its_number() -> None:
    bench = Bench()
    bench.both(range(60))
    for k in range(5000):
        bench.fix(60.0 + k * 1e-3, 300.0)
    assert "gnss" in bench.isolation.excluded


def test_a_drift_inside_the_gate_is_found_and_does_not_return_while_it_runs() -> None:
    """The filter follows, so that the innovation stays at two sigma; the velocity is honest. By
    then the series has shown that its noise is white."""
    bench = Bench()
    bench.both(range(-900, 60))
    found = None
    for t in range(60, 120):
        bench.velocity(t)
        action = bench.fix(t, min(2.0, 0.5 * (t - 60)))
        if action is Action.DOUBT_MEASURED:
            found = t
            break
    assert found is not None
    assert found - 60 <= 15
    for t in range(found, found + 60):  # left out, it runs away from a filter opened to 6 m
        bench.velocity(t)
        bench.fix(t, 0.2 * (t - found) - 6.0)
    assert bench.isolation.excluded == {"gnss": "drifts"}


def show(means: Means, square: float, seconds: range) -> None:
    """The means settle where their square is that, and are looked at once a second."""
    for _ in range(1000):
        means.add((math.sqrt(square),))
    for t in seconds:
        assert not means.biased(t * S, math.inf)


def test_what_a_series_shows_lately_does_not_excuse_it() -> None:
    """Means that grow are ordinary once nothing has come of them, not while they grow."""
    means, ordinary = Means(), WHITE_SLOW + ASSUMED
    assumed = math.sqrt(ordinary / WHITE_SLOW)
    show(means, 4.0, range(30))
    assert means.colour == assumed
    assert means.biased(30 * S, 0.0)  # they were a fault's
    show(means, ordinary, range(30, 60))
    assert means.colour == assumed
    show(means, 4.0, range(60, 90))
    assert means.colour == pytest.approx(assumed)
    show(means, 4.0, range(90, 95))
    assert means.colour > math.sqrt(1.0 / WHITE_SLOW)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_a_velocity_counts_as_coarse_as_its_errors_last(rho: float) -> None:
    """Five a second, whose errors are of first order: c^2 = (1 + rho) / (1 - rho), or one where
    they are white; one before any was heard, and at first by half of the variance for 2 s."""
    isolation, rng = Isolation(), np.random.default_rng(5)
    aid = VelocityAid("gnss_velocity", 0, GATE, (8.0, 3.0, 0.0), (0.05,) * 3, LEVER)
    assert isolation.coarseness(aid) == 1.0
    y = rng.standard_normal(3)
    seldom, often = 0.0, 0.0
    for k in range(6000):
        y = rho * y + math.sqrt(1.0 - rho**2) * rng.standard_normal(3)
        said = replace(aid, t_ns=k * S // 5, v_ned=(8.0, 3.0 + 0.01 * (k % 7), 0.0))
        seen = y / isolation.coarseness(said)
        if rho == 0.0 and 1 <= k < 1200:  # eight weigh 9.5 beyond white: a twentieth of 1,500
            assert isolation.assumes(said)
        isolation.judge(said, Outcome("fused", float(seen @ seen), 3, tuple(seen.tolist())), NAV)
        if k == 14:
            seldom, often = (
                isolation.coarseness(replace(said, t_ns=said.t_ns + gap))
                for gap in (2 * S, S // 10)
            )
    last = math.exp(-1.0), math.exp(-0.05)
    assert [seldom, often] == [
        pytest.approx(math.sqrt(1.0 + 8.0 / 23.0 * r / (1.0 - r))) for r in last
    ]
    shown = math.sqrt((1.0 + rho) / (1.0 - rho))
    now = replace(aid, t_ns=6000 * S // 5)
    assert isolation.coarseness(now) == pytest.approx(shown, rel=0.25)
    assert not isolation.assumes(now)
    fix = PositionAid("gnss", 0, GATE, 0.53, 1.99, 40.0, (SD_M,) * 3, LEVER)
    assert isolation.coarseness(fix) == 1.0
    assert not isolation.assumes(fix)


def test_a_frozen_fix_while_moving_is_told_by_its_bits() -> None:
    bench = Bench()
    bench.both(range(30))
    aid = PositionAid("gnss", 30 * S, GATE, 0.53, 1.99, 40.0, (SD_M,) * 3, LEVER)
    for k in range(4):
        again = PositionAid(
            aid.source, (30 + k) * S, GATE, aid.lat_rad, aid.lon_rad, 40.0, aid.sd, LEVER
        )
        bench.isolation.judge(again, Outcome("fused", 1.0, 3, (1.0, 0.0, 0.0)), NAV)
    assert bench.isolation.excluded == {"gnss": "repeats itself"}
    standing = Bench()
    still = NAV.copy()
    still[3:6] = 0.0
    for k in range(40):
        fix = PositionAid("gnss", k * S, GATE, 0.53, 1.99, 40.0, (SD_M,) * 3, LEVER)
        standing.isolation.judge(fix, Outcome("fused", 1.0, 3, (0.1, 0.0, 0.0)), still)
    assert not standing.isolation.excluded


def test_a_receiver_that_hangs_repeats_its_velocity_too() -> None:
    """The velocity is left out as soon as the position is, not when its bits tell by themselves;
    and comes back with bits that change."""
    bench = Bench()
    bench.both(range(30))

    def hangs(t: int, step: int) -> None:
        lat = 0.53 + 1e-7 * step
        fix = PositionAid("gnss", t * S, GATE, lat, 1.99, 40.0, (SD_M,) * 3, LEVER)
        v = 8.0, 3.0 + 1e-3 * step, 0.0
        moves = VelocityAid("gnss_velocity", t * S, GATE, v, (0.05,) * 3, LEVER)
        for aid in (moves, fix):
            bench.isolation.judge(aid, Outcome("fused", 0.0, 3, (0.0, 0.0, 0.0)), NAV)

    for t in range(30, 34):
        hangs(t, 0)
    assert bench.isolation.excluded == dict.fromkeys(("gnss", "gnss_velocity"), "repeats itself")
    for t in range(34, 39):
        hangs(t, t)
    assert "gnss_velocity" not in bench.isolation.excluded


def test_what_is_configured_to_share_nothing_is_told_as_soon_as_that_allows() -> None:
    """A bias of nine tenths of a sigma: beyond the slow mean of white errors, and what others may
    share."""
    after = []
    for white in (True, False):
        bench = Bench(white)
        bench.both(range(3600))
        assert not bench.isolation.excluded
        bench = Bench(white)
        bench.both(range(60))
        told = (t for t in range(60, 180) if bench.both(range(t, t + 1), 0.9) != {Action.NONE})
        after.append(next(told, None))
    soon, never = after
    assert soon is not None
    assert soon < 140
    assert never is None


@pytest.mark.parametrize("sd_m", [0.1, 1.5])
def test_what_is_left_out_is_judged_by_what_the_filter_may_be_off(sd_m: float) -> None:
    """The receiver is right again and the filter 2.5 m off: one that says so takes it back, even if
    it does not follow then."""
    bench = Bench(white=True)
    bench.both(range(60))
    bench.both(range(60, 90), north_m=500.0)
    assert bench.isolation.excluded == {"gnss": "jumped"}
    bench.covariance = np.diag([0.0] * 6 + [sd_m**2] * 3)
    believed = False
    for t in range(90, 150):
        bench.both(range(t, t + 1), north_m=2.5)
        believed |= "gnss" not in bench.isolation.excluded
    assert believed is (sd_m > 1.0)


def test_position_and_velocity_that_go_together_put_the_filter_in_doubt() -> None:
    """What a wrong IMU looks like: first the velocity leaves, then the position, faster each
    second."""
    bench = Bench()
    bench.both(range(60))
    doubted = False
    for k in range(20):
        doubted |= bench.velocity(60 + k, bias=3.0 * k) in MOTION
        bench.fix(60 + k, 0.4 * k**2)
    assert doubted
    lost = bench.isolation.lost(79 * S)
    assert lost is not None
    assert lost.cause == "filter"


def test_a_coarse_source_never_locks_a_fine_one_out() -> None:
    """RDSS of 20 m beside a receiver of 1 m whose innovations go to three sigma: no verdict on the
    receiver can come of the terminal, so the filter is doubted, not the receiver."""
    bench = Bench()
    for t in range(60):
        bench.fix(t)
        if t % 5 == 0:
            bench.fix(t + 0.5, 0.0, "rdss", 20.0)
    actions = set()
    for t in range(60, 80):
        actions.add(bench.fix(t, 3.0))
        if t % 5 == 0:
            bench.fix(t + 0.5, 0.0, "rdss", 20.0)
    assert Action.DOUBT_FILTER in actions
    assert not bench.isolation.excluded


def test_memory_is_taken_back_bit_for_bit() -> None:
    bench = Bench()
    bench.both(range(60))
    bench.both(range(60, 70), north_m=500.0)
    kept, state = bench.isolation.snapshot(), bench.rng.bit_generator.state
    bench.both(range(70, 120))
    after = bench.isolation.snapshot()
    bench.isolation.restore(kept)
    bench.rng.bit_generator.state = state
    bench.both(range(70, 120))
    assert bench.isolation.snapshot() == after
