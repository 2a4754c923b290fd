"""Starts by the course, many times over: is the stated sigma that of the error?"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.matched_noise_drives import CODE, Vehicle, scene
from fusiond.studies.faults.solution_errors import errors_against
from tests import runs
from tests.navigator.starting import (
    CASES,
    EVERY,
    HIGH,
    HIGH_5,
    MOVING,
    RATE_HZ,
    RUNS,
    SHEET,
    TILT_AND_FORCE,
    feed,
    run_of,
    started,
    truth_of,
)
from tests.navigator.vehicle import CONFIG, START_NS, drive


@pytest.mark.parametrize("name", CASES)
def test_sigma_of_a_start_is_honest(name: str) -> None:
    case = CASES[name]
    truth = truth_of(case)
    attitude, velocity, tilt_and_force, yaw_sd = [], [], [], []
    for seed in range(RUNS):
        start = started(case, seed).started
        assert start is not None, f"seed {seed}"
        assert start.how == case.how, f"seed {seed}"
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true), start.covariance
        assert abs(error[2]) < 5.0 * math.sqrt(p[2, 2]), f"seed {seed}: yaw"
        attitude.append(error[:3] @ np.linalg.solve(p[:3, :3], error[:3]))
        velocity.append(error[3:6] @ np.linalg.solve(p[3:6, 3:6], error[3:6]))
        # What tilt and force biases have to do with each other shows in all five together.
        biases = run_of(case, seed).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
        both = np.concatenate((error[:2], biases[3:] - start.xi[12:15]))
        five = p[np.ix_(TILT_AND_FORCE, TILT_AND_FORCE)]
        tilt_and_force.append(both @ np.linalg.solve(five, both))
        yaw_sd.append(math.sqrt(p[2, 2]) / DEG)
    print(
        f"{name}: mean NEES of attitude {np.mean(attitude):.2f}, of velocity "
        f"{np.mean(velocity):.2f} of 3 (to {HIGH:.2f}), of tilt and force biases "
        f"{np.mean(tilt_and_force):.2f} of 5 (to {HIGH_5:.2f}); sigma of yaw "
        f"{np.mean(yaw_sd):.1f} deg"
    )
    assert np.mean(attitude) < HIGH
    assert np.mean(velocity) < HIGH
    assert np.mean(tilt_and_force) < HIGH_5
    assert np.mean(yaw_sd) < 10.0


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if not case.delay_s])
def test_a_receiver_without_velocity_starts_by_its_positions(name: str) -> None:
    """Forward, reversing, on a slope and in a spiral, from rest and met on the move."""
    case = CASES[name]
    truth = truth_of(case)
    squares, yaws, after_s = [], [], []
    for seed in range(4):
        start = started(case, seed, velocities=False).started
        assert start is not None, f"seed {seed}"
        assert start.how == "positions on the way", f"seed {seed}"
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true)[:9], start.covariance[:9, :9]
        squares.append(error @ np.linalg.solve(p, error))
        yaws.append(math.sqrt(p[2, 2]) / DEG)
        after_s.append(start.t_ns * 1e-9 - case.from_s)
        assert abs(error[2]) < 4.0 * math.sqrt(p[2, 2]), f"seed {seed}: yaw"
    print(f"{name}: NEES {np.mean(squares):.1f} of 9, yaw {np.mean(yaws):.1f} deg, after {after_s}")
    assert np.mean(squares) < float(chi2.ppf(0.999, 9 * len(squares))) / len(squares)
    assert max(yaws) < 10.1


def test_what_a_start_was_made_of_is_not_told_once_more() -> None:
    """It has an outcome of its own. A filter that was told it again, having felt nothing, took the
    vehicle to fall, and its velocities' offset in time to be known to 0.05 m/s by 9.8 m/s^2."""
    case = CASES["straight"]
    navigator = started(case, 3)
    start = navigator.started
    assert start is not None
    counts = navigator.timeline.counters.outcomes
    for source in ("gnss", "gnss_velocity"):
        assert counts[source]["start"] == 1
        assert set(counts[source]) <= {"no_alignment", "start", "fused"}
    (slot,) = navigator.model.slots_of("gnss_velocity_time")
    found = navigator.estimator.covariance[slot, slot]
    assert 0.8 * start.covariance[slot, slot] < found <= 1.001 * start.covariance[slot, slot]


