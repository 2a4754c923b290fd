"""Run a command where there is a SocketCAN bus, a loopback and ptys of its own.

Where the host's kernel has vcan, that is a new network namespace (`unshare`), which needs no
privilege and leaves the host's interfaces alone. Elsewhere it is a User Mode Linux guest that sees
the host's files (Debian package `user-mode-linux`). Both give `vcan0` and an empty loopback.

By hand: `.venv/bin/python -m tests.hil.uml COMMAND...`.
"""

from __future__ import annotations

import itertools
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
NETWORK = HERE / "network.sh"
GUEST_MEMORY_MIB = 2048
# What the guest takes over from the caller's environment; the rest is the host's own affair.
PASSED_ON = (
    *("FUSIOND_", "NUMBA_", "OPENBLAS_", "PYTEST_", "PYTHONPATH", "XDG_CACHE_HOME"),
    *("CI", "HOME", "LANG", "TERM", "VIRTUAL_ENV"),
)
_turns = itertools.count()
_SBIN = "/usr/local/sbin:/usr/sbin:/sbin"  # mosquitto, ip and insmod live there


class HarnessError(Exception):
    """The command's fate is unknown: no guest, no exit status, or no end in time."""


@dataclass(frozen=True)
class Result:
    """Exit status of the command and where it ran (`host` or `uml`)."""

    status: int
    where: str


def run_with_vcan(command: Sequence[str], timeout_s: float, output: TextIO) -> Result:
    """Run `command` in the repository with `vcan0` up; its output goes line by line to `output`.

    Raises HarnessError if the exit status could not be learned.
    """
    if host_has_vcan():
        return Result(_run_in_namespace(command, timeout_s, output), "host")
    return Result(run_in_uml(command, timeout_s, output), "uml")


def host_has_vcan() -> bool:
    """Whether a new network namespace of this kernel can have a vcan interface."""
    if shutil.which("unshare") is None:
        return False
    probe = subprocess.run(
        [*_namespace(), "true"], capture_output=True, env=_environment(), timeout=30, check=False
    )
    return probe.returncode == 0


def run_in_uml(
    command: Sequence[str],
    timeout_s: float,
    output: TextIO,
    systemd_keeps: Sequence[Path] | None = None,
) -> int:
    """Boot a guest, run `command` in it, power it off; the command's exit status.

    With `systemd_keeps` process 1 is systemd, on a root in memory: of the host it sees /usr, these
    folders and a copy of /etc, and can write nothing (`guest_systemd.sh`).
    """
    kernel = shutil.which("linux.uml")
    if kernel is None:
        raise HarnessError("no vcan in this kernel and no linux.uml: apt install user-mode-linux")
    job = Path(tempfile.mkdtemp(prefix="fusiond-hil-"))
    try:
        init = "guest_init.sh" if systemd_keeps is None else "guest_systemd.sh"
        _write_job(job, command, HERE / init)
        environment = _environment() | _preload(job)
        environment |= {"TMPDIR": str(_memory_folder(job)), "HOME": str(job)}  # HOME: for ~/.uml
        boot = [
            *_one_processor(),
            kernel,
            f"mem={GUEST_MEMORY_MIB}M",
            *("root=/dev/root", "rootfstype=hostfs", "rootflags=/"),
            "rw" if systemd_keeps is None else "ro",
            f"init={job / 'init'}",
            f"HIL_JOB={job}",
            f"HIL_KEEP={':'.join(map(str, systemd_keeps or ()))}",
            *("con=null", "con0=fd:0,fd:1", "quiet"),
        ]
        _stream(boot, timeout_s, output, environment)
        status = job / "status"
        if not status.exists():
            raise HarnessError("the guest ended without an exit status")
        return int(status.read_text())
    finally:
        shutil.rmtree(job, ignore_errors=True)


def _one_processor() -> list[str]:
    """Keeps a guest on one processor, the next guest on the next one.

    The guest's kernel and its processes take turns at each page fault and system call. On two
    processors each turn wakes one that idles, half a millisecond on a virtual machine: a guest
    that was alone on two took ten times as long to touch its memory, and its daemon fell behind.
    """
    ours = sorted(os.sched_getaffinity(0))
    return ["taskset", "--cpu-list", str(ours[next(_turns) % len(ours)])]


def _write_job(job: Path, command: Sequence[str], init: Path) -> None:
    (job / "tmp").mkdir()
    shutil.copy(init, job / "init")
    passed = {k: v for k, v in os.environ.items() if k.startswith(PASSED_ON)}
    passed |= {"TMPDIR": str(job / "tmp"), "PYTHONUNBUFFERED": "1"}
    lines = [f"export {key}={shlex.quote(value)}" for key, value in sorted(passed.items())]
    lines += [f"cd {shlex.quote(str(REPOSITORY))} || exit 125"]
    lines += [shlex.quote(str(HERE / "guest_modules.sh"))]
    lines += [shlex.join([str(NETWORK), *command])]
    (job / "job").write_text("\n".join(lines) + "\n")


def _memory_folder(job: Path) -> Path:
    """Where UML puts the file that is the guest's memory: a tmpfs, unless it is too small."""
    shm = Path("/dev/shm")
    roomy = shm.is_dir() and shutil.disk_usage(shm).free > GUEST_MEMORY_MIB << 20
    return shm if roomy else job


def _preload(job: Path) -> dict[str, str]:
    """Environment that lets UML run on processors with AMX; see `xstate.c`."""
    if "amx_tile" not in Path("/proc/cpuinfo").read_text():
        return {}
    compiler = shutil.which("cc")
    if compiler is None:
        raise HarnessError("this processor has AMX, UML needs xstate.c: apt install gcc libc6-dev")
    library = job / "xstate.so"
    build = [
        compiler,
        "-O2",
        "-Wall",
        "-shared",
        "-fPIC",
        "-o",
        str(library),
        str(HERE / "xstate.c"),
    ]
    subprocess.run(build, check=True, timeout=60)
    return {"LD_PRELOAD": str(library)}


def _namespace() -> list[str]:
    return ["unshare", "--map-root-user", "--net", str(NETWORK)]


def _run_in_namespace(command: Sequence[str], timeout_s: float, output: TextIO) -> int:
    return _stream([*_namespace(), *command], timeout_s, output, _environment())


def _environment() -> dict[str, str]:
    path = os.environ.get("PATH", "/usr/local/bin:/usr/bin:/bin")
    return {**os.environ, "PATH": f"{path}:{_SBIN}"}


def _stream(
    command: Sequence[str], timeout_s: float, output: TextIO, environment: Mapping[str, str]
) -> int:
    """Run in a session of its own, copy the output, kill the whole session when time is up."""
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=REPOSITORY,
        env=environment,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        late = threading.Event()

        def stop() -> None:
            late.set()
            os.killpg(process.pid, 9)

        timer = threading.Timer(timeout_s, stop)
        timer.start()
        try:
            assert process.stdout is not None
            for line in process.stdout:
                output.write(line)
                output.flush()
            status = process.wait()
        finally:
            timer.cancel()
            if process.poll() is None:
                os.killpg(process.pid, 9)
    if late.is_set():
        raise HarnessError(f"not finished after {timeout_s:g} s: killed")
    return status


if __name__ == "__main__":
    sys.exit(run_with_vcan(sys.argv[1:], timeout_s=3600.0, output=sys.stdout).status)
