"""Commands that compile kernels, each started as a user starts it, with a cache of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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


def start(command: str, folder: Path, cache: Path | None) -> list[str]:
    """Run a command in `folder`, with the tests' own cache if none; the lines that it wrote."""
    folder.mkdir(exist_ok=True)
    (folder / "C.toml").write_text(CONFIG)
    own = {} if cache is None else {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-m", "fusiond", *COMMANDS[command]],
        env=os.environ | own,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=1800,  # only bounds a run that hangs; four minutes of compiling were seen
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.returncode} {done.stderr}"
    assert "compiled anew" not in done.stderr
    lines = [line for name in RESULTS[command] for line in (folder / name).read_text().splitlines()]
    return [line for line in lines if "time_per_step_us" not in line]  # what a study took
