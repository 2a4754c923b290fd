"""`fusiond calibrate`: a drive of which nothing is known but the sensor's nominal axes and class.

Of the real drive its recorder's own analysis says: -6.8 deg of pitch, 5.4 of yaw, stamps 0.125 s
late. The lines of TOML that come out must serve as a configuration: outages as good as with the
values typed in, also where the sensor is turned by another 5 deg about each axis.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.configuration.aiding import WheelAiding
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import sensor_to_body
from fusiond.files.measurement_csv import read_gnss, read_solution, read_truth
from fusiond.navigation.earth import meridian_radius, transverse_radius
from fusiond.navigation.rotation import dcm_from_rpy, rpy_from_dcm
from fusiond.offline.calibrate import Calibration, calibrate, files
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.places import DATA

DRIVE = DATA / "drive_0708"
IMU, GNSS = DRIVE / "imu.csv", DRIVE / "gnss.csv"
OUTAGES = [(243433.499 + 45.0 * i, 15.0) for i in range(8)]
KNOWN: dict[str, Any] = {
    "imu": {"axes": ["-x", "+y", "-z"], "sensor_class": "mems", "rate_hz": 100.0},
    "aiding": {"gnss": {}},
    "constraints": {"non_holonomic": {"enabled": True}},
    "alignment": {"heading": ["gnss_course"]},
}
TYPED: dict[str, Any] = {
    "imu": {"mounting_deg": [0.0, -6.8, 5.4], "time_offset_s": -0.125},
    "aiding": {"gnss": {"velocity_delay_s": 0.125, "lever_arm_m": [0.0, -0.05, 0.0]}},
    "constraints": {"non_holonomic": {"lever_arm_m": [-0.5, 0.0, 0.0]}},
}

recorded = pytest.mark.skipif(
    not DRIVE.is_dir(), reason=f"real drive drive_0708 is absent: {DRIVE} (set FUSIOND_DATA)"
)


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """The keys of both; those of `above` count."""
    both = dict(below)
    for key, value in above.items():
        both[key] = merged(both.get(key, {}), value) if isinstance(value, dict) else value
    return both


def outage_rms_m(settings: dict[str, Any], imu: Path, folder: Path) -> float:
    """RMS over the outages of the largest horizontal distance to the track in each."""
    out = folder / "solution.csv"
    process(Config.model_validate(settings), imu, [("gnss", GNSS)], OUTAGES, out)
    solution, track = read_solution(out), read_gnss(GNSS)
    largest = []
    for start, length in OUTAGES:
        rows = (track.t_s >= start) & (track.t_s < start + length)
        t, lat, lon = track.t_s[rows], track.lat_rad[rows], track.lon_rad[rows]
        here = float(lat[0])
        north = (np.interp(t, solution.t_s, solution.lat_rad) - lat) * meridian_radius(here)
        east = (np.interp(t, solution.t_s, solution.lon_rad) - lon) * transverse_radius(here)
        largest.append(float(np.hypot(north, east * math.cos(here)).max()))
    return math.sqrt(float(np.mean(np.square(largest))))


def turned(path: Path, rpy_deg: tuple[float, float, float]) -> Any:
    """The drive's IMU with its sensor turned; the matrix (3, 3) from old to new sensor axes."""
    turn = dcm_from_rpy(*(math.radians(angle) for angle in rpy_deg))
    header = IMU.open().readline().strip()
    rows = np.loadtxt(IMU, delimiter=",", skiprows=1)
    rows[:, 1:4], rows[:, 4:7] = rows[:, 1:4] @ turn.T, rows[:, 4:7] @ turn.T
    np.savetxt(path, rows, "%.9g", delimiter=",", header=header, comments="")
    return turn


@pytest.fixture(scope="module")
def typed_rms_m(tmp_path_factory: pytest.TempPathFactory) -> float:
    """The same of the values that its owner typed in."""
    return outage_rms_m(merged(KNOWN, TYPED), IMU, tmp_path_factory.mktemp("typed"))


class Calibrated(NamedTuple):
    """The drive's samples with the sensor turned, the turn (3, 3), and what was found of it."""

    imu: Path
    turn: Any
    found: Calibration


@pytest.fixture(scope="module")
def turned_drive(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[tuple[float, float, float]], Calibrated]:
    """The drive with its sensor turned, calibrated once for each turn."""

    @cache
    def made(rpy_deg: tuple[float, float, float]) -> Calibrated:
        imu = tmp_path_factory.mktemp("turned") / "imu.csv"
        turn = turned(imu, rpy_deg)
        found = calibrate(Config.model_validate(KNOWN), files(imu, [("gnss", GNSS)]))
        return Calibrated(imu, turn, found)

    return made


TURNS = pytest.mark.parametrize("rpy_deg", [(0.0, 0.0, 0.0), (5.0, 5.0, 5.0)])


@recorded
@TURNS
def test_a_drive_tells_how_its_sensor_is_mounted(
    rpy_deg: tuple[float, float, float],
    turned_drive: Callable[[tuple[float, float, float]], Calibrated],
) -> None:
    _, turn, found = turned_drive(rpy_deg)
    toml = tomllib.loads(found.toml)
    calibrated = merged(KNOWN, toml)

    right = sensor_to_body(Config.model_validate(merged(KNOWN, TYPED)).imu) @ turn.T
    wrong = sensor_to_body(Config.model_validate(calibrated).imu) @ right.T
    off_deg = [math.degrees(angle) for angle in rpy_from_dcm(wrong)]
    limit = 0.5 if rpy_deg == (0.0, 0.0, 0.0) else 1.0
    assert max(abs(angle) for angle in off_deg) < limit, off_deg
    assert toml["imu"]["time_offset_s"] == pytest.approx(-0.125, abs=0.05)
    settled = found.findings["mounting_yaw_deg"]
    assert settled.text.endswith("settled")


