"""What is published is no surer than what the means of a series leave open."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.body_velocity import NonHolonomicAid, WheelSpeedAid
from fusiond.aiding.position import PositionAid
from fusiond.aiding.velocity import VelocityAid
from fusiond.estimators.base import Outcome
from fusiond.integrity.action import Action
from fusiond.integrity.hedge import LATELY, NOTHING
from fusiond.integrity.isolation import Isolation
from fusiond.integrity.means import LIKELY, WHITE_FAST, WHITE_SLOW, Means
from fusiond.integrity.proof import DRIFT_SD_M_S, SLOWEST_M_S, Offset, Trend
from fusiond.integrity.support import HALVED
from tests.integrity.series_bench import GATE, LEVER, NAV, SD_M, Bench, S
from tests.navigator.vehicle import drive, feed, started

OWN_M, OWN_M_S = 0.2, 0.03
"""One sigma of the filter's position and velocity."""


def bench(white: bool = True) -> Bench:
    made = Bench(white)
    made.covariance = np.diag([1e-6] * 3 + [OWN_M_S**2] * 3 + [OWN_M**2] * 3)
    return made


def test_of_a_sound_receiver_it_is_seldom_wider_and_little() -> None:
    """Chance: a component of a mean is beyond the bound one time in twenty at each pace, and once
    in ten thousand beyond what stays open."""
    made = bench()
    wider, grown, sigma = 0, np.zeros(9), np.zeros(3)
    epochs = 20_000
    for t in range(epochs):
        made.both(range(t, t + 1))
        found = made.isolation.hedge.wider
        wider += bool(found)
        opened = sum(found.values(), np.zeros(9))
        grown += opened - found.get(f"gnss{LATELY}", np.zeros(9))
        sigma += np.sqrt(1.0 + opened[:3] / OWN_M**2) / epochs
    assert not made.isolation.excluded
    assert wider < 0.45 * epochs  # six components, two paces
    means = np.sqrt(1.0 + grown[:3] / epochs / OWN_M**2)
    print(f"sigma of a position is wider by {sigma} on average; by its means alone {means}")
    assert means.max() < 1.15
    assert sigma.max() < 1.12


@pytest.mark.parametrize("own", [0.0, 0.7])
def test_a_drift_that_is_not_told_yet_is_published(own: float) -> None:
    """The innovation stays at a sigma, so that the filter follows by as much or is off by it. With
    it goes what P says goes with it: `own` is a velocity's correlation."""
    made = bench()
    made.both(range(-900, 60))
    p = made.covariance
    assert p is not None
    p[6, 3] = p[3, 6] = own * OWN_M * OWN_M_S
    before, told = [], None
    for t in range(60, 200):
        made.velocity(t)
        if made.fix(t, 1.1) is not Action.NONE:
            told = t
            break
        before.append(made.isolation.hedge.wider.get("gnss", np.zeros(9)))
    assert told is not None
    assert made.isolation.excluded == {"gnss": "drifts"}
    last = before[-1]
    assert 0.3 < math.sqrt(last[0]) < 2.0
    assert last[3] == pytest.approx(last[0] * (own * OWN_M_S / OWN_M) ** 2)
    # Once it is left out P is opened instead, by what the mean had shown: not by chance.
    assert "gnss" not in made.isolation.hedge.wider
    assert 0.5 < made.isolation.shown[0] < 2.0


def test_a_coarse_position_leaves_nothing_open_and_a_checkpoint_keeps_it() -> None:
    made = bench(white=False)
    for t in range(200):
        made.velocity(t)
        made.fix(t)
        made.fix(t + 0.5, 12.0, source="rdss", sd_m=20.0)
    assert "rdss" not in made.isolation.hedge.wider
    made = bench()
    assert made.isolation.hedge.wider is NOTHING
    made.both(range(60))
    t = 60
    while "gnss" not in made.isolation.hedge.wider:
        made.fix(t, 1.0)
        t += 1
    kept, wider = made.isolation.snapshot(), made.isolation.hedge.wider
    made.both(range(t, t + 60))
    made.isolation.restore(kept)
    assert made.isolation.hedge.wider is wider
    for k in range(120):  # it has become coarse, and nothing of it is beyond chance any more
        made.fix(t + k, sd_m=20.0)
    assert "gnss" not in made.isolation.hedge.wider
    made.isolation.reset()
    assert made.isolation.hedge.wider is NOTHING


def _left_open() -> tuple[Bench, int]:
    """A receiver that has left something open, and the next second."""
    made = bench()
    made.both(range(60))
    t = 60
    while "gnss" not in made.isolation.hedge.wider:
        made.fix(t, 1.0)
        t += 1
    return made, t


