"""`fusiond process` says what it navigated, and in one sentence why nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.places import REPOSITORY

SECONDS = 130.0  # the first bend is over
GRAVITY_M_S2 = 9.80665
Table = tuple[list[str], Any]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    simulate(SCENARIOS["drive"], folder, 1, SECONDS)
    return folder


def changed(drive: Path, name: str, change: Callable[[Any, list[str]], Any], to: Path) -> Path:
    """A file of the drive with its rows (n, columns) changed."""
    with (drive / name).open() as stream:
        header = stream.readline().strip()
    rows = np.genfromtxt(drive / name, delimiter=",", skip_header=1)
    path = to / name
    text = change(rows, header.split(","))
    np.savetxt(path, text, "%.10g", delimiter=",", header=header, comments="")
    return path


def process(imu: Path, *measurements: str, out: Path) -> tuple[int, str, str, dict[str, Any]]:
    """Exit code, standard output, standard error, JSON."""
    report = out / "report.json"
    arguments = ["process", str(REPOSITORY / "config" / "vehicle.toml"), "--imu", str(imu)]
    for measurement in measurements:
        arguments += ["--aid", measurement]
    arguments += ["--json", str(report), "--out", str(out / "solution.csv")]
    done = CliRunner().invoke(app, arguments)
    return done.exit_code, done.stdout, done.stderr, json.loads(report.read_text())


def refused(imu: Path, *measurements: str, out: Path) -> str:
    """The reason of a run that navigates nothing: the same in text and JSON."""
    code, _, text, report = process(imu, *measurements, out=out)
    assert code == 65
    assert report["solution_rows"] == 0
    assert text.strip() == f"fusiond: No solution: {report['why']}"
    return str(report["why"])


def test_a_good_run_says_when_it_aligned_and_how_much_it_navigated(
    drive: Path, tmp_path: Path
) -> None:
    """One measurement is as a spreadsheet left it, another of another day."""

    def a_day_later(rows: Any, names: list[str]) -> Any:
        for k in (k for k, n in enumerate(names) if n.startswith("t_")):
            rows[:, k] += 86_400.0
        return rows

    rdss = changed(drive, "rdss.csv", a_day_later, tmp_path)
    gnss = tmp_path / "gnss.csv"
    gnss.write_text((drive / "gnss.csv").read_text().replace(",", ";").replace(".", ","))
    code, text, errors, report = process(
        drive / "imu.csv", f"gnss={gnss}", f"rdss={rdss}", out=tmp_path
    )
    assert (code, errors, report["why"]) == (0, "", None)
    first_s, rows = report["solution_from_s"], report["solution_rows"]
    assert 0.0 < first_s < SECONDS
    assert sum(report["solution_modes"].values()) == rows
    assert report["solution_modes"]["navigating"] > 0.9 * rows
    assert f"aligned at {first_s:.3f} s: GNSS course" in text.splitlines()
    samples = report["files"]["imu"]["rows"]
    assert f"solution: {rows} of {samples} samples: " in text
    (line,) = report["apart"]
    assert line.startswith("rdss from 864")
    assert "no time in common with imu, from 0." in line
    assert f"! {line}" in text.splitlines()
    begin = float((tmp_path / "solution.csv").read_text().splitlines()[1].split(",")[0])
    assert begin == pytest.approx(first_s, abs=1e-6)


def test_accelerations_in_g_are_refused(drive: Path, tmp_path: Path) -> None:
    def in_g(rows: Any, names: list[str]) -> Any:
        rows[:, [n.startswith("accel") for n in names]] /= GRAVITY_M_S2
        return rows

    why = refused(
        changed(drive, "imu.csv", in_g, tmp_path), f"gnss={drive / 'gnss.csv'}", out=tmp_path
    )
    assert "it looks like g; multiply the accelerometer's figures by 9.80665" in why
    assert not (tmp_path / "solution.csv").exists()


def test_rates_in_deg_s_are_refused(drive: Path, tmp_path: Path) -> None:
    def in_degrees(rows: Any, names: list[str]) -> Any:
        rows[:, [n.startswith("gyro") for n in names]] *= 180.0 / np.pi
        return rows

    imu = changed(drive, "imu.csv", in_degrees, tmp_path)
    why = refused(imu, f"gnss={drive / 'gnss.csv'}", out=tmp_path)
    factor = int(why.split("Rates are ")[1].split(" times")[0])
    assert 40 <= factor <= 65  # 57, less what the course's noise takes off
    assert "they look like deg/s; multiply the gyro's figures by pi/180" in why


def test_rates_that_nothing_turns_with_need_no_fixes(drive: Path, tmp_path: Path) -> None:
    """A carousel of 12 deg/s, in deg/s."""

    def carousel(rows: Any, names: list[str]) -> Any:
        rows[:, names.index("gyro_z_rad_s")] += 12.0
        return rows

    why = refused(changed(drive, "imu.csv", carousel, tmp_path), out=tmp_path)
    assert why.startswith("Rates of 12 rad/s RMS exceed a vehicle's: they look like")


@pytest.mark.parametrize("name", ["imu.csv", "gnss.csv"])
def test_times_that_run_backwards(drive: Path, tmp_path: Path, name: str) -> None:
    def reversed_times(rows: Any, names: list[str]) -> Any:
        rows[:, 0] = rows[::-1, 0]
        for k in (k for k, n in enumerate(names) if n == "t_arrival_s"):
            rows[:, k] = rows[:, 0] + 0.1
        return rows

    path = changed(drive, name, reversed_times, tmp_path)
    imu = path if name == "imu.csv" else drive / "imu.csv"
    gnss = path if name == "gnss.csv" else drive / "gnss.csv"
    why = refused(imu, f"gnss={gnss}", out=tmp_path)
    assert why.startswith(f"{name[:-4]}: its times run backwards in ")


def test_times_on_another_base(drive: Path, tmp_path: Path) -> None:
    def of_week(rows: Any, names: list[str]) -> Any:
        for k in (k for k, n in enumerate(names) if n in {"t_s", "t_arrival_s"}):
            rows[:, k] += 243_000.0
        return rows

    gnss = changed(drive, "gnss.csv", of_week, tmp_path)
    why = refused(drive / "imu.csv", f"gnss={gnss}", out=tmp_path)
    assert why.startswith("No time in common: imu from 0.")
    assert "gnss from 24300" in why


def test_no_measurement_at_all(drive: Path, tmp_path: Path) -> None:
    why = refused(drive / "imu.csv", out=tmp_path)
    assert why == "No measurements: give --aid KIND=FILE (Waiting for a first position fix)"


def test_measurements_that_are_all_refused_are_named(drive: Path, tmp_path: Path) -> None:
    def fast(rows: Any, names: list[str]) -> Any:
        rows[:, names.index("v_n_m_s")] = 1_000.0
        return rows

    gnss = changed(drive, "gnss.csv", fast, tmp_path)
    why = refused(drive / "imu.csv", f"gnss={gnss}", out=tmp_path)
    assert why.startswith("Waiting for a first position fix (")
    assert "of gnss speed_implausible" in why
