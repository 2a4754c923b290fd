"""No start: of what contradicts itself, turns, faces the wrong way, or tells no heading yet."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import DEG
from fusiond.navigation.solution import Mode
from fusiond.navigator.navigator import Navigator
from fusiond.simulation.trajectories import Leg
from tests import runs
from tests.navigator.starting import (
    CASES,
    EVERY,
    MOVING,
    RATE_HZ,
    SHEET,
    TILT_AND_FORCE,
    Case,
    feed,
    fix_of,
    run_of,
    started,
    truth_of,
)


def test_velocities_that_are_none_are_no_start() -> None:
    """Two of forty, of a receiver that said the opposite until then: their fit knows no heading,
    and its tilt, wrong by ten degrees, is theirs. It waits until they are not asked any more."""
    case = CASES["on the move"]
    config = Config.model_validate({"imu": SHEET, "alignment": {"heading": ["gnss_course"]}})
    navigator, rng, said = Navigator(config), np.random.default_rng(3), set[str]()
    times, samples = runs.sample_times(truth_of(case)), run_of(case, 3).samples
    for row in range(450, 2900, EVERY):
        part = slice(row, row + EVERY)
        navigator.add_imu(times[part], samples[part])
        fix = fix_of(case, row, rng)
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
    true = runs.true_nav(truth_of(case), np.array([start.t_ns * 1e-9]))[0]
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
        times, run = runs.sample_times(truth_of(case)), run_of(case, seed)
        wrong = 6.0 * np.array([math.cos(0.5 * math.pi * seed), math.sin(0.5 * math.pi * seed)])
        for row in range(450, 2900, EVERY):
            part = slice(row, row + EVERY)
            navigator.add_imu(times[part], run.samples[part])
            fix = fix_of(case, row, rng)
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
        true = runs.true_nav(truth_of(case), np.array([start.t_ns * 1e-9]))[0]
        tilt = runs.nav_error(start.nav, true)[:2]
        both = np.concatenate((tilt, run.biases[row, 3:] - start.xi[12:15]))
        p = start.covariance[np.ix_(TILT_AND_FORCE, TILT_AND_FORCE)]
        five.append(both @ np.linalg.solve(p, both))
    print(f"mean NEES of tilt and force biases {np.mean(five):.2f} of 5")
    assert np.mean(five) < float(chi2.ppf(0.999, 5 * len(five))) / len(five)


def test_straight_on_at_constant_speed_nobody_knows_forward_from_backward() -> None:
    """Below the speed that one reverses at it waits, and says what to do."""
    case = Case((Leg(1), Leg(6, speed_m_s=5.0), Leg(60)), MOVING, 9.0)
    navigator = started(case, 1, until_s=40.0)
    assert navigator.started is None
    mode, reason = navigator.mode(navigator.imu.latest_ns)
    assert mode is Mode.ALIGNING
    assert "Brake, accelerate or turn" in reason or "brake, accelerate or turn" in reason


def test_an_imu_that_is_upside_down_is_refused() -> None:
    """Its data are those of x forward, y left, z up; the configuration says right and down."""
    case = CASES["straight"]
    truth = truth_of(case)
    events: list[str] = []
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}})
    navigator = Navigator(config, on_event=lambda code, text: events.append(code))
    samples = runs.imu_run(config.imu, truth, 1).samples * np.tile([1.0, -1.0, -1.0], 2)
    for _ in feed(navigator, case, samples, range(0, 1500, EVERY), np.random.default_rng(1)):
        pass
    assert navigator.started is None
    assert events == ["imu_upside_down"]
    assert "upside down" in navigator.mode(navigator.imu.latest_ns)[1]


def test_an_imu_that_is_mounted_backwards_is_told_and_never_navigates() -> None:
    case = CASES["straight"]
    truth = truth_of(case)
    events: list[str] = []
    config = Config.model_validate({"imu": {"rate_hz": RATE_HZ}})
    navigator = Navigator(config, on_event=lambda code, text: events.append(code))
    samples = runs.imu_run(config.imu, truth, 1).samples * np.tile([-1.0, -1.0, 1.0], 2)
    for _ in feed(navigator, case, samples, range(0, 1800, EVERY), np.random.default_rng(1)):
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
    samples = runs.imu_run(config.imu, truth_of(case), 2).samples
    for _ in feed(navigator, case, samples, range(1000, 2000, EVERY), np.random.default_rng(2)):
        pass
    assert navigator.started is None
    assert "turning at" in navigator.mode(navigator.imu.latest_ns)[1]