def test_what_a_silent_source_left_open_is_another_s_to_tell() -> None:
    """Silence answers nothing, nor does a coarse fix; one as fine does, with a mean of its own."""
    made, t = _left_open()
    wider = made.isolation.hedge.wider["gnss"]
    for k in range(t, t + 30):
        made.velocity(k)
        made.fix(k, source="rdss", sd_m=20.0)
        assert made.isolation.hedge.wider["gnss"] is wider
    for k in range(t + 30, t + 33):
        made.fix(k, source="second", sd_m=2.0)
        assert made.isolation.hedge.wider["gnss"] is wider
    made.fix(t + 33, source="second", sd_m=2.0)
    assert "gnss" not in made.isolation.hedge.wider
    other, t = _left_open()
    for k in range(t, t + 4):  # not silent: two that disagree
        other.fix(k, 1.0)
        other.fix(k + 0.5, source="second", sd_m=2.0)
    assert "gnss" in other.isolation.hedge.wider


def test_a_velocity_answers_for_a_silent_velocity() -> None:
    """For its tilt as well."""
    made = bench()
    for k in range(200):
        made.velocity(0.5 * k)
    t = 100.0
    while "gnss_velocity tilt" not in made.isolation.hedge.wider:
        made.velocity(t, 1.5)
        t += 0.5
    for k in range(20):
        made.fix(t + 6 + k)
    assert "gnss_velocity tilt" in made.isolation.hedge.wider
    for k in range(4):
        aid = VelocityAid(
            "second_velocity", round((t + 30 + k) * S), GATE, (8.0, 3.0, 0.0), (0.05,) * 3, LEVER
        )
        made.isolation.judge(aid, Outcome("fused", 0.0, 3, (0.0, 0.0, 0.0)), NAV, made.covariance)
    assert "gnss_velocity tilt" not in made.isolation.hedge.wider


def test_one_that_is_back_leaves_open_what_it_shows_then() -> None:
    """Its means begin anew, and so does what is unlikely."""
    made, t = _left_open()
    made.fix(t + 6)
    assert "gnss" not in made.isolation.hedge.wider


def test_a_mounting_that_is_not_the_configured_one_is_open_by_what_chance_has_not() -> None:
    made, sd = bench(), math.radians(5.0)
    made.isolation.hedge.sits((math.radians(3.0), math.radians(-16.0)), sd)
    assert made.isolation.hedge.wider is NOTHING
    made.isolation.hedge.sits((math.radians(3.0), math.radians(-19.0)), sd)
    (wider,) = made.isolation.hedge.wider.values()
    assert not wider[:8].any()
    assert math.degrees(math.sqrt(wider[8])) == pytest.approx(math.sqrt(19.0**2 - 10.83 * 25.0))
    made.isolation.hedge.sits((math.radians(3.0), math.radians(-15.0)), sd)
    assert made.isolation.hedge.wider is NOTHING


def test_excess_is_what_a_mean_has_beyond_chance() -> None:
    means = Means.begun(white=True)
    for _ in range(500):
        means.add((1.0, 0.0))
    assert not means.biased(S, math.inf)
    assert means.unlikely
    p = np.diag([0.0] * 6 + [0.04] * 3)
    p[3, 3], p[2, 2], p[3, 6], p[2, 6], p[1, 6] = 1.0, 1.0, 0.02, 0.01, 0.03
    excess = (1.0 - LIKELY * WHITE_SLOW) * (0.04 + 2.25)
    regression = [1.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.75, 0.75, 0.25]
    found = means.leaves_open(p, 6, (1.5, 1.5, 1.5))
    assert found == pytest.approx(excess * np.square(regression), abs=1e-6)
    assert means.most() == pytest.approx([1.0, 0.0], abs=1e-6)
    small = 0.5 * math.sqrt(LIKELY * min(WHITE_FAST, WHITE_SLOW))
    for _ in range(500):
        means.add((small, 0.0))
    assert not means.biased(2 * S, math.inf)
    assert not means.unlikely


