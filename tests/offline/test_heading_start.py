"""A configured heading that may be anything: the daemon's filter finds the true one by driving."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.offline.process import process
from fusiond.simulation.files import Simulated, simulate
from fusiond.simulation.scenarios import SCENARIOS

SEED, FROM_S, SECONDS = 8, 50.0, 80.0
VEHICLE = """
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = 100.0
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
bias_sd_m = 0.0
[alignment]
heading = ["config"]
heading_deg = {heading_deg}
heading_sd_deg = {sd_deg}
[mqtt]
enabled = false
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return simulate(SCENARIOS["drive"], tmp_path_factory.mktemp("drive"), SEED, SECONDS)


def last_rows(path: Path, out: Path, every: int = 1) -> Path:
    """The table from `FROM_S` on: ten seconds at rest, and the town."""
    header, *rows = path.read_text().splitlines()
    rows = [row for row in rows if float(row.split(",")[0]) >= FROM_S]
    out.write_text("\n".join([header, *rows[::every]]))
    return out


@pytest.mark.parametrize(("off_deg", "sd_deg"), [(30.0, 20.0), (-90.0, 60.0), (180.0, 104.0)])
def test_a_heading_that_is_far_off_is_found_and_its_sigma_is_honest_all_the_way(
    written: Simulated, tmp_path: Path, off_deg: float, sd_deg: float
) -> None:
    truth = read_truth(written.files["truth"])
    heading_deg = (math.degrees(float(truth.rpy[0, 2])) + off_deg) % 360.0
    vehicle, out = tmp_path / "vehicle.toml", tmp_path / "solution.csv"
    vehicle.write_text(VEHICLE.format(heading_deg=heading_deg, sd_deg=sd_deg))
    imu = last_rows(written.files["imu"], tmp_path / "imu.csv")
    gnss = last_rows(written.files["gnss"], tmp_path / "gnss.csv", every=5)
    found = process(load_config(vehicle), imu, [("gnss", gnss)], [], out)
    assert set(found["sources"]["gnss"]) <= {"fused", "no_alignment"}
    solution = read_solution(out)
    known = np.isfinite(solution.rpy[:, 2])
    rows = np.searchsorted(truth.t_s, solution.t_s[known])
    error = np.remainder(solution.rpy[known, 2] - truth.rpy[rows, 2] + np.pi, 2.0 * np.pi) - np.pi
    sd = solution.sd_rpy[known, 2]
    assert math.degrees(sd[0]) == pytest.approx(sd_deg, rel=0.05)
    assert (np.abs(error) < 4.0 * sd).all()
    assert math.degrees(sd[-1]) < 1.0
    assert math.degrees(abs(error[-1])) < 2.0
