"""Orbits and satellite clocks against RTKLIB: positions to 1 mm, clocks to 1 ps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.raw.messages import SPEED_OF_LIGHT_M_S
from fusiond.gnss.orbit import Orbits, gps_time, is_beidou_geo
from tests.gnss.examples import ephemeris, examples, oracle_ephemeris, oracle_state, oracle_time
from tests.gnss.examples import rtk as pyrtklib

WEEK, TOE = 2381, 388800.0


@pytest.mark.parametrize("after_s", [-7200.0, -1800.0, 0.0, 13.25, 1799.9, 7200.0])
def test_positions_and_clocks_are_those_of_rtklib(after_s: float) -> None:
    made = examples(WEEK, TOE)
    states = Orbits.of(made).at(WEEK, TOE + after_s)
    for k, e in enumerate(made):
        position, clock = oracle_state(e, WEEK, TOE + after_s)
        assert np.linalg.norm(states.position[k] - position) < 1e-3, e.satellite
        assert abs(states.clock_s[k] - clock) < 1e-12, e.satellite


@pytest.mark.parametrize(("toe", "week_off", "tow"), [(0.0, -1, 604000.0), (600000.0, 1, 100.0)])
def test_across_the_turn_of_the_week(toe: float, week_off: int, tow: float) -> None:
    made = examples(WEEK, toe)
    states = Orbits.of(made).at(WEEK + week_off, tow)
    for k, e in enumerate(made):
        position, clock = oracle_state(e, WEEK + week_off, tow)
        assert np.linalg.norm(states.position[k] - position) < 1e-3, e.satellite
        assert abs(states.clock_s[k] - clock) < 1e-12, e.satellite


def test_rates_of_the_axis_and_of_the_mean_motion() -> None:
    """At tk the orbit is that of an axis and a mean anomaly that have moved on."""
    (e, *_), tk = [x for x in examples(WEEK, TOE) if x.system == "C" and x.prn > 10], 1800.0
    moving = replace(e, semi_major_rate=0.02, mean_motion_rate=3e-13)
    moved = replace(
        e,
        sqrt_a=math.sqrt(e.sqrt_a**2 + 0.02 * tk),
        mean_anomaly=e.mean_anomaly + 0.5 * 3e-13 * tk * tk,
        mean_motion_correction=e.mean_motion_correction
        + math.sqrt(3.986004418e14) * (e.sqrt_a**-3 - (e.sqrt_a**2 + 0.02 * tk) ** -1.5),
    )
    week, tow = gps_time("C", e.week, e.toe_s + tk)
    a, b = (Orbits.of([x]).at(week, tow).position[0] for x in (moving, moved))
    assert np.linalg.norm(a - b) < 1e-4
    assert np.linalg.norm(a - Orbits.of([e]).at(week, tow).position[0]) > 10.0


def test_toc_in_the_week_before_toe() -> None:
    """Clock of the last minutes of a week with an orbit of the next one."""
    e = replace(ephemeris("G", 5, week=WEEK, toe_s=0.0), toc_s=604784.0)
    same = replace(e, toc_s=-16.0)
    a, b = (Orbits.of([x]).at(WEEK, 30.0) for x in (e, same))
    assert abs(a.clock_s[0] - b.clock_s[0]) < 1e-15
    assert np.array_equal(a.position, b.position)


@pytest.mark.parametrize("step", [0.5])
def test_velocity_and_drift_are_the_derivatives(step: float) -> None:
    made = examples(WEEK, TOE)
    # B-CNAV's rates: 0.06 m/s is its largest, 2^-57 * 2^22 semicircles/s^2 of the mean motion too
    made += [replace(e, semi_major_rate=0.05, mean_motion_rate=9e-11) for e in made]
    orbits = Orbits.of(made)
    for tow in (TOE - 3600.0, TOE + 1234.5):
        v = orbits.at(WEEK, tow)
        ahead, behind = orbits.at(WEEK, tow + step), orbits.at(WEEK, tow - step)
        # second order: step^2 / 6 times the third derivative, 1e-4 m/s^3, is under 5e-6 m/s;
        # rounding of 4e7 m is 4e-9 m / 0.5 s
        numeric = (ahead.position - behind.position) / (2 * step)
        assert np.abs(v.velocity - numeric).max() < 2e-5
        drift = (ahead.clock_s - behind.clock_s) / (2 * step)
        assert np.abs(v.clock_drift - drift).max() < 1e-15


def test_relativity_is_minus_two_r_v_over_c_squared() -> None:
    """F e sqrtA sin E is this for the Keplerian part; the harmonics of the orbit add under 0.1 ns.

    Both in an inertial frame: v + we x r.
    """
    made = examples(WEEK, TOE)
    bare = [
        replace(
            e,
            cuc=0.0, cus=0.0, crc=0.0, crs=0.0, cic=0.0, cis=0.0, mean_motion_correction=0.0,
            clock_bias_s=0.0, clock_drift=0.0, clock_drift_rate=0.0,
        )
        for e in made
    ]  # fmt: skip
    s = Orbits.of(bare).at(WEEK, TOE + 500.0)
    dot = np.einsum("ij,ij->i", s.position, s.velocity)  # we x r is perpendicular to r
    assert np.abs(s.clock_s + 2.0 * dot / SPEED_OF_LIGHT_M_S**2).max() < 1e-13
    assert np.abs(s.clock_s).max() > 1e-8


def test_transmission_by_the_satellites_own_clock() -> None:
    """The receiver's clock error cancels; RTKLIB's own steps give the same position and clock."""
    made = examples(WEEK, TOE)
    tow, pseudorange = TOE + 600.0, np.full(len(made), 2.4e7)
    sent = Orbits.of(made).sent(WEEK, tow, pseudorange)
    shifted = Orbits.of(made).sent(WEEK, tow + 3e-4, pseudorange + 3e-4 * SPEED_OF_LIGHT_M_S)
    assert np.abs(sent.position - shifted.position).max() < 1e-5
    for k, e in enumerate(made):
        by_clock = tow - 2.4e7 / SPEED_OF_LIGHT_M_S
        t = by_clock - pyrtklib.eph2clk(oracle_time(WEEK, by_clock), oracle_ephemeris(e))
        position, clock = oracle_state(e, WEEK, t)
        assert np.linalg.norm(sent.position[k] - position) < 1e-3, e.satellite
        assert abs(sent.clock_s[k] - clock) < 1e-12, e.satellite


def test_beidou_time_and_geo_numbers() -> None:
    assert gps_time("C", 0, 0.0) == (1356, 14.0)
    assert gps_time("E", 2381, 5.0) == (2381, 5.0)
    assert [n for n in range(1, 64) if is_beidou_geo("C", n)] == [1, 2, 3, 4, 5, *range(59, 64)]
    assert not is_beidou_geo("G", 1)