def test_what_is_published_is_wider_and_the_state_is_not() -> None:
    """Whatever comes late: it is what the isolation has, at each instant."""
    navigator, row = started()
    estimator = navigator.estimator
    p, before = estimator.covariance.copy(), estimator.sigmas()
    estimator.wider[:3] = 1.0, 0.0, 4.0
    after = estimator.sigmas()
    assert after[[0, 2]] == pytest.approx(np.hypot(before[[0, 2]], [1.0, 2.0]))
    assert np.delete(after, [0, 2]) == pytest.approx(np.delete(before, [0, 2]))
    assert np.array_equal(estimator.covariance, p)
    estimator.wider[:] = 0.0
    delays = [1.5 if i % 3 == 0 else 0.0 for i in range(len(drive().measurements))]
    feed(navigator, row, [7], delays)
    wider = navigator.timeline.isolation.hedge.wider
    assert np.array_equal(estimator.wider, sum(wider.values(), np.zeros(9)))


def test_a_doubt_opens_by_what_a_series_is_apart() -> None:
    """Its last innovation may be next to nothing."""
    estimator = started()[0].estimator
    lat, lon, height = estimator.nav[:3].tolist()
    aid = PositionAid("gnss", 0, GATE, lat, lon, height, (SD_M,) * 3, LEVER)
    for apart, grown in (((), 0.0), ((2.0, 1.0, 0.0), 4.0)):
        before = estimator.covariance[6, 6]
        estimator.doubt(aid, measured=True, motion=False, apart=apart)
        assert estimator.covariance[6, 6] - before == pytest.approx(grown, abs=1e-6)


def test_what_may_drift_still_does_not_come_back() -> None:
    """0.054 m/s, known to 0.02, may be 0.1."""

    def line(slope: float, sd: float) -> Trend:
        trend, n = Trend(), 200
        each = sd * 40.0 * math.sqrt(n / 12.0)
        for k in range(n):
            t_s = 40.0 * k / n
            trend = trend.with_one(Offset(slope * t_s, 0.0, each), t_s)
        return trend

    assert line(0.054, 0.0195).steady(DRIFT_SD_M_S)
    assert not line(0.054, 0.0195).steady(DRIFT_SD_M_S, SLOWEST_M_S)
    assert line(0.03, 0.0195).steady(DRIFT_SD_M_S, SLOWEST_M_S)


def test_the_same_to_the_bit_is_no_new_measurement_at_rest_either() -> None:
    """All of a run count as less than three; a velocity's where the position hangs as well, for it
    is printed coarser."""
    made, still = Bench(), NAV.copy()
    still[3:6] = 0.0
    fix = PositionAid("gnss", 0, GATE, 0.53, 1.99, 40.0, (SD_M,) * 3, LEVER)
    velocity = VelocityAid("gnss_velocity", 0, GATE, (0.0, 0.0, 0.0), (0.05,) * 3, LEVER)
    information, of_velocity = 0.0, []
    for k in range(60):
        again = replace(velocity, t_ns=k * S)
        of_velocity.append(made.isolation.coarseness(again))
        made.isolation.judge(again, Outcome("fused", 0.0, 3, (0.0, 0.0, 0.0)), still)
        now = replace(fix, t_ns=k * S)
        information += made.isolation.coarseness(now) ** -2
        made.isolation.judge(now, Outcome("fused", 0.1, 3, (0.1, 0.0, 0.0)), still)
    assert 2.9 < information < 3.0
    assert of_velocity[-1] > HALVED**50
    assert "gnss" not in made.isolation.excluded
    assert made.isolation.assumes(fix)
    moved = replace(fix, t_ns=60 * S, lat_rad=0.53 + 1e-9)
    assert made.isolation.coarseness(moved) == 1.0
    rounded = Bench()
    for k in range(60):
        again = replace(velocity, t_ns=k * S)
        rounded.isolation.judge(again, Outcome("fused", 0.0, 3, (0.0, 0.0, 0.0)), still)
        rounded.fix(k)
    assert rounded.isolation.coarseness(replace(velocity, t_ns=60 * S)) < 2.0


def test_a_velocity_that_has_just_come_back_blames_no_position() -> None:
    """What was believed meanwhile may be right: it is the filter that is in doubt."""
    actions = []
    for lately in (False, True):
        made = Bench(white=True)
        made.both(range(60))
        if lately:
            for t in range(60, 70):
                made.fix(t)
                made.velocity(t, bias=60.0)
            assert "gnss_velocity" in made.isolation.excluded
            t = 70
            while "gnss_velocity" in made.isolation.excluded:
                made.both(range(t, t + 1))
                t += 1
        else:
            t = 70
        action = Action.NONE
        while action is Action.NONE:
            made.velocity(t)
            action = made.fix(t, 2.2)
            t += 1
        actions.append((action, "gnss" not in made.isolation.excluded))
    assert actions == [(Action.DOUBT_MEASURED, False), (Action.DOUBT_FILTER, True)]


