"""Receivers that are wrong together: the filter, which wheels agree with, says so."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.integrity.action import Action
from fusiond.integrity.series import DENIED
from fusiond.navigation.strapdown import Q0, VE, VN
from tests.integrity.series_bench import NAV, TOLD, Bench, S

OFF = 12.0
"""Of a velocity that its gate refuses, in sigmas."""


def bench_of(seconds: int, *, wheels: bool) -> Bench:
    """Two receivers that agree, and wheels or none."""
    bench = Bench()
    for t in range(seconds):
        for source in ("gnss", "second"):
            bench.fix(t, source=source)
            bench.velocity(t, source=source)
        if wheels:
            bench.wheel(t + 0.5, 8.5)
    return bench


@pytest.mark.parametrize(
    ("north_m_s", "east_m_s", "wheels", "denied"),
    [
        (8.5, 3.0, True, True),  # of another length
        (8.0, 3.5, True, False),  # turned, as by a heading that is wrong
        (7.5, 4.2, True, False),  # the same the other way
        (8.5, 3.0, False, False),
    ],
)
def test_wheels_deny_a_velocity_of_another_length(
    north_m_s: float, east_m_s: float, wheels: bool, denied: bool
) -> None:
    bench = bench_of(60, wheels=wheels)
    acted = [bench.velocity(t, OFF, east_m_s, north_m_s) for t in (60, 60.2, 60.4)]
    reason = DENIED if denied else "disagrees"
    assert bench.isolation.excluded == {"gnss_velocity": reason}
    assert acted[-1] is (Action.NONE if denied else Action.DOUBT_MOTION)


def off(along_m_s: float, across_m_s: float) -> tuple[float, float]:
    """East and north, of a velocity that is off by so much of where the filter goes."""
    north, east = NAV[VN : VE + 1] / np.hypot(NAV[VN], NAV[VE])
    by = along_m_s * np.array([east, north]) + across_m_s * np.array([north, -east])
    return float(NAV[VE] + by[0]), float(NAV[VN] + by[1])


@pytest.mark.parametrize("order", [1, -1])
def test_receivers_that_part_by_the_same_are_judged_by_their_mean(order: int) -> None:
    bench = bench_of(60, wheels=True)
    alongs = [("gnss", 0.56), ("second", 0.46)][::order]
    for t in (60, 60.2, 60.4):
        for source, along_m_s in alongs:
            assert bench.velocity(t, OFF, *off(along_m_s, 1.0), source) is Action.NONE
    assert bench.isolation.excluded == {"gnss_velocity": DENIED, "second_velocity": DENIED}


@pytest.mark.parametrize(("along_m_s", "denied"), [(0.4, True), (0.2, False)])
def test_what_one_is_denied_is_denied_to_another(along_m_s: float, denied: bool) -> None:
    """Within four sigmas, of 0.05 m/s each."""
    bench = bench_of(60, wheels=True)
    for t in (60, 60.2, 60.4):
        bench.velocity(t, OFF, *off(0.55, 1.0))
    for t in (60.6, 60.8, 61.0):
        acted = bench.velocity(t, OFF, *off(along_m_s, 1.0), "second")
    assert bench.isolation.excluded["second_velocity"] == (DENIED if denied else "disagrees")
    assert acted is (Action.NONE if denied else Action.DOUBT_MOTION)


@pytest.mark.parametrize(("course_e", "denied"), [(8.0, True), (0.5, False)])
def test_a_mean_that_wheels_deny_is_the_receivers(course_e: float, denied: bool) -> None:
    """A bias inside the gate, to the east, of a vehicle that goes there or across."""
    bench = bench_of(60, wheels=True)
    bench.nav = NAV.copy()
    bench.nav[VN : VE + 1] = 8.5 - course_e, course_e
    bench.covariance = np.diag([1e-6] * 3 + [0.02**2] * 3 + [0.3**2] * 3)
    t, acted = 60.0, set[Action]()
    while not bench.isolation.excluded and t < 90.0:
        acted.add(bench.velocity(t, 2.5))
        bench.wheel(t, 8.5)
        t += 0.2
    assert bench.isolation.excluded == {"gnss_velocity": DENIED if denied else "drifts"}
    assert (Action.DOUBT_MEASURED in acted) == denied


def test_wheels_that_have_been_silent_or_refused_deny_nothing() -> None:
    bench = bench_of(60, wheels=True)
    acted = [bench.velocity(63 + t / 5, OFF, 3.0, 8.5) for t in range(3)]
    assert acted[-1] is Action.DOUBT_MOTION


def wrong_together() -> tuple[Bench, float]:
    """Both velocities are denied, and the positions go along until one is told; when that is."""
    bench, t = bench_of(60, wheels=True), 60.0
    acted: set[Action] = set()
    while Action.DOUBT_MEASURED not in acted and t < 90.0:
        for source in ("gnss", "second"):
            bench.velocity(t, OFF, 3.0, 8.5, source)
            acted.add(bench.fix(t, source=source, north_m=2.0))
        bench.wheel(t, 8.5)
        t += 0.2
    assert Action.DOUBT_MOTION not in acted
    return bench, t


def test_positions_of_devices_whose_velocities_are_denied_are_left_out_together() -> None:
    bench, t = wrong_together()
    assert bench.isolation.excluded == {
        "gnss_velocity": DENIED,
        "second_velocity": DENIED,
        "gnss": "drifts",
        "second": "drifts",
    }
    lost = bench.isolation.lost(round(t * S))
    assert lost is not None
    assert lost.cause == "source"


def test_a_tilt_that_is_corrected_too_far_is_of_receivers_that_are_denied() -> None:
    """Before any mean of their positions tells: what these do to the tilt is not the IMU's."""
    p = np.diag([1e-4] * 9)
    turned = NAV.copy()
    turned[Q0 + 1] = 0.01
    for off_north_m_s, action in ((0.5, Action.DOUBT_MEASURED), (0.0, Action.DOUBT_MOTION)):
        bench = bench_of(60, wheels=True)
        for t in (60, 60.2, 60.4):
            bench.velocity(t, OFF if off_north_m_s else 0.0, 3.0, 8.0 + off_north_m_s)
        bench.isolation.correcting(NAV, TOLD * p)
        assert bench.isolation.corrected(round(60.6 * S), turned, p) is action
        assert ("gnss" in bench.isolation.excluded) == (off_north_m_s > 0.0)
        assert "second" not in bench.isolation.excluded


def test_their_velocities_come_back_with_the_positions() -> None:
    """In a bend a drift is across, where no wheel tells: they pass, and are not believed."""
    bench, t = wrong_together()
    for _ in range(30):
        bench.fix(t, north_m=30.0)
        bench.velocity(t)
        t += 0.2
    assert "gnss_velocity" in bench.isolation.excluded
    for _ in range(40):
        bench.fix(t)
        bench.velocity(t)
        t += 1.0
    assert bench.isolation.excluded.keys() == {"second", "second_velocity"}
