"""Commands that compile kernels, each started as a user starts it, with a cache of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

from fusiond.commands.app import app

CONFIG = """
[imu]
axes = ["+x", "-y", "-z"]
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[constraints.non_holonomic]
enabled = true
lever_arm_m = [-1.0, 0.0, 0.5]
[estimator]
model = "ins21"
[alignment]
heading = ["config"]
heading_deg = 40.0
"""
COMMANDS = {
    "simulate": ("simulate", "drive", "--duration", "30", "--out", "drive"),
    "study": ("study", "rdss-static", "--runs", "2", "--json", "study.json"),
    "model": ("model", "ins21", "--config", "C.toml", "--json", "model.json"),
    "check": ("check", "--compile", "C.toml"),
    "process": (
        *("process", "C.toml", "--imu", "drive/imu.csv", "--aid", "gnss=drive/gnss.csv"),
        *("--out", "solution.csv"),
    ),
    "calibrate": (
        *("calibrate", "C.toml", "--imu", "drive/imu.csv", "--aid", "gnss=drive/gnss.csv"),
        *("--out", "found.toml"),
    ),
    "demo": ("demo", "--duration", "3", "--headless"),
}
RESULTS = {
    "simulate": ("drive/imu.csv", "drive/gnss.csv"),
    "study": ("study.json",),
    "model": ("model.json",),
    "check": (),
    "process": ("solution.csv",),
    "calibrate": ("found.toml",),
    "demo": (),
}


def start(command: str, folder: Path, cache: Path) -> list[str]:
    """Run a command in `folder` with the kernels of `cache`; the lines that it wrote."""
    folder.mkdir(exist_ok=True)
    (folder / "C.toml").write_text(CONFIG)
    done = subprocess.run(
        [sys.executable, "-m", "fusiond", *COMMANDS[command]],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=1800,  # only bounds a run that hangs; four minutes of compiling were seen
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.returncode} {done.stderr}"
    assert "compiled anew" not in done.stderr
    return written(command, folder)


def run_here(command: str, folder: Path) -> list[str]:
    """The same in this process, which keeps what it has loaded for the next command."""
    (folder / "C.toml").write_text(CONFIG)
    with contextlib.chdir(folder):
        done = CliRunner().invoke(app, COMMANDS[command])
    assert done.exit_code == 0, f"{command}: {done.exit_code} {done.stderr} {done.exception!r}"
    return written(command, folder)


def written(command: str, folder: Path) -> list[str]:
    """The lines of a command's results."""
    lines = [line for name in RESULTS[command] for line in (folder / name).read_text().splitlines()]
    return [line for line in lines if "time_per_step_us" not in line]  # what a study took
