"""Smoke test on aarch64, emulated: `make arm`, or `python -m tools.arm [import] [kernel] [drive]`.

| step | what |
|---|---|
| `import` | Debian's Python for arm64 imports the locked wheels for aarch64 |
| `kernel` | numba compiles a kernel and two that it calls, or links them: the bytes of here |
| `drive` | `fusiond process` over 10 s of driving writes the file that it writes here |

All three without an argument. `drive` compiles the kernels first, for ten minutes and more; what is
compiled stays in build/arm. Nothing of the host changes: Debian's packages are unpacked into
build/arm/root, with lists of their own, and run by `qemu-aarch64-static`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "build" / "arm"
ROOT, SITE, LISTS = FOLDER / "root", FOLDER / "site", FOLDER / "apt"
EMULATOR = "qemu-aarch64-static"
PYTHON = "python3.11"
"""Of Debian 12, for which all locked wheels exist."""
PACKAGES = (PYTHON, "libstdc++6")
"""The wheels bring all else."""
PLATFORMS = ("manylinux2014_aarch64", "manylinux_2_17_aarch64", "manylinux_2_28_aarch64")
SECONDS = 10
REST_S = 60
"""The scenario `drive` stands for that long first."""
KERNEL = """
import os, sys
os.environ["NUMBA_CACHE_DIR"] = sys.argv[1]
import numpy as np
from fusiond.navigation import kernel_cache
kernel_cache.CALLED_FROM = 1  # by their symbols, as a large kernel is
from fusiond.navigation.rotation import turn_to_dcm
dcm = np.empty((3, 3))
turn_to_dcm(0.1, -0.2, 2.5, dcm)
print(dcm.tobytes().hex())
"""
IMPORTS = """
import platform
import can, cantools, mcap, numba, numpy, pydantic, serial
assert platform.machine() == "aarch64", platform.machine()
assert numpy.linalg.solve(numpy.eye(3) * 2.0, numpy.ones(3)).tolist() == [0.5] * 3
print(platform.machine(), "numpy", numpy.__version__, "numba", numba.__version__)
"""


def prepare() -> None:
    """Python, libraries and fusiond for aarch64, once."""
    if (FOLDER / ".ready").exists():
        return
    for folder in (LISTS / "state/lists/partial", LISTS / "cache/archives/partial", ROOT):
        folder.mkdir(parents=True, exist_ok=True)
    (LISTS / "status").touch()
    options = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "Dir::State": LISTS / "state",
        "Dir::State::status": LISTS / "status",
        "Dir::Cache": LISTS / "cache",
        "Debug::NoLocking": "1",
    }
    apt = ["apt-get", "-q", "-y", *(f"-o{key}={value}" for key, value in options.items())]
    say(f"Debian's {PYTHON} for arm64")
    run([*apt, "update"], quiet=True)
    run([*apt, "install", "--download-only", "--no-install-recommends", *PACKAGES], quiet=True)
    for package in sorted((LISTS / "cache/archives").glob("*.deb")):
        run(["dpkg-deb", "--extract", str(package), str(ROOT)])
    say("the locked wheels for aarch64")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input"]
    into = ["install", "--quiet", "--no-compile", "--no-deps", "--target", str(SITE)]
    platforms = [word for name in PLATFORMS for word in ("--platform", name)]
    python = ["--python-version", "3.11", "--implementation", "cp", "--only-binary=:all:"]
    locked = ["--require-hashes", "-r", str(REPOSITORY / "requirements.lock")]
    run([*pip, *into, *platforms, *python, *locked])
    # Its metadata name the drivers; the code is the checkout's.
    run([*pip, *into, "--no-build-isolation", "--upgrade", str(REPOSITORY)])
    (FOLDER / ".ready").touch()


def emulated(arguments: list[str], text: str | None = None) -> str:
    """Output of Python on aarch64."""
    environment = {
        **os.environ,
        "QEMU_LD_PREFIX": str(ROOT),
        "PYTHONPATH": f"{REPOSITORY}{os.pathsep}{SITE}",
        "PYTHONHOME": str(ROOT / "usr"),
        "XDG_CACHE_HOME": str(FOLDER / "cache"),
        "OPENBLAS_NUM_THREADS": "1",
    }
    environment.pop("OPENBLAS_CORETYPE", None)  # one of this machine's processors
    command = [EMULATOR, str(ROOT / "usr/bin" / PYTHON), *arguments]
    return output(command, text, environment)


def output(command: list[str], text: str | None, environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        command,
        input=text,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=FOLDER,
        env=environment,
    )
    return done.stdout


def run(command: list[str], quiet: bool = False) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL if quiet else None)


def say(text: str) -> None:
    print(f"arm: {text}", flush=True)


def check_import() -> None:
    """The libraries are there and work."""
    say(emulated(["-c", IMPORTS]).strip())


def check_kernel() -> None:
    """Kernels that call each other give the same bits, compiled and linked from the cache."""
    cache = FOLDER / "kernel"
    shutil.rmtree(cache, ignore_errors=True)
    here = output([sys.executable, "-c", KERNEL, str(cache / "here")], None)
    for how in ("compiled", "from the cache"):
        there = emulated(["-c", KERNEL, str(cache / "there")])
        if here != there:
            sys.exit(f"arm: {how}, a kernel gives {there.strip()}, on this machine {here.strip()}")
        say(f"{how}, turn_to_dcm gives the same 72 bytes: {there.strip()[:16]}...")


def check_drive() -> None:
    """Ten seconds of driving give the same file."""
    drive = FOLDER / "drive"
    fusiond = ["-m", "fusiond"]
    simulate = ["simulate", "drive", "--duration", str(REST_S + SECONDS), "--seed", "1"]
    output([sys.executable, *fusiond, *simulate, "--out", str(drive)], None)
    config = str(REPOSITORY / "config" / "vehicle.toml")
    process = [*fusiond, "process", config, "--imu", str(drive / "imu.csv")]
    process += ["--aid", f"gnss={drive / 'gnss.csv'}", "--out"]
    here, there = drive / "here.csv", drive / "aarch64.csv"
    output([sys.executable, *process, str(here)], None)
    start_s = time.monotonic()
    emulated([*process, str(there)])
    taken_s = time.monotonic() - start_s
    if here.read_bytes() != there.read_bytes():
        sys.exit(f"arm: {there} is not {here}")
    say(f"{SECONDS} s of driving give the same {len(here.read_bytes())} bytes, in {taken_s:.0f} s")


CHECKS = {"import": check_import, "kernel": check_kernel, "drive": check_drive}


def main(names: list[str]) -> None:
    if unknown := set(names) - CHECKS.keys():
        sys.exit(f"no such step: {', '.join(sorted(unknown))}; there are {', '.join(CHECKS)}")
    prepare()
    for name in names or list(CHECKS):
        CHECKS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
