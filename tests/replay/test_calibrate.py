"""`fusiond calibrate` of the daemon's own recording: the demo's drive, kept in the repository."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.navigator.navigator import Navigator
from fusiond.recording.reader import Log
from fusiond.replay.replay_config import replay_config
from fusiond.replay.replay_for_calibration import replay_for_calibration
from fusiond.simulation.can.imu import SIM_IMU
from tests.live.daemon_bench import RDSS, imu_section
from tests.places import REPOSITORY

DEMO = REPOSITORY / "tests" / "golden" / "demo.mcap"
CONFIG = f"""
vehicle = "demo"
[imu]
axes = ["+x", "-y", "-z"]
sensor_class = "mems"
{imu_section(SIM_IMU)}
[sources.gnss]
driver = "nmea"
port = "gnss"
[constraints.non_holonomic]
enabled = true
{RDSS}
"""


def _called(tmp_path: Path, *arguments: str) -> Any:
    config = tmp_path / "car.toml"
    config.write_text(CONFIG)
    return CliRunner().invoke(app, ["calibrate", str(config), *arguments])


def test_a_recording_gives_lines_of_toml(tmp_path: Path) -> None:
    out, told = tmp_path / "found.toml", tmp_path / "found.json"
    done = _called(tmp_path, str(DEMO), "--out", str(out), "--json", str(told))
    assert done.exit_code == 0, done.output
    assert tomllib.loads(out.read_text())
    said = json.loads(told.read_text())
    assert said["process"]["solution_rows"] > 200
    assert said["process"]["driver_faults"] == []
    assert {"mounting_pitch_deg", "gnss_time_s"} <= said["parameters"].keys()


def test_a_recording_without_the_configured_imu_says_so() -> None:
    config = REPOSITORY / "config" / "vehicle.toml"
    done = CliRunner().invoke(app, ["calibrate", str(config), str(DEMO)])
    assert (done.exit_code, done.stdout) == (65, "")
    assert "Nothing to calibrate by: Waiting for IMU data" in " ".join(done.stderr.split())


def test_a_drive_is_either_a_recording_or_files(tmp_path: Path) -> None:
    for arguments in ([], [str(DEMO), "--imu", "imu.csv"], [str(DEMO), "--aid", "gnss=gnss.csv"]):
        done = _called(tmp_path, *arguments)
        assert done.exit_code == 2
        assert "Give LOG.mcap alone" in " ".join(done.stderr.split())


def test_a_file_that_is_no_recording_is_reported(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_text("no log")
    assert _called(tmp_path, str(other)).exit_code == 65


def test_saved_calibration_of_the_daemon_is_ignored(tmp_path: Path) -> None:
    """Each pass begins without alignment, and is seen to the end."""
    recording = Log([DEMO])
    config = replay_config(recording.about, tmp_path)
    started: list[bool] = []

    def look(navigator: Navigator) -> None:
        started.append(navigator.started is not None)
        if started[-1]:  # what roll, noise and the time driven are taken from
            passed = navigator.estimator.sample - navigator.imu.start
            assert np.isfinite(navigator.imu.nav[passed - 1]).all()

    replay_for_calibration(recording, config, look)
    assert (started[0], started[-1]) == (False, True)
