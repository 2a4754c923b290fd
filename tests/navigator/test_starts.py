"""Starts by the course, many times over: is the stated sigma that of the error?"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from drivers.measurements import MonotonicStamp, PositionFix
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.imu_truth import States, Truth
from fusiond.simulation.trajectories import Leg, follow
from tests import runs
from tests.navigator.vehicle import CONFIG, START_NS, drive

Array = NDArray[np.float64]

RATE_HZ, EVERY = 50.0, 10
"""A fix after so many samples."""
SD_M, SD_M_S = 1.5, 0.05
RUNS = 24
HIGH, HIGH_5 = (float(chi2.ppf(0.999, n * RUNS)) / RUNS for n in (3, 5))
"""99.9 % of the mean of as many NEES of three states, and of five."""
TILT_AND_FORCE = [0, 1, 12, 13, 14]
FORWARD, BACKWARD = "GNSS course", "GNSS course, backward"
MOVING, MOVING_BACKWARD = "GNSS course, on the move", "GNSS course, on the move, backward"
LEVER = (3.0, 0.4, -1.0)
BRAKE = (Leg(6), Leg(4, speed_m_s=8.0), Leg(4, speed_m_s=14.0), Leg(8, turn_deg=80.0), Leg(60))


class Case(NamedTuple):
    """A drive, what is heard of it from `from_s` on, and the start that it must lead to."""

    legs: Sequence[Leg]
    how: str
    from_s: float = 0.0
    fixes_from_s: float = 0.0
    lever: tuple[float, float, float] = (0.0, 0.0, -1.0)
    delay_s: float = 0.0
    """How much later than its stamp a velocity is valid."""


TURN_OFF = Leg(8, speed_m_s=9.0, turn_deg=90.0)
RAMP = (Leg(10, turn_deg=300.0), Leg(10, turn_deg=300.0), Leg(10, turn_deg=300.0), Leg(30))
"""Of a multi-storey car park: full turns of 10 m radius, one after another."""
CASES = {
    "straight": Case((Leg(8), Leg(8, speed_m_s=12.0), Leg(30)), FORWARD),
    "in a bend with a long lever": Case((Leg(8), TURN_OFF, Leg(30)), FORWARD, lever=LEVER),
    "backward": Case((Leg(8), Leg(6, speed_m_s=-4.5), Leg(30)), BACKWARD),
    "on a slope": Case(
        (Leg(1, climb_deg=6.0), Leg(8), Leg(8, speed_m_s=10.0), Leg(30)), FORWARD, from_s=2.0
    ),
    "backward up a slope": Case(
        (Leg(1, climb_deg=-6.0), Leg(8), Leg(6, speed_m_s=-4.5), Leg(30)), BACKWARD, from_s=2.0
    ),
    "off into a spiral": Case(
        (Leg(8), Leg(4, speed_m_s=5.0, climb_deg=5.0, turn_deg=90.0), *RAMP), FORWARD, lever=LEVER
    ),
    "in a spiral": Case(
        (Leg(1, climb_deg=5.0), Leg(4, speed_m_s=5.0), Leg(3), *RAMP), MOVING, 9.0, lever=LEVER
    ),
    "down a spiral": Case(
        (Leg(1, climb_deg=-5.0), Leg(4, speed_m_s=5.0), Leg(3), *RAMP), MOVING, 9.0, lever=LEVER
    ),
    "on the move": Case((Leg(1), Leg(6, speed_m_s=14.0), *BRAKE), MOVING, 9.0, lever=LEVER),
    "on the move, velocities late": Case(
        (Leg(1), Leg(6, speed_m_s=14.0), *BRAKE), MOVING, 9.0, lever=LEVER, delay_s=0.12
    ),
    "on the move, backward": Case(
        (Leg(1), Leg(6, speed_m_s=-6.0), Leg(4), Leg(4, speed_m_s=-4.0), Leg(6, turn_deg=-60.0),
         Leg(6, turn_deg=40.0), Leg(40)), MOVING_BACKWARD, 8.0,
    ),
    "quiet all the time, first fixes on the move": Case(
        (Leg(1), Leg(6, speed_m_s=14.0), Leg(20), *BRAKE), MOVING, 9.0, 24.0
    ),
}  # fmt: skip


@lru_cache(maxsize=2)
def _truth(case: Case, seconds: float = 60.0) -> Truth:
    return Truth(follow(case.legs, seconds, course_deg=40.0), runs.ORIGIN, RATE_HZ, seconds)


@lru_cache(maxsize=2)
def _antenna(case: Case) -> States:
    """Where the antenna is at each fix, and how fast."""
    truth = _truth(case)
    return truth.at(truth.t_s[EVERY::EVERY], case.lever)


def _fix(case: Case, row: int, rng: np.random.Generator) -> PositionFix:
    """What the receiver says at the end of the samples `row` to `row` + `EVERY`."""
    antenna, k = _antenna(case), row // EVERY
    p, v = antenna.position[k], antenna.v_ned[k]
    if case.delay_s:
        v = _truth(case).at(antenna.t_s[k : k + 1] + case.delay_s, case.lever).v_ned[0]
    away = SD_M * rng.standard_normal(3) / np.abs(runs.metres(float(p[0]), float(p[2])))
    lat, lon, height = (p + away).tolist()
    north, east, down = (v + SD_M_S * rng.standard_normal(3)).tolist()
    t_ns = round(float(antenna.t_s[k]) * 1e9)
    fix = PositionFix("gnss", t_ns, MonotonicStamp(t_ns), lat, lon, height)
    sd: Any = {"sd_ned_m": (SD_M,) * 3, "sd_v_ned_m_s": (SD_M_S,) * 3}
    return replace(fix, v_ned_m_s=(north, east, down), **sd)


def _feed(
    navigator: Navigator,
    case: Case,
    samples: Array,
    rows: range,
    rng: np.random.Generator,
    velocities: bool = True,
) -> Iterator[None]:
    """Samples and a fix at a time; the fixes begin at `fixes_from_s`. Yields after each."""
    times = runs.sample_times(_truth(case))
    for row in rows:
        part = slice(row, row + EVERY)
        navigator.add_imu(times[part], samples[part])
        if times[part][-1] >= case.fixes_from_s * 1e9:
            fix = _fix(case, row, rng)
            if not velocities:
                fix = replace(fix, v_ned_m_s=None, sd_v_ned_m_s=None)
            navigator.add(fix, fix.t_seen_ns, seen_ns=fix.t_seen_ns)
        navigator.advance()
        yield


SHEET: dict[str, Any] = {"rate_hz": RATE_HZ}


def _run(case: Case, seed: int, imu: dict[str, Any] = SHEET) -> runs.ImuRun:
    return runs.imu_run(Config.model_validate({"imu": imu}).imu, _truth(case), seed)


def _started(
    case: Case,
    seed: int,
    until_s: float = 60.0,
    imu: dict[str, Any] = SHEET,
    velocities: bool = True,
) -> Navigator:
    """Run until the start, or to `until_s`."""
    config = Config.model_validate(
        {
            "imu": imu,
            "aiding": {"gnss": {"lever_arm_m": case.lever}},
            "alignment": {"heading": ["gnss_course", "positions"]},
        }
    )
    samples = _run(case, seed, imu).samples
    navigator = Navigator(config)
    rows = range(round(case.from_s * RATE_HZ), round(until_s * RATE_HZ), EVERY)
    for _ in _feed(navigator, case, samples, rows, np.random.default_rng(seed), velocities):
        if navigator.started is not None:
            break
    return navigator


@pytest.mark.parametrize("name", CASES)
def test_sigma_of_a_start_is_honest(name: str) -> None:
    case = CASES[name]
    truth = _truth(case)
    attitude, velocity, tilt_and_force, yaw_sd = [], [], [], []
    for seed in range(RUNS):
        start = _started(case, seed).started
        assert start is not None, f"seed {seed}"
        assert start.how == case.how, f"seed {seed}"
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true), start.covariance
        assert abs(error[2]) < 5.0 * math.sqrt(p[2, 2]), f"seed {seed}: yaw"
        attitude.append(error[:3] @ np.linalg.solve(p[:3, :3], error[:3]))
        velocity.append(error[3:6] @ np.linalg.solve(p[3:6, 3:6], error[3:6]))
        # What tilt and force biases have to do with each other shows in all five together.
        biases = _run(case, seed).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
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
    truth = _truth(case)
    squares, yaws, after_s = [], [], []
    for seed in range(4):
        start = _started(case, seed, velocities=False).started
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
    navigator = _started(case, 3)
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
    truth, attitude, rates = _truth(case), [], []
    imu = {**SHEET, "sensor_class": "consumer"}
    for seed in range(12):
        start = _started(case, seed, imu=imu).started
        assert start is not None
        assert start.how == case.how
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true)[:3], start.covariance
        attitude.append(error @ np.linalg.solve(p[:3, :3], error))
        biases = _run(case, seed, imu).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
        wrong = biases[:3] - start.xi[9:12]
        rates.append(wrong @ np.linalg.solve(p[9:12, 9:12], wrong))
    high = float(chi2.ppf(0.999, 3 * len(rates))) / len(rates)
    assert np.mean(attitude) < high
    assert np.mean(rates) < high


def test_an_uncalibrated_sensor_is_met_at_rest() -> None:
    """3 deg/s of bias is no motion: what the gyros say at rest is what they say of no rate, and
    the start is not one on the move, of which a bend that is none would tell tilt from bias."""
    case = CASES["straight"]
    truth, tilts, rates, most = _truth(case), [], [], 0.0
    imu = {**SHEET, "sensor_class": "consumer"}
    for seed in range(12):
        start = _started(case, seed, imu=imu).started
        assert start is not None
        assert start.how == case.how
        biases = _run(case, seed, imu).biases[round(start.t_ns * 1e-9 * RATE_HZ) - 1]
        most = max(most, float(np.abs(biases[:3]).max()))
        rates.append(biases[:3] - start.xi[9:12])
        true = runs.true_nav(truth, np.array([start.t_ns * 1e-9]))[0]
        error, p = runs.nav_error(start.nav, true)[:2], start.covariance[:2, :2]
        tilts.append(error @ np.linalg.solve(p, error))
        assert np.sqrt(np.diag(start.covariance)[9:12]).max() < 0.2 * DEG
    assert most > 5.0 * DEG
    assert np.abs(rates).max() < 0.2 * DEG
    assert np.mean(tilts) < float(chi2.ppf(0.999, 2 * len(tilts))) / len(tilts)


def test_velocities_that_are_none_are_no_start() -> None:
    """Two of forty, of a receiver that said the opposite until then: their fit knows no heading,
    and its tilt, wrong by ten degrees, is theirs. It waits until they are not asked any more."""
    case = CASES["on the move"]
    config = Config.model_validate({"imu": SHEET, "alignment": {"heading": ["gnss_course"]}})
    navigator, rng, said = Navigator(config), np.random.default_rng(3), set[str]()
    times, samples = runs.sample_times(_truth(case)), _run(case, 3).samples
    for row in range(450, 2900, EVERY):
        part = slice(row, row + EVERY)
        navigator.add_imu(times[part], samples[part])
        fix = _fix(case, row, rng)
        assert fix.v_ned_m_s is not None
        if row < 470:
            north, east, down = fix.v_ned_m_s
            fix = replace(fix, v_ned_m_s=(-north, -east, down))
        navigator.add(fix, fix.t_seen_ns, seen_ns=fix.t_seen_ns)
        navigator.advance()
        if navigator.started is not None:
            break
        said.add(navigator.mode(navigator.imu.latest_ns)[1])
    assert any("elocities of the fixes disagree" in why for why in said)
    start = navigator.started
    assert start is not None
    true = runs.true_nav(_truth(case), np.array([start.t_ns * 1e-9]))[0]
    error = runs.nav_error(start.nav, true)[:3]
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(start.covariance)[:3]))
    assert math.sqrt(start.covariance[2, 2]) < 10.0 * DEG


def test_no_start_is_made_of_velocities_that_the_positions_contradicted() -> None:
    """They were 6 m/s off until a bend had begun, in which a jump of the velocity looks much like a
    force bias of 1 m/s^2: fits of all of them were accepted with tilts 10 deg off at an NEES of 50
    and more."""
    legs = (Leg(1), Leg(6, speed_m_s=20.0), Leg(4), Leg(16, turn_deg=93.0), Leg(60))
    case, five = CASES["on the move"]._replace(legs=legs), []
    config = Config.model_validate({"imu": SHEET, "alignment": {"heading": ["gnss_course"]}})
    for seed in range(8):
        navigator, rng = Navigator(config), np.random.default_rng(seed)
        times, run = runs.sample_times(_truth(case)), _run(case, seed)
        wrong = 6.0 * np.array([math.cos(0.5 * math.pi * seed), math.sin(0.5 * math.pi * seed)])
        for row in range(450, 2900, EVERY):
            part = slice(row, row + EVERY)
            navigator.add_imu(times[part], run.samples[part])
            fix = _fix(case, row, rng)
            if row < 700:
                assert fix.v_ned_m_s is not None
                north, east = (np.array(fix.v_ned_m_s[:2]) + wrong).tolist()
                fix = replace(fix, v_ned_m_s=(north, east, fix.v_ned_m_s[2]))
            navigator.add(fix, fix.t_seen_ns, seen_ns=fix.t_seen_ns)
            navigator.advance()
            if navigator.started is not None:
                break
        start = navigator.started
        assert start is not None
        assert start.contradicted
        row = round(start.t_ns * 1e-9 * RATE_HZ) - 1
        true = runs.true_nav(_truth(case), np.array([start.t_ns * 1e-9]))[0]
        tilt = runs.nav_error(start.nav, true)[:2]
        both = np.concatenate((tilt, run.biases[row, 3:] - start.xi[12:15]))
        p = start.covariance[np.ix_(TILT_AND_FORCE, TILT_AND_FORCE)]
        five.append(both @ np.linalg.solve(p, both))
    print(f"mean NEES of tilt and force biases {np.mean(five):.2f} of 5")
    assert np.mean(five) < float(chi2.ppf(0.999, 5 * len(five))) / len(five)


def test_straight_on_at_constant_speed_nobody_knows_forward_from_backward() -> None:
    """Below the speed that one reverses at it waits, and says what to do."""
    case = Case((Leg(1), Leg(6, speed_m_s=5.0), Leg(60)), MOVING, 9.0)
    navigator = _started(case, 1, until_s=40.0)
    assert navigator.started is None
    mode, reason = navigator.mode(navigator.imu.latest_ns)
    assert mode is Mode.ALIGNING
    assert "Brake, accelerate or turn" in reason or "brake, accelerate or turn" in reason


def test_an_imu_that_is_upside_down_is_refused() -> None:
    """Its data are those of x forward, y left, z up; the configuration says right and down."""
    case = CASES["straight"]
    truth = _truth(case)
    events: list[str] = []
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}})
    navigator = Navigator(config, on_event=lambda code, text: events.append(code))
    samples = runs.imu_run(config.imu, truth, 1).samples * np.tile([1.0, -1.0, -1.0], 2)
    for _ in _feed(navigator, case, samples, range(0, 1500, EVERY), np.random.default_rng(1)):
        pass
    assert navigator.started is None
    assert events == ["imu_upside_down"]
    assert "upside down" in navigator.mode(navigator.imu.latest_ns)[1]


def test_an_imu_that_is_mounted_backwards_is_told_and_never_navigates() -> None:
    case = CASES["straight"]
    truth = _truth(case)
    events: list[str] = []
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}})
    navigator = Navigator(config, on_event=lambda code, text: events.append(code))
    samples = runs.imu_run(config.imu, truth, 1).samples * np.tile([-1.0, -1.0, 1.0], 2)
    for _ in _feed(navigator, case, samples, range(0, 1800, EVERY), np.random.default_rng(1)):
        assert navigator.started is None
    assert [code for code in events if code != "not_aligned"] == ["imu_backwards"]


def test_a_turning_deck_is_no_rest() -> None:
    """0.6 deg/s is six sigma of the bias at switch-on; the start says so, and waits."""
    legs = (Leg(60, turn_deg=36.0 * 1.875),)  # the profile's largest rate, in its middle
    case = Case(legs, "", lever=(0.0, 0.0, 0.0))
    config = Config.model_validate(
        {
            "imu": {"rate_hz": RATE_HZ},
            "alignment": {"heading": ["config"], "heading_deg": 60.0},
        }
    )
    navigator = Navigator(config)
    samples = runs.imu_run(config.imu, _truth(case), 2).samples
    for _ in _feed(navigator, case, samples, range(1000, 2000, EVERY), np.random.default_rng(2)):
        pass
    assert navigator.started is None
    assert "turning at" in navigator.mode(navigator.imu.latest_ns)[1]


@pytest.mark.parametrize(("heading_deg", "events"), [(45.0, []), (130.0, ["heading_contradicted"])])
def test_a_configured_heading_is_compared_with_the_course(
    heading_deg: float, events: list[str]
) -> None:
    """At rest nothing measures it; driving off does, and the course takes its place."""
    case = CASES["straight"]
    truth = _truth(case)
    told: list[str] = []
    heading = {"heading": ["config", "gnss_course"], "heading_deg": heading_deg}
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}, "alignment": heading})
    navigator = Navigator(config, on_event=lambda code, text: told.append(code))
    samples, times = runs.imu_run(config.imu, truth, 4).samples, runs.sample_times(truth)
    for _ in _feed(navigator, case, samples, range(0, 1500, EVERY), np.random.default_rng(4)):
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
