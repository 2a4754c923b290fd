"""What the troposphere makes of a climb in carriers, and the vertical velocity of one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fusiond.files.tables import read_solution, read_truth
from fusiond.gnss.atmosphere import slant, zenith_delays
from fusiond.gnss.climbing import take_off_climb
from fusiond.gnss.range_kernel import CARRIER_RATE, RANGE_VALUES, TROPOSPHERE_SIGMA
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.papers import configured

LAT_RAD, HEIGHT_M, CLIMB_M_S, SPAN_S = 0.53, 1200.0, 12.0, 0.2


def test_the_rate_of_the_delay_is_taken_off() -> None:
    """Carriers that say nothing but the delay's change say nothing afterwards."""
    sines = np.sin(np.radians([12.0, 30.0, 60.0, 90.0]))
    mapping = np.array([slant(float(s)) for s in sines])
    before, after = (
        sum(zenith_delays(LAT_RAD, HEIGHT_M + sign * 0.5 * CLIMB_M_S * SPAN_S))
        for sign in (-1.0, 1.0)
    )
    values = np.zeros((RANGE_VALUES, 4))
    values[CARRIER_RATE] = mapping * (after - before) / SPAN_S
    values[TROPOSPHERE_SIGMA] = 0.12 * mapping
    assert values[CARRIER_RATE, 0] < -0.012
    take_off_climb(values, LAT_RAD, HEIGHT_M, CLIMB_M_S)
    assert np.abs(values[CARRIER_RATE]).max() < 2e-5


def test_a_rate_that_was_not_measured_stays_so() -> None:
    values = np.zeros((RANGE_VALUES, 1))
    values[CARRIER_RATE], values[TROPOSPHERE_SIGMA] = math.nan, 0.12
    take_off_climb(values, LAT_RAD, HEIGHT_M, CLIMB_M_S)
    assert math.isnan(values[CARRIER_RATE, 0])


def test_an_aircraft_that_climbs_knows_its_vertical_velocity(tmp_path: Path) -> None:
    """Paper 002 by ranges: 15 mm/s off, at a sigma of 6, where the delay's rate is left in."""
    config, scenario = configured("002")
    files = simulate(scenario, tmp_path, seed=1, duration_s=110.0, gnss_raw="ubx").files
    measurements = [
        ("raw", files["raw"]),
        ("attitude", files["attitude"]),
        ("bearing", files["bearing"]),
    ]
    process(config, files["imu"], measurements, out=tmp_path / "nav.csv")
    nav, truth = read_solution(tmp_path / "nav.csv"), read_truth(files["truth"])
    later = nav.t_s > 70.0
    down = np.interp(nav.t_s, truth.t_s, truth.v[:, 2])
    assert np.abs(down[later]).max() > 5.0
    error = (nav.v[:, 2] - down)[later]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.0, abs=0.005)
    assert np.abs(error / nav.sd_v[later, 2]).max() < 4.0
