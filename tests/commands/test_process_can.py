"""`fusiond process --can`: a real bus from its raw frames, outages of named sources, mistakes."""

from __future__ import annotations

import gzip
import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.files.measurement_csv import read_gnss, read_solution
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.places import DATA, REPOSITORY
from tests.runs import metres_per_unit

CONFIG = REPOSITORY / "config" / "css_164.toml"
LOG = DATA / "css_164" / "can.log.gz"
RECORDER_S = 1_627_210_000
"""What the drive's tables count from."""
FROM_S, OUTAGE_S, UNTIL_S = RECORDER_S + 600, RECORDER_S + 645, RECORDER_S + 665

needs_drive = pytest.mark.skipif(
    not LOG.is_file(), reason=f"real drive css_164 is absent: {LOG} (set FUSIOND_DATA)"
)


def process(*arguments: str | Path) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    done = CliRunner().invoke(app, ["process", *map(str, arguments)])
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of the drive's bus, from its raw frames."""
    path = tmp_path_factory.mktemp("drive") / "part.log.gz"
    with gzip.open(LOG, "rt") as whole, gzip.open(path, "wt", compresslevel=1) as some:
        for line in whole:
            if FROM_S <= float(line[1 : line.index(")")]) < UNTIL_S:
                some.write(line)
    return path


def run(part: Path, folder: Path, *outage: str) -> tuple[dict[str, Any], Path]:
    out, report = folder / "solution.csv", folder / "report.json"
    code, text, errors = process(CONFIG, "--can", part, "--out", out, "--json", report, *outage)
    assert (code, errors) == (0, ""), text
    return json.loads(report.read_text()), out


def distance_m(solution: Path) -> float:
    """From the track's fix at the end of the part, horizontally."""
    table, track = read_solution(solution), read_gnss(DATA / "css_164" / "gnss.csv")
    t_s = UNTIL_S - 2.0
    north, east, _ = metres_per_unit(float(table.lat_rad[-1]), 100.0)
    here = [np.interp(t_s, table.t_s, x) for x in (table.lat_rad, table.lon_rad)]
    there = [np.interp(t_s - RECORDER_S, track.t_s, x) for x in (track.lat_rad, track.lon_rad)]
    return float(np.hypot((here[0] - there[0]) * north, (here[1] - there[1]) * east))


@needs_drive
def test_a_bus_from_its_raw_frames(part: Path, tmp_path: Path) -> None:
    report, out = run(part, tmp_path)
    assert report["files"]["imu"]["rows"] == pytest.approx(6580, abs=30)
    assert report["files"]["wheel"]["rows"] == 130
    gnss, wheel = report["sources"]["gnss"], report["sources"]["wheel"]
    # The first four epochs are needed to learn what belongs together.
    assert gnss["fused"] >= 45
    assert wheel["fused"] >= 90
    assert report["mode"] == "navigating"
    assert distance_m(out) < 8.0


@needs_drive
def test_frames_that_cannot_be_read_are_refused_rows(part: Path, tmp_path: Path) -> None:
    """Of the IMU and of the receiver, each as often as it came: one of the IMU's ended `process`
    with a division by zero."""
    whole, _ = run(part, tmp_path)
    left = {" 009#": 1, " 003#": 3}
    damaged = tmp_path / "damaged.log.gz"
    with gzip.open(part, "rt") as sound, gzip.open(damaged, "wt", compresslevel=1) as lines:
        for k, line in enumerate(sound):
            hit = next((frame for frame, n in left.items() if n and k > 3000 and frame in line), "")
            left.update({hit: left[hit] - 1} if hit else {})
            lines.write(f"{line.partition('#')[0]}#00\n" if hit else line)
    report, _ = run(damaged, tmp_path)
    for source, times in {"imu": 1, "gnss": 3}.items():
        now, before = report["files"][source], whole["files"][source]
        assert now["rejected"]["wrong_length"] == times
        assert f"wrong_length: {times} times" in now["first_rejected"]
        used = [file["rows"] - sum(file["rejected"].values()) for file in (before, now)]
        assert used[0] - used[1] == times
    assert report["solution_rows"] == pytest.approx(whole["solution_rows"], abs=1)
    assert " of 6" in process(CONFIG, "--can", damaged)[1]  # samples


