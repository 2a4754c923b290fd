"""The unit: systemd accepts it, and it says what the daemon counts on."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import REPOSITORY

UNIT = REPOSITORY / "systemd" / "fusiond.service"
PROGRAM = "/opt/fusiond/.venv/bin/fusiond"


def _settings(path: Path) -> dict[str, list[str]]:
    """Every key of a unit file with its values, in order."""
    settings: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if match := re.fullmatch(r"([A-Za-z]+)=(.*)", line):
            settings.setdefault(match[1], []).append(match[2])
    return settings


def _analyze(*arguments: str) -> None:
    run = subprocess.run(
        ["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "fusiond.service:" not in run.stderr, run.stderr  # warnings: unknown keys and the like


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with the path of a program that exists here, as `verify` demands."""
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text().replace(PROGRAM, sys.executable))
    return copy


def test_systemd_accepts_the_unit(unit: Path) -> None:
    _analyze("verify", "--man=no", str(unit))


def test_exposure_stays_low(unit: Path) -> None:
    # systemd's own scale from 0 to 100; below 20 it calls a service "OK" or better.
    _analyze("security", "--offline=yes", "--threshold=20", str(unit))


def test_a_mistake_in_the_configuration_is_not_restarted() -> None:
    settings = _settings(UNIT)
    assert settings["Restart"] == ["always"]
    assert settings["RestartPreventExitStatus"] == ["78"]
    assert "ExecStartPre" not in settings  # its exit status would not count for that


def test_the_daemon_is_notified_watched_and_never_given_up() -> None:
    settings = _settings(UNIT)
    assert settings["Type"] == ["notify"]
    assert 0 < float(settings["WatchdogSec"][0]) <= 10
    assert settings["StartLimitIntervalSec"] == ["0"]


def test_kernels_can_be_kept_and_may_run_and_what_compiles_them_may_step_back() -> None:
    settings = _settings(UNIT)
    assert settings["SystemCallFilter"][-1] == "setpriority"
    cache = next(v for v in settings["Environment"] if "NUMBA_CACHE_DIR=" in v)
    assert f"NUMBA_CACHE_DIR=/var/cache/{settings['CacheDirectory'][0]}/" in cache
    assert "MemoryDenyWriteExecute" not in settings  # see the unit


def test_devices_of_the_daemon_are_reachable() -> None:
    settings = _settings(UNIT)
    families = settings["RestrictAddressFamilies"][0].split()
    assert {"AF_CAN", "AF_INET", "AF_INET6", "AF_UNIX"} <= set(families)
    majors = {"char-4 rw", "char-166 rw", "char-188 rw", "char-204 rw"}  # ttyS, ACM, USB, AMA
    assert set(settings["DeviceAllow"]) == majors
    assert "dialout" in settings["SupplementaryGroups"]
    assert "PrivateDevices" not in settings  # would hide the serial ports
    assert "PrivateNetwork" not in settings  # would hide can0


def test_user_of_the_unit_is_made() -> None:
    user = _settings(UNIT)["User"][0]
    assert f"u     {user} " in (REPOSITORY / "systemd" / "sysusers-fusiond.conf").read_text()
