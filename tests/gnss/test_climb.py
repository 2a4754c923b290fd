"""Vertical velocity of a climb, of which the troposphere changes the carriers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.papers import configured


def test_an_aircraft_that_climbs_knows_its_vertical_velocity(tmp_path: Path) -> None:
    """Paper 002 by ranges: 15 mm/s off, at a sigma of 6, where the delay's rate is left in
    the carriers."""
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