@needs_drive
def test_an_outage_of_the_receiver_leaves_the_wheels(part: Path, tmp_path: Path) -> None:
    whole, _ = run(part, tmp_path)
    report, out = run(part, tmp_path, "--outage", f"{OUTAGE_S}:60:gnss")
    assert report["sources"]["gnss"]["withheld"] == pytest.approx(20, abs=1)
    assert "withheld" not in report["sources"]["wheel"]
    assert report["sources"]["wheel"] == whole["sources"]["wheel"]
    assert report["mode"] == "coasting"
    assert distance_m(out) < 30.0
    both, _ = run(part, tmp_path, "--outage", f"{OUTAGE_S}:60:gnss,wheel")
    every, _ = run(part, tmp_path, "--outage", f"{OUTAGE_S}:60")
    assert both["sources"] == every["sources"]
    assert both["sources"]["wheel"]["withheld"] == pytest.approx(40, abs=1)


@needs_drive
def test_an_outage_of_a_source_that_there_is_not(part: Path) -> None:
    code, _, errors = process(CONFIG, "--can", part, "--outage", f"{OUTAGE_S}:5:gps")
    assert code == 65
    assert errors.strip() == (
        "fusiond: outage of gps: no measurement comes from it; there are gnss, wheel"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "Give --imu or --can"),
        (("--imu", "i.csv", "--can", "c.log"), "--imu or --can"),
        (("--can", "c.log", "--outage", "5:1:gnss,,wheel"), "START:LENGTH in seconds"),
        (("--can", "c.log", "--outage", "5:0:gnss"), "START:LENGTH in seconds"),
        (("--can", "c.log", "--outage", "5:1:"), "START:LENGTH in seconds"),
    ],
)
def test_wrong_command_lines(arguments: tuple[str, ...], words: str) -> None:
    code, _, errors = process(CONFIG, *arguments)
    assert code == 2
    assert words in " ".join(errors.replace("│", " ").split())


def test_logs_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert process(CONFIG, "--can", tmp_path / "none.log")[0] == 74
    (tmp_path / "empty.log").write_text("")
    code, _, errors = process(CONFIG, "--can", tmp_path / "empty.log")
    assert (code, errors.strip()) == (65, f"fusiond: {tmp_path / 'empty.log'}: no CAN frame")
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "asammdf" else found(name)
    )
    (tmp_path / "bus.mf4").write_bytes(b"MDF")
    code, _, errors = process(CONFIG, "--can", tmp_path / "bus.mf4")
    assert (code, "pip install 'asammdf>=8'" in errors) == (69, True)


def test_a_bad_mapping_is_a_mistake_of_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text(CONFIG.read_text().replace("gnss_speed.Speed", "gnss_speed.Velocity", 1))
    code, _, errors = process(path, "--can", LOG)
    assert code == 78
    assert "sources.gnss" in errors
    assert "'Velocity' is no signal of gnss_speed" in errors


def test_an_outage_of_a_source_in_files(tmp_path: Path) -> None:
    simulate(SCENARIOS["drive"], tmp_path, 1, 100.0)
    files = ("--imu", tmp_path / "imu.csv", "--aid", f"gnss={tmp_path / 'gnss.csv'}")
    vehicle = REPOSITORY / "config" / "vehicle.toml"
    report = tmp_path / "report.json"
    rdss = ("--aid", f"rdss={tmp_path / 'rdss.csv'}")
    code, _, errors = process(vehicle, *files, *rdss, "--outage", "0:1000:rdss", "--json", report)
    assert (code, errors) == (0, "")
    sources = json.loads(report.read_text())["sources"]
    assert "withheld" not in sources["gnss"]
    assert sources["rdss"].keys() == {"withheld"}