def test_an_uncalibrated_sensor_is_met_on_the_move() -> None:
    """3 deg/s and 50 mg of bias: tilt is known no better than the force bias, and with it."""
    case = CASES["quiet all the time, first fixes on the move"]
    truth, attitude, rates = truth_of(case), [], []
    imu = {**SHEET, "sensor_class": "consumer"}
    for seed in range(12):
        start = started(case, seed, imu=imu).started
        assert start is not None
        assert start.how == case.how
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true)[:3], start.covariance
        attitude.append(error @ np.linalg.solve(p[:3, :3], error))
        biases = run_of(case, seed, imu).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
        wrong = biases[:3] - start.xi[9:12]
        rates.append(wrong @ np.linalg.solve(p[9:12, 9:12], wrong))
    high = float(chi2.ppf(0.999, 3 * len(rates))) / len(rates)
    assert np.mean(attitude) < high
    assert np.mean(rates) < high


def test_an_uncalibrated_sensor_is_met_at_rest() -> None:
    """3 deg/s of bias is no motion: what the gyros say at rest is what they say of no rate, and
    the start is not one on the move, of which a bend that is none would tell tilt from bias."""
    case = CASES["straight"]
    truth, tilts, rates, most = truth_of(case), [], [], 0.0
    imu = {**SHEET, "sensor_class": "consumer"}
    for seed in range(12):
        start = started(case, seed, imu=imu).started
        assert start is not None
        assert start.how == case.how
        biases = run_of(case, seed, imu).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
        most = max(most, float(np.abs(biases[:3]).max()))
        rates.append(biases[:3] - start.xi[9:12])
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true)[:2], start.covariance[:2, :2]
        tilts.append(error @ np.linalg.solve(p, error))
        assert np.sqrt(np.diag(start.covariance)[9:12]).max() < 0.2 * DEG
    assert most > 5.0 * DEG
    assert np.abs(rates).max() < 0.2 * DEG
    assert np.mean(tilts) < float(chi2.ppf(0.999, 2 * len(tilts))) / len(tilts)


@pytest.mark.parametrize(("heading_deg", "events"), [(45.0, []), (130.0, ["heading_contradicted"])])
def test_a_configured_heading_is_compared_with_the_course(
    heading_deg: float, events: list[str]
) -> None:
    """At rest nothing measures it; driving off does, and the course takes its place."""
    case = CASES["straight"]
    truth = truth_of(case)
    told: list[str] = []
    heading = {"heading": ["config", "gnss_course"], "heading_deg": heading_deg}
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}, "alignment": heading})
    navigator = Navigator(config, on_event=lambda code, text: told.append(code))
    samples, times = runs.imu_run(config.imu, truth, 4).samples, runs.sample_times(truth)
    for _ in feed(navigator, case, samples, range(0, 1500, EVERY), np.random.default_rng(4)):
        pass
    assert [code for code in told if code == "heading_contradicted"] == events
    start, yaw = navigator.started, navigator.solution(int(times[1499])).rpy_rad[2]
    assert start is not None
    assert start.how == (MOVING if events else "configured heading")
    assert yaw == pytest.approx(40.0 * DEG, abs=5.0 * DEG)


def test_fixes_of_before_the_first_sample_start_nothing_and_raise_nothing() -> None:
    """A daemon that was stopped for 20 s in motion: its lines still hold the fixes of the gap."""
    d = drive()
    navigator = Navigator(
        Config.model_validate({**CONFIG, "alignment": {"heading": ["gnss_course"]}})
    )
    since = START_NS + 20 * runs.SECOND
    navigator.add_imu(d.times[:10], d.samples[:10])
    row = int(np.searchsorted(d.times, since))
    navigator.add_imu(d.times[row : row + 10], d.samples[row : row + 10])
    for m in d.measurements:
        if since - 5 * runs.SECOND < m.t_seen_ns < since:
            navigator.add(m, m.t_seen_ns)
    navigator.advance()
    assert navigator.mode(navigator.imu.latest_ns)[0] is Mode.ALIGNING


def test_a_heading_by_the_course_has_the_noise_of_the_velocity_that_it_is_of() -> None:
    """Moving off by code: if the velocity was off by e across the way, the heading was by e / v, so
    that what the next velocities say of the first corrects the other."""
    on = scene(Vehicle("mems", CODE), "looked", 1600, 30.0)
    found: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def watch(navigator: Navigator) -> None:
        if navigator.started is not None and not found:
            start = navigator.started
            assert start.how == "GNSS course"
            found.append((start.covariance, start.nav))

    errors_against(on.config, on.recording, on.truth.at(np.arange(0.1, 30.0, 0.1)), watch=watch)
    [(p, nav)] = found
    speed = math.hypot(nav[3], nav[4])
    across = np.array([-nav[4], nav[3]]) / speed
    level, _ = CODE.velocity_m_s
    assert float(p[2, 3:5] @ across) == pytest.approx(-(level**2) / speed, rel=0.1)
