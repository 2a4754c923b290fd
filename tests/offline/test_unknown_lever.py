"""`process` and `calibrate` of cars with RTK whose lever arm nobody has measured."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.schema import Config
from fusiond.files.measurement_csv import read_solution, read_truth
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.offline.calibrate import calibrate, files
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.estimators.monte_carlo import interval

Array = NDArray[np.float64]

LEVERS = ((1.6, -0.5, -1.3), (-0.9, 0.4, -0.6), (0.3, 0.6, -1.0))
SECONDS = 200.0
CAR: dict[str, Any] = {
    "imu": {"axes": ["+x", "-y", "-z"], "rate_hz": 100.0, "sensor_class": "mems"},
    "aiding": {"gnss": {}},
    "constraints": {"non_holonomic": {"enabled": True}},
    "alignment": {"heading": ["gnss_course"]},
}


@pytest.fixture(scope="module", params=range(len(LEVERS)))
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A folder of files and the lever arm."""
    folder, lever = tmp_path_factory.mktemp("drive"), LEVERS[request.param]
    scenario = SCENARIOS["drive"]
    rtk = replace(scenario.gnss, rate_hz=5.0, quality=4, white_sd_m=(0.02, 0.04), lever_arm_m=lever)
    imu = Config.model_validate(CAR).imu
    simulate(replace(scenario, imu=imu, gnss=rtk), folder, 40 + request.param, SECONDS)
    return folder, np.array(lever)


def test_position_and_velocity_are_those_of_the_imu_and_say_how_well(drive: Any) -> None:
    folder: Path = drive[0]
    process(
        Config.model_validate(CAR),
        folder / "imu.csv",
        [("gnss", folder / "gnss.csv")],
        out=folder / "solution.csv",
    )
    solution, truth = read_solution(folder / "solution.csv"), read_truth(folder / "truth.csv")

    def true(values: Array) -> Array:
        return np.interp(solution.t_s, truth.t_s, values)

    lat = true(truth.lat_rad)
    north = (solution.lat_rad - lat) * meridian_radius(float(lat[0]))
    east = (solution.lon_rad - true(truth.lon_rad)) * np.cos(lat)
    east *= transverse_radius(float(lat[0]))
    down = true(truth.height_m) - solution.height_m
    place = np.column_stack([north, east, down]) / solution.sd_position
    velocity = solution.v - np.column_stack([true(v) for v in truth.v.T])
    assert np.abs(place).max() < 5.0
    assert np.abs(velocity / solution.sd_v).max() < 5.0
    low, high = interval(3, 0.999)
    assert low < float((place[-1] ** 2).sum()) < high
    # Bends have shown what is level; nothing shows how high the antenna is.
    assert solution.sd_position[-1, :2].max() < 0.15
    assert solution.sd_position[-1, 2] > 0.2


def test_a_drive_tells_where_the_antenna_is(drive: Any) -> None:
    folder, lever = drive
    settings = Config.model_validate(CAR)
    found = calibrate(settings, files(folder / "imu.csv", [("gnss", folder / "gnss.csv")]))
    section = tomllib.loads(found.toml)["aiding"]["gnss"]
    arm, sd = np.array(section["lever_arm_m"]), section["lever_arm_sd_m"]
    assert np.abs(arm - lever)[:2].max() < 0.2
    # One sigma for three axes: that of the height, whether the drive has shown it or not.
    assert np.abs(arm - lever).max() < 3.0 * sd
    assert sd > 0.2