def test_what_goes_across_is_a_heading_for_a_vehicle_that_does_not_slip() -> None:
    """0.2 of an innovation's sigma is chance, 0.8 is not; at 8.5 m/s, with 0.1 m/s across."""
    isolation, p = Isolation(), np.diag([1e-6] * 9)
    speed = math.hypot(NAV[3], NAV[4])

    def told(epochs: range, y: float) -> None:
        for k in epochs:
            aid = NonHolonomicAid("non_holonomic", k * S // 10, GATE, 0.1, 0.1, 1.0, LEVER)
            isolation.judge(aid, Outcome("fused", y * y, 2, (y, 0.0)), NAV, p)

    told(range(300), 0.2)
    assert isolation.hedge.wider is NOTHING
    told(range(300, 330), 0.8)
    wider = isolation.hedge.wider["non_holonomic"]
    assert not wider[:8].any()
    assert 0.3 * 0.1 / speed < math.sqrt(wider[8]) < 0.8 * math.hypot(0.1 / speed, 1e-3)
    told(range(330, 400), 0.0)
    assert isolation.hedge.wider is NOTHING


def test_a_velocity_that_is_corrected_again_and_again_leaves_a_tilt_open() -> None:
    """As much as gravity makes of it in the 0.5 s between two; it fades as P hears of the tilt."""
    made = bench()
    assert made.covariance is not None
    for k in range(200):
        made.velocity(0.5 * k)
    t, name = 100.0, "gnss_velocity tilt"
    while name not in made.isolation.hedge.wider:
        made.velocity(t, 1.5)
        t += 0.5
    wider = made.isolation.hedge.wider[name]
    assert wider[6] == wider[7] > 0.0
    assert not wider[:6].any()
    assert wider[8] == 0.0
    r = (0.05 * made.isolation._records["gnss_velocity"].means.coarse) ** 2
    step = OWN_M_S**2 / r * math.hypot(OWN_M_S, math.sqrt(r))  # of a mean of one sigma
    assert 0.5 < math.sqrt(wider[6]) / (step / (0.5 * 9.8)) < 2.0
    made.velocity(t - 0.5, 1.5)  # of the same instant: no time to be accelerated in
    assert 0.9 * wider[6] < made.isolation.hedge.wider[name][6] <= wider[6]
    for k in range(300):
        before = made.isolation.hedge.wider.get(name)
        made.velocity(t + 0.5 * k)
        after = made.isolation.hedge.wider.get(name)
        if before is not None and after is not None:
            assert after[6] >= 0.9 * before[6]
    assert name not in made.isolation.hedge.wider


def test_a_velocity_that_is_refused_opens_what_it_says_until_the_next() -> None:
    """Half a metre a second within a second: an acceleration, or 3 deg of tilt, that was none."""
    bench = Bench()
    bench.covariance = np.diag([1e-4] * 9)
    bench.both(range(60))
    assert "gnss_velocity" not in bench.isolation.hedge.wider
    bench.velocity(60, bias=12.0, east_m_s=3.5)
    opened = bench.isolation.hedge.wider["gnss_velocity"]
    tilt = (0.5 / 9.80665) ** 2
    assert opened == pytest.approx([0.0, 0.0625, 0.0, 0.0, 0.25, 0.0, tilt, tilt, 0.0])
    bench.velocity(61)
    assert "gnss_velocity" not in bench.isolation.hedge.wider


def test_one_that_has_not_been_fused_lately_says_nothing_of_when_it_parted() -> None:
    """Not the first after a start, nor after an outage of it: that may have been hours ago."""
    bench = Bench()
    bench.covariance = np.diag([1e-4] * 9)
    bench.fix(0)
    bench.velocity(0, bias=12.0, east_m_s=3.5)
    assert "gnss_velocity" not in bench.isolation.hedge.wider
    for t in range(1, 60):
        bench.both(range(t, t + 1))
    for t in range(60, 90):
        bench.fix(t)
    bench.velocity(90, bias=12.0, east_m_s=3.5)
    assert "gnss_velocity" not in bench.isolation.hedge.wider


def test_a_speed_that_is_refused_opens_no_velocity() -> None:
    bench = Bench()
    bench.covariance = np.diag([1e-4] * 9)
    for t in range(20):
        bench.both(range(t, t + 1))
        bench.wheel(t, 8.0)
    aid = WheelSpeedAid("wheel", 20 * S, GATE, 12.0, 0.1, LEVER)
    bench.isolation.judge(aid, Outcome("gated", 1600.0, 1, (40.0,)), NAV, bench.covariance)
    assert "wheel" not in bench.isolation.hedge.wider
