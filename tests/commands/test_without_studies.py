"""The daemon and `process` where scipy, PyWavelets and matplotlib are not installed: the extra
`[studies]` alone needs them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest

from tests.places import REPOSITORY

ABSENT = ("scipy", "pywt", "matplotlib")
# An interpreter imports this at its start; what finds packages then finds none of these.
BLOCKER = f"""
import sys

class Without:
    def __init__(self, finder):
        self._finder = finder

    def __getattr__(self, name):
        return getattr(self._finder, name)

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {ABSENT!r}:
            return None
        return self._finder.find_spec(name, path, target)

sys.meta_path[:] = map(Without, sys.meta_path)
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "blocked").mkdir()
    (tmp_path / "blocked" / "sitecustomize.py").write_text(BLOCKER)
    path = os.pathsep.join([str(tmp_path / "blocked"), str(REPOSITORY)])
    return os.environ | {"PYTHONPATH": path}


def _fusiond(
    environment: dict[str, str], *arguments: str | Path, status: int = 0
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "fusiond", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


def test_the_packages_are_really_absent(environment: dict[str, str]) -> None:
    for name in ABSENT:
        command = (sys.executable, "-c", f"import {name}")
        assert subprocess.run(command, env=environment, check=False).returncode == 1


def test_a_drive_is_simulated_processed_and_reported(
    environment: dict[str, str], tmp_path: Path
) -> None:
    drive = tmp_path / "drive"
    _fusiond(environment, "simulate", "drive", "--out", drive, "--duration", "90")
    measurements = [f"gnss={drive / 'gnss.csv'}", f"rdss={drive / 'rdss.csv'}"]
    solution = tmp_path / "solution.csv"
    _fusiond(
        environment,
        *("process", REPOSITORY / "config" / "vehicle.toml", "--imu", drive / "imu.csv"),
        *("--aid", measurements[0], "--aid", measurements[1], "--out", solution),
    )
    assert len(solution.read_text().splitlines()) > 100
    _fusiond(environment, "report", solution, "--out", tmp_path / "report.html")


def test_the_daemon_and_all_its_filters_but_one_are_there(environment: dict[str, str]) -> None:
    code = """
import sys
from pathlib import Path
import fusiond.live.daemon, fusiond.demo.demo, fusiond.doctor.doctor, fusiond.replay.replay_output
import fusiond.recording.log_metadata, fusiond.batch.batch
from fusiond.configuration.load import load_config
from fusiond.navigator.navigator import Navigator
config = load_config(Path("config/vehicle.toml"))
for name in ("kalman", "federated", "unscented"):
    estimator = config.estimator.model_copy(update={"filter": name})
    Navigator(config.model_copy(update={"estimator": estimator}))
print(fusiond.recording.log_metadata._versions().keys() >= {"numpy"})
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "True\n"


def test_commands_name_the_missing_extra(environment: dict[str, str], tmp_path: Path) -> None:
    for command in (("study", "rdss-static"), ("bench",)):
        done = _fusiond(environment, *command, status=69)
        for words in ("scipy", "pywt", "matplotlib", "-m pip", "'scipy>=1.11' 'PyWavelets>=1.5'"):
            assert words in done.stderr
    config = tmp_path / "multiscale.toml"
    shipped = (REPOSITORY / "config" / "vehicle.toml").read_text()
    chosen = re.sub(r"(?m)^\[estimator\]$", '[estimator]\nfilter = "multiscale"', shipped)
    assert chosen != shipped
    config.write_text(chosen)
    done = _fusiond(environment, "check", config, status=78)
    assert "estimator.filter" in done.stderr
    assert "PyWavelets" in done.stderr


def test_the_lock_of_vehicles_has_none_of_them() -> None:
    lock = (REPOSITORY / "requirements.lock").read_text()
    needed = [line for line in requires("fusiond") or [] if "extra" not in line]
    for name in ("scipy", "pywavelets", "matplotlib"):
        assert f"\n{name}==" not in lock
        assert not any(line.lower().startswith(name) for line in needed)
