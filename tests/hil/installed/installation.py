"""The commands of `systemd/README.md`, carried out as they stand.

Two lines cannot be: the guest has no network. What `apt-get` installs is on the host already; for
the locked dependencies those of the tests are put into the new environment, from the same lock.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.places import REPOSITORY

PREFIX = Path("/opt/fusiond/.venv")
PROGRAM = PREFIX / "bin" / "fusiond"
CACHE = Path("/var/cache/fusiond/numba")
CONFIG = Path("/etc/fusiond/vehicle.toml")
ENVIRONMENT = Path("/etc/fusiond/environment")
UNIT = "fusiond.service"
# Where the service may look, unlike a home folder: it has ProtectHome=yes.
PYTHON, PACKAGES = Path("/run/hil-python"), Path("/run/hil-packages")


def readme_blocks() -> list[list[str]]:
    """The commands of each block of the README, a line each."""
    text = (REPOSITORY / "systemd" / "README.md").read_text()
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    return [block.strip().splitlines() for block in blocks]


def carry_out(lines: list[str]) -> str:
    """Carry out each line by a shell, as root, in the checkout; return what they print.

    All must succeed. What they print is shown only if one does not.
    """
    printed = ""
    python = f"{PYTHON / 'bin'}:{os.environ['PATH']}"
    for line in lines:
        print(f"# {line}", flush=True)
        if line.startswith("apt-get "):
            continue
        if "--require-hashes" in line:
            _put_dependencies()
            continue
        run = subprocess.run(
            ["sh", "-ec", line],
            cwd=REPOSITORY,
            env={"PATH": python, "HOME": os.environ["HOME"], "PIP_NO_INDEX": "1"},
            check=False,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert run.returncode == 0, run.stdout + journal()
        printed += run.stdout
    return printed


def show_python() -> None:
    """Make the tests' Python and its packages visible to the service.

    A Python that was built with a shared library looks for it where it was installed. Where that
    is a home folder, the service would find another of that name, Debian's.
    """
    for source, target in ((sys.base_prefix, PYTHON), (sysconfig.get_path("purelib"), PACKAGES)):
        target.mkdir()
        subprocess.run(["mount", "--bind", source, target], check=True)
    ENVIRONMENT.parent.mkdir()
    ENVIRONMENT.write_text(f"LD_LIBRARY_PATH={PYTHON / 'lib'}\n")


def _packages() -> Path:
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return PREFIX / "lib" / version / "site-packages"


def _put_dependencies() -> None:
    for entry in PACKAGES.iterdir():
        if "fusiond" in entry.name or entry.suffix == ".pth":
            continue
        there = _packages() / entry.name
        if there.is_dir():
            shutil.rmtree(there)
        there.unlink(missing_ok=True)
        there.symlink_to(entry)


def put_kernels(compiled: Path) -> list[str]:
    """Hand the tests' compiled kernels to the service, as its first start would leave them.

    The folder is named by a digest of the sources, which the installed package shares. Returns the
    names of the files.
    """
    there = CACHE / compiled.name
    shutil.copytree(compiled, there)
    subprocess.run(["chown", "-R", "fusiond:fusiond", CACHE.parent], check=True)
    return sorted(path.name for path in there.iterdir())


def systemctl(*arguments: str) -> str:
    """Standard output of systemctl, which must succeed."""
    run = subprocess.run(["systemctl", *arguments], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr + journal()
    return run.stdout


def show(*properties: str) -> dict[str, str]:
    """Properties of the unit."""
    lines = systemctl("show", UNIT, *(f"--property={p}" for p in properties)).splitlines()
    return dict(line.split("=", 1) for line in lines)


def journal() -> str:
    """What the service manager and the daemon have written about the unit."""
    return subprocess.run(
        ["journalctl", "--no-pager", "-u", UNIT, "-o", "short-monotonic"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout
