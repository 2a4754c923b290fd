"""Kernels compiled for a level of processors, to be shipped: nothing to compile on the target.

    python -m tools.prebuilt [--package FOLDER]

They go to `navigation/prebuilt` of the package `fusiond` in FOLDER (this checkout's by default), a
folder a level of this machine's architecture, under the digest of the sources. Each level is
compiled by an interpreter of its own, told by numba's settings which processor to compile for, with
no feature besides; a processor that has more runs it. `make deb` does it for the Debian package.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import fusiond
from fusiond.navigation.shipped_kernels import LEVELS

# What `run`, `process`, `simulate` and the filters import, `studies` left to whoever runs them.
MODULES = (
    "fusiond.live.daemon",
    "fusiond.offline.process",
    "fusiond.simulation.live_devices",
    "fusiond.navigator.raw_gnss",
    "fusiond.navigator.protection_levels",
    "fusiond.estimators.federated.no_reset",
    "fusiond.estimators.federated.reset",
    "fusiond.estimators.unscented.filter",
)
COMPILE = f"""
import sys
from fusiond.commands.compile_progress import compiling
with compiling():
    import {", ".join(MODULES)}
from fusiond.navigation.compiled import FOLDER
print(FOLDER)
"""


def build(package: Path, python: Path | str = sys.executable) -> list[Path]:
    """Compile the kernels of the package `fusiond` at `package` with its interpreter; the folders
    that were written."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    target = package / "navigation" / "prebuilt"
    shutil.rmtree(target, ignore_errors=True)
    written = []
    with tempfile.TemporaryDirectory(prefix="fusiond-kernels-") as work:
        made = {}
        for level in LEVELS[platform.machine()]:
            settings = {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ""}
            done = subprocess.run(
                (python, "-c", COMPILE),
                cwd=package.parent,  # the package there is the one that is imported
                env={**environment, **settings, "NUMBA_CACHE_DIR": f"{work}/{level}"},
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            made[level] = Path(done.stdout.strip())
        for level, folder in made.items():  # once all are there: a level would find the other's
            written.append(target / folder.name / level)
            shutil.copytree(folder, written[-1])
    return written


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--package", type=Path, default=Path(fusiond.__file__).parents[1])
    for folder in build(parser.parse_args().package.resolve() / "fusiond"):
        size = sum(file.stat().st_size for file in folder.iterdir())
        print(f"{folder}: {len(list(folder.iterdir()))} kernels, {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
