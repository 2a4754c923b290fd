"""Cost of `fusiond process` before its first row, in a new process with cached kernels.

The time spans the interpreter's start, imports, linking of kernels, reading of files and alignment
at rest, up to the first rows; the few hundred rows of the file take a hundredth of it.

Modules are loaded from bytecode, as in any installation after its first start: a first run, which
is not timed, fills a folder of the benchmark with it. An installation without bytecode where Python
may write none (`PYTHONDONTWRITEBYTECODE`, as in many containers) compiles some thousand modules at
each start, which takes longer than everything else.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS

DRIVE_S = 70.0
"""Length of the drive: `drive` moves off after a minute and is aligned four seconds later."""
CONFIG = """\
[imu]
rate_hz = 100.0
axes = ["+x", "-y", "-z"]
[aiding.gnss]
lever_arm_m = [0, 0, -1]
"""


def start(folder: Path) -> Callable[[], float]:
    """Processor time (s), user and system, of one run on files made in `folder`."""
    files = simulate(SCENARIOS["drive"], folder, duration_s=DRIVE_S).files
    config = folder / "start.toml"
    config.write_text(CONFIG)
    command = [sys.executable, "-m", "fusiond", "process", str(config), "--imu", str(files["imu"])]
    command += ["--aid", f"gnss={files['gnss']}", "--out", str(folder / "first_rows.csv")]
    environment = dict(os.environ, PYTHONPYCACHEPREFIX=str(folder / "bytecode"))
    environment.pop("PYTHONDONTWRITEBYTECODE", None)

    def timed() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime

    timed()
    return timed