@recorded
@TURNS
def test_what_was_calibrated_bridges_outages_as_what_was_typed(
    rpy_deg: tuple[float, float, float],
    typed_rms_m: float,
    turned_drive: Callable[[tuple[float, float, float]], Calibrated],
    tmp_path: Path,
) -> None:
    imu, _, found = turned_drive(rpy_deg)
    calibrated = merged(KNOWN, tomllib.loads(found.toml))
    assert outage_rms_m(calibrated, imu, tmp_path) < 1.2 * typed_rms_m


# ------------------------------------------------------------------ a simulated drive

GNSS_LATE_S, WHEEL_OLD_S, SCALE, AXLE_M = 0.1, 0.15, 1.015, -1.0


def altered(path: Path, change: Callable[[Any, list[str]], None]) -> None:
    """Change the columns of a table in place."""
    with path.open() as stream:
        header = stream.readline().strip()
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    change(rows, header.split(","))
    text = [",".join("" if np.isnan(x) else f"{x:.12g}" for x in row) for row in rows]
    path.write_text("\n".join([header, *text]) + "\n")


def test_times_scale_and_axle_of_a_simulated_drive_are_found(tmp_path: Path) -> None:
    """Fixes are valid 0.1 s after their stamps; a wheel says 1.5 % too much and is 0.15 s old."""
    simulate(SCENARIOS["drive"], tmp_path, 2, 240.0)
    truth = read_truth(tmp_path / "truth.csv")
    t = np.arange(truth.t_s[0] + 1.0, truth.t_s[-1], 0.5)
    speed = np.interp(t - WHEEL_OLD_S, truth.t_s, np.hypot(*truth.v[:, :2].T)) * SCALE
    speed += 0.03 * np.random.default_rng(6).standard_normal(len(t))
    rows = [f"{a:.4f},{b:.4f},0.05" for a, b in zip(t, np.abs(speed), strict=True)]
    (tmp_path / "wheel.csv").write_text("\n".join(["t_s,speed_m_s,sd_m_s", *rows]) + "\n")

    def earlier(rows: Any, names: list[str]) -> None:
        rows[:, names.index("t_s")] -= GNSS_LATE_S

    altered(tmp_path / "gnss.csv", earlier)
    settings = {
        "imu": {"axes": ["+x", "-y", "-z"]},
        "aiding": {"gnss": {"lever_arm_m": [0.0, 0.0, -1.0], "bias_sd_m": 0.0}, "wheel": {}},
        "constraints": {"non_holonomic": {"enabled": True, "lever_arm_m": [0.0, 0.0, 0.5]}},
    }
    measurements = [("gnss", tmp_path / "gnss.csv"), ("wheel", tmp_path / "wheel.csv")]
    found = calibrate(Config.model_validate(settings), files(tmp_path / "imu.csv", measurements))
    imu, wheel = found.config.imu, found.config.aiding["wheel"]
    assert isinstance(wheel, WheelAiding)
    assert imu.time_offset_s == pytest.approx(-GNSS_LATE_S, abs=0.04)
    # By the IMU's own clock; that of the files is the receiver's now.
    assert wheel.latency_s + imu.time_offset_s == pytest.approx(WHEEL_OLD_S, abs=0.04)
    assert wheel.scale == pytest.approx(SCALE, abs=0.004)
    axle = found.findings["axle_lever_m"]
    assert axle.value == pytest.approx(AXLE_M, abs=max(0.2, 3.0 * axle.sd))
    assert tomllib.loads(found.toml)["aiding"]["wheel"]["scale"] == pytest.approx(
        wheel.scale, abs=1e-4
    )


# ------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive that has not come to its first bend."""
    folder = tmp_path_factory.mktemp("straight")
    simulate(SCENARIOS["drive"], folder, 1, 90.0)
    return folder


def command(folder: Path, settings: str, *more: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of the command."""
    path = folder / "vehicle.toml"
    path.write_text(settings)
    arguments = ["calibrate", str(path), "--imu", str(folder / "imu.csv")]
    arguments += ["--aid", f"gnss={folder / 'gnss.csv'}", *more]
    done = CliRunner().invoke(app, arguments)
    return done.exit_code, done.stdout, done.stderr


SIMULATED = """
[imu]
axes = ["+x", "-y", "-z"]
rate_hz = 100.0
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[constraints.non_holonomic]
enabled = true
"""


def test_what_a_short_drive_does_not_show_is_said(straight: Path) -> None:
    out, report = straight / "found.toml", straight / "found.json"
    code, text, _ = command(straight, SIMULATED, "--out", str(out), "--json", str(report))
    assert code == 0
    assert text == out.read_text()
    tomllib.loads(text)
    axle = json.loads(report.read_text())["parameters"]["axle_lever_m"]
    assert axle["state"] == "not_observed"
    assert axle["text"] in text
    assert "not observed: the drive has" in axle["text"]
    assert "bends" in axle["text"]


def test_a_configuration_that_estimates_nothing_is_told_how(straight: Path) -> None:
    settings = SIMULATED.replace("enabled = true", "enabled = false")
    settings = settings.replace("[aiding.gnss]", "[aiding.gnss]\ntime_offset_sd_s = 0.0")
    code, text, _ = command(straight, settings)
    assert code == 0
    assert "nothing to calibrate" in text
    assert "constraints.non_holonomic.enabled = true" in text
    assert not tomllib.loads(text)


def test_json_on_standard_output_is_json_alone(straight: Path) -> None:
    code, text, told = command(straight, SIMULATED, "--json", "-")
    assert code == 0
    assert json.loads(text)["toml"] == told
