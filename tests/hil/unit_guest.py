"""The unit as `systemd/README.md` installs it, under systemd as process 1 of a guest.

By hand: `.venv/bin/python -m tests.hil.unit_guest`.
"""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path
from typing import TextIO

from tests.hil.uml import HERE, REPOSITORY, run_in_uml

_KERNELS = """
import fusiond.live.daemon, fusiond.simulation.live_devices
from fusiond.navigation.compiled import FOLDER
print(FOLDER)
"""


def run_unit(timeout_s: float, output: TextIO) -> int:
    """Run `tests/hil/installed` in such a guest; the exit status of pytest.

    Kernels are compiled here, where they are not yet: in the guest it takes three times as long.
    Raises HarnessError as `run_in_uml` does.
    """
    compiled = subprocess.run(
        [sys.executable, "-c", _KERNELS],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=timeout_s,
    )
    kernels = Path(compiled.stdout.strip())
    command = [
        *("env", f"FUSIOND_TEST_KERNELS={kernels}"),
        *(sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-v", "-s", "--durations=3"),
        str(HERE / "installed"),
    ]
    keeps = [REPOSITORY, kernels, Path(sys.prefix), Path(sys.base_prefix)]
    return run_in_uml(command, timeout_s, output, systemd_keeps=keeps)


if __name__ == "__main__":
    if platform.machine() != "x86_64":  # Debian has no User Mode Linux for others
        print("no guest on this machine: the unit is not tried under systemd")
        sys.exit(0)
    sys.exit(run_unit(3600.0, sys.stdout))
