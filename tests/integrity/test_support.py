"""Who vouches for a filter: what is contested though something is believed."""

from __future__ import annotations

import pytest

from tests.integrity.series_bench import Bench, S


def test_nothing_is_contested_while_all_agree() -> None:
    bench = Bench()
    bench.both(range(60))
    bench.fix(59.5, source="rdss", sd_m=20.0)
    bench.no_slip(59.5, holds=True)
    assert bench.isolation.contested(60 * S) is None


def test_a_coarse_fix_does_not_vouch_for_what_a_fine_one_denies() -> None:
    bench = Bench()
    bench.both(range(60))
    for t in range(60, 70):
        bench.fix(t, 8.0)
        bench.velocity(t)
        bench.fix(t + 0.5, source="rdss", sd_m=20.0)
    assert bench.isolation.excluded.keys() == {"gnss"}
    assert bench.isolation.lost(70 * S) is None
    contested = bench.isolation.contested(70 * S)
    assert contested is not None
    assert contested.startswith("gnss is left out")


def test_another_fine_fix_does() -> None:
    bench = Bench()
    bench.both(range(60))
    for t in range(60, 70):
        bench.fix(t, 500.0)
        bench.velocity(t)
        bench.fix(t + 0.5, source="second", sd_m=2.0)
    assert bench.isolation.excluded == {"gnss": "jumped"}
    assert bench.isolation.contested(70 * S) is None


def test_a_coarse_fix_far_from_a_source_says_that_the_source_is_wrong() -> None:
    bench = Bench()
    bench.both(range(60))
    bench.fix(59.5, source="rdss", sd_m=20.0)
    bench.both(range(60, 90), north_m=500.0)  # RDSS is asked for seldom: nobody else is heard
    lost = bench.isolation.lost(90 * S)
    assert lost is not None
    assert lost.disputed
    near = Bench()
    near.both(range(60))
    near.fix(59.5, source="rdss", sd_m=20.0)
    near.both(range(60, 90), north_m=90.0)  # which 20 m cannot tell
    lost = near.isolation.lost(90 * S)
    assert lost is not None
    assert not lost.disputed


@pytest.mark.parametrize(("jumps", "contested"), [(True, False), (False, True)])
def test_a_velocity_that_jumps_is_wrong_one_that_leaves_may_be_right(
    jumps: bool, contested: bool
) -> None:
    bench = Bench()
    bench.both(range(60))
    for t in range(60, 70):
        bench.fix(t)
        # The filter has (8, 3): 43 m/s away within a second, or some sigma of 5 cm/s.
        bench.velocity(t, bias=800.0 if jumps else 12.0, east_m_s=-40.0 if jumps else 3.6)
    reason = "jumped" if jumps else "disagrees"
    assert bench.isolation.excluded == {"gnss_velocity": reason}
    assert (bench.isolation.contested(70 * S) is not None) == contested


def test_a_vehicle_that_slides_for_a_second_faces_another_way() -> None:
    bench = Bench()
    bench.both(range(60))
    for k in range(9):
        bench.no_slip(60.0 + 0.1 * k, holds=False)
    assert not bench.isolation.excluded
    for k in range(9, 20):
        bench.no_slip(60.0 + 0.1 * k, holds=False)
    assert bench.isolation.excluded == {"non_holonomic": "disagrees"}
    # At a stop it says nothing more, and is not forgotten.
    assert bench.isolation.contested(200 * S) is not None
    for k in range(40):
        bench.no_slip(200.0 + 0.1 * k, holds=True)
    assert bench.isolation.contested(204 * S) is None


@pytest.mark.parametrize(("north_m_s", "proven"), [(0.0, True), (0.5, False)])
def test_a_fix_that_comes_back_is_compared_with_the_motion(north_m_s: float, proven: bool) -> None:
    """The filter follows it, for it has nothing better; its velocity is honest."""
    bench = Bench()
    bench.both(range(60))
    for k in range(150):  # the vehicle goes north by 8 m/s, and east by 3 m/s
        bench.moved_fix(100.0 + 0.2 * k, (8.0 + north_m_s, 3.0))
        if k == 0:
            contested = bench.isolation.contested(100 * S)
            assert contested is not None
            assert "is back" in contested
    assert (bench.isolation.contested(130 * S) is None) == proven


def test_a_wheel_that_hangs_is_told_by_what_it_has_shown() -> None:
    lively, coarse = Bench(), Bench()
    for k in range(600):
        lively.wheel(0.1 * k, 8.0 + 0.01 * (k % 7))
        coarse.wheel(0.1 * k, 8.0 + 0.5 * (k // 20 % 2))  # twenty alike are its way
    for k in range(15):
        lively.wheel(60.0 + 0.1 * k, 8.0)
        coarse.wheel(60.0 + 0.1 * k, 8.0)
    assert lively.isolation.excluded == {"wheel": "repeats itself"}
    assert not coarse.isolation.excluded


def test_sensors_that_have_changed_may_change_again_for_as_long() -> None:
    """By the tenth of a doubt each second at first, then as the time since; an outage adds no more
    than the two seconds in which a velocity still supports the filter."""
    bench = Bench()
    bench.both(range(60))
    assert bench.isolation.unsettled(60 * S) == 0.0
    for t in range(60, 63):
        bench.velocity(t, bias=12.0, east_m_s=3.6)
    assert bench.isolation.doubts == (62 * S,)
    assert bench.isolation.unsettled(63 * S) == pytest.approx(0.1)
    bench.fix(63.0)
    assert bench.isolation.unsettled(63 * S) == 0.0
    assert bench.isolation.unsettled(82 * S) == pytest.approx(2.0 / 20.0)
    bench.fix(102.0)
    assert bench.isolation.unsettled(103 * S) == pytest.approx(1.0 / 41.0)
    assert bench.isolation.unsettled(163 * S) == 0.0
