"""What becomes of the delay of an RDSS fix: the four strategies through intake and timeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.measurements import DelayedFix, MonotonicStamp
from fusiond.aiding.rdss_position import HeldFeedback, RdssPositionMeasurement
from fusiond.configuration.aiding import RdssAiding
from fusiond.navigator.intake import Intake
from fusiond.simulation.imu_truth import Truth
from fusiond.simulation.trajectories import Leg, Path, follow
from fusiond.studies.rdss import dynamic as rdss_dynamic
from fusiond.studies.rdss import static as rdss_static
from fusiond.studies.rdss.runs import (
    STRATEGIES,
    YANTAI_DEG_M,
    Case,
    Fixes,
    Navigation,
    draw_fixes,
    grid,
    imu_samples,
    metres_per_unit,
    nav_error,
    true_nav,
)

Array = NDArray[np.float64]
BY_NAME = {f.name: f for f in STRATEGIES}
LAT, LON = (float(np.radians(x)) for x in YANTAI_DEG_M[:2])
# Latitude and longitude are doubles near 1 rad: a unit in the last place is 7e-10 m, and each of
# some 1700 (static) to 3000 steps rounds: 4e-8 m as a random walk. Three times that.
ROUNDING_M = 1.2e-7


def truth_of(case: Case) -> Truth:
    origin = (LAT, LON, YANTAI_DEG_M[2])
    return Truth(case.path(case.duration_s), origin, case.imu.rate_hz, case.duration_s)


def scaled(case: Case, scale: float) -> tuple[Array, Fixes, Array]:
    """IMU samples, fixes and initial error of a run, with all errors times `scale`."""
    rng = np.random.default_rng(3)
    truth = truth_of(case)
    clean = np.hstack([truth.gyro, truth.accel])
    samples, _ = imu_samples(case, rng)
    fixes = draw_fixes(case, rng)
    at = truth.at(fixes.t_s).position[:, :2]
    sd = np.array([1.5e-4, 1.5e-4, 1.5e-4, 0.1, 0.1, 0.0, 100.0, 100.0, 0.0])
    return (
        clean + scale * (samples - clean),
        Fixes(fixes.t_s, fixes.arrival_s, at + scale * (fixes.position - at)),
        scale * rng.standard_normal(9) * sd,
    )


def live(case: Case, strategy: str, scale: float) -> Array:
    """Navigation states (n, 10) at the first sample after each arrival."""
    samples, fixes, error = scaled(case, scale)
    run = Navigation(case, BY_NAME[strategy], samples, error)
    states = []
    for k in range(len(fixes.t_s)):
        run.advance(float(fixes.arrival_s[k]))
        run.arrive(fixes, k)
        run.advance(float(fixes.arrival_s[k]) + 1.0 / case.imu.rate_hz)
        states.append(run.estimator.nav.copy())
    return np.array(states)


def apart_m(a: Array, b: Array) -> float:
    """Greatest distance north or east between states (n, 10)."""
    return float(np.abs((a[:, :2] - b[:, :2]) * metres_per_unit(LAT, YANTAI_DEG_M[2])[:2]).max())


DRIVE = replace(rdss_dynamic.CASES[0], duration_s=150.0)
LATE = {"back to back": (1.5, 1.5), "4.5 s late": (6.0, 4.5), "between samples": (1.5, 0.975)}


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("case", [rdss_static.CASE, DRIVE], ids=["static", "drive"])
def test_rewind_and_optimal_prediction_agree_to_rounding_on_a_linear_problem(
    case: Case, late: str
) -> None:
    """Errors so small that their products vanish make strapdown and feedback linear: then the two
    differ by rounding alone, though what they correct is ten thousand times that."""
    spacing_s, delay_s = LATE[late]
    case = replace(case, spacing_s=spacing_s, delay_s=delay_s, first_s=6.0 - delay_s)
    rewind = live(case, "rewind", 1e-3)
    assert apart_m(live(case, "optimal_prediction", 1e-3), rewind) < ROUNDING_M
    first = grid(case)[1][:1]
    assert apart_m(rewind[:1], first) > 1e4 * ROUNDING_M
    if case.path is not rdss_static.CASE.path:
        assert apart_m(live(case, "none", 1e-3), rewind) > 1e4 * ROUNDING_M


def test_beyond_the_linear_problem_they_differ_by_the_square_of_the_errors() -> None:
    case = replace(DRIVE, spacing_s=6.0, delay_s=4.5)
    large, small = (
        apart_m(live(case, "optimal_prediction", s), live(case, "rewind", s)) for s in (1.0, 0.3)
    )
    assert small > 10 * ROUNDING_M
    assert large / small == pytest.approx(1 / 0.3**2, rel=0.2)


def test_an_estimate_is_carried_until_its_own_fix_arrives() -> None:
    """The next request leaves at the very instant at which a fix arrives: what was held before is
    fed back there, what the next fix says is not."""
    samples, fixes, error = scaled(rdss_static.CASE, 1.0)
    states = []
    for count in (1, 2):
        run = Navigation(rdss_static.CASE, BY_NAME["optimal_prediction"], samples, error)
        run.advance(float(fixes.arrival_s[0]))
        before = run.estimator.nav.copy()
        for k in range(count):
            run.arrive(fixes, k)
        run.advance(float(fixes.arrival_s[0]) + 1.0)
        states.append(run.estimator.nav.copy())
        assert np.abs(before - run.estimator.nav)[:2].max() * 6.4e6 > 1.0
    assert np.array_equal(states[0], states[1])


# --------------------------------------------------------------------------- what they get wrong


def straight(duration_s: float) -> Path:
    """North, 20 m/s after the first 20 s, and a stop from 60 to 70 s."""
    legs = [Leg(20, speed_m_s=20.0), Leg(40), Leg(10, speed_m_s=0.0), Leg(duration_s)]
    return follow(legs, duration_s)


STRAIGHT = Case("straight", straight, 69.0, spacing_s=3.0, delay_s=3.0)


def error_north_m(strategy: str, at_s: float) -> float:
    """Error north at an instant after an arrival: IMU and fixes without error."""
    samples, fixes, _ = scaled(STRAIGHT, 0.0)
    run = Navigation(STRAIGHT, BY_NAME[strategy], samples, np.zeros(9))
    k = 0
    while k < len(fixes.t_s) and fixes.arrival_s[k] <= at_s:
        run.advance(float(fixes.arrival_s[k]))
        run.arrive(fixes, k)
        k += 1
    run.advance(at_s)
    true = true_nav(truth_of(STRAIGHT), np.array([at_s]))[0]
    return float(nav_error(run.estimator.nav, true)[6])


def test_pretending_that_a_fix_is_of_now_lags_behind_a_moving_vehicle() -> None:
    assert -60.0 < error_north_m("none", 60.0) < -15.0  # 20 m/s times 3 s is the fixes' own lag
    for strategy in ("rewind", "optimal_prediction", "position_compensation"):
        assert abs(error_north_m(strategy, 60.0)) < 2.0  # compensation remembers the start


def test_position_compensation_does_not_know_an_acceleration_in_the_delay() -> None:
    """The velocity at the arrival is not the one since the fix: braking shifts the moved fix."""
    assert abs(error_north_m("rewind", 66.0)) < 1e-3
    assert abs(error_north_m("optimal_prediction", 66.0)) < 1e-3
    assert abs(error_north_m("position_compensation", 66.0)) > 0.1


# --------------------------------------------------------------------------- the intake


def test_when_each_strategy_uses_a_fix() -> None:
    t_ns, seen_ns = 5_000_000_000, 6_500_000_000
    fix = DelayedFix("rdss", seen_ns, MonotonicStamp(t_ns), LAT, LON, 40.0, 20)
    found = {}
    for strategy in ("rewind", "optimal_prediction", "position_compensation", "none"):
        options = RdssAiding(strategy=strategy, fix_height_sd_m=None)
        measurements = Intake({"rdss": options}).measurements_of(fix, t_ns, 0.0, seen_ns)
        assert not isinstance(measurements, str)
        found[strategy] = [
            (a.t_ns, a.moved_s, a.holds)
            if isinstance(a, RdssPositionMeasurement)
            else (type(a), a.t_ns)
            for a in measurements
        ]
    assert found == {
        "rewind": [(t_ns, 0.0, False)],
        "optimal_prediction": [(t_ns, 0.0, True), (HeldFeedback, seen_ns)],
        "position_compensation": [(seen_ns, 1.5, False)],
        "none": [(seen_ns, 0.0, False)],
    }


def test_the_grid_of_a_case_is_true() -> None:
    t_s, states = grid(STRAIGHT)
    assert t_s[-1] == STRAIGHT.duration_s
    assert states[40, 3] == pytest.approx(20.0)
