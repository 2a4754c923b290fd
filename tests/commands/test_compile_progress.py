"""What is told while kernels compile: to a pipe, to systemd, on a terminal."""

from __future__ import annotations

import gc
import io
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fusiond.commands.compile_progress import Progress, compiling
from fusiond.commands.shared import COLLECT_AFTER
from tests.patience import PATIENCE_S

KERNELS = """
from fusiond.navigation.compiled import compiled

@compiled("f8(f8)")
def halved(x):
    return 0.5 * x

@compiled("f8(f8)")
def quartered(x):
    return 0.5 * halved(x)

USED = quartered(1.0)

@compiled("f8(f8)")
def doubled(x):
    return 2.0 * x

def times(width):
    @compiled("f8(f8)", variant=width)
    def by_width(x):
        return width * x
    return by_width

TIMES = {width: times(width) for width in (20, 40)}
"""
CODE = """
import sys
from fusiond.commands.compile_progress import compiling
with compiling() as widths:
    import kernels
    widths.add(20)
    print("imported", file=sys.stderr)
print(kernels.USED, kernels.quartered(8.0), kernels.doubled(8.0), kernels.TIMES[20](2.0))
"""


def test_a_pipe_and_systemd_hear_how_far_it_is(tmp_path: Path) -> None:
    """All kernels are known before the first one compiles, but for one that an import calls; of
    those that one piece of source makes, that which is needed alone is compiled."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        done = subprocess.run(
            [sys.executable, "-c", CODE],
            env=os.environ
            | {
                "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
                "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
                "NOTIFY_SOCKET": str(tmp_path / "notify"),
            },
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
        manager.setblocking(False)
        told = [manager.recv(256).decode() for _ in range(5)]
    assert done.stdout == "0.25 2.0 16.0 40.0\n"
    first, second, *_, last = done.stderr.splitlines()
    assert (first, second) == ("imported", "compiling 0/4 kernels, once")
    assert re.fullmatch(r"compiled 4 kernels in \d+ s", last)
    assert told == [f"STATUS=compiling {n}/4 kernels, once" for n in range(5)]
    assert len(list((tmp_path / "cache").rglob("*.kernel"))) == 4


def test_uncacheable_kernels_are_compiled_here_and_reported(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    (tmp_path / "cache").write_text("no folder")
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        env=os.environ
        | {
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
            "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
        },
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    assert done.stdout == "0.25 2.0 16.0 40.0\n"
    assert "compiled 4 kernels in" in done.stderr.splitlines()[-1]


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("term", "written"),
    [
        (
            "xterm",
            "\rcompiling 0/2 kernels, once\x1b[K\rcompiling 1/2 kernels, once\x1b[K"
            "\rcompiled 2 kernels in 0 s\x1b[K\n",
        ),
        ("dumb", "compiling 0/2 kernels, once\ncompiled 2 kernels in 0 s\n"),
    ],
)
def test_a_terminal_has_one_line_and_a_dumb_one_lines(
    monkeypatch: pytest.MonkeyPatch, term: str, written: str
) -> None:
    monkeypatch.setenv("TERM", term)
    monkeypatch.setattr("fusiond.commands.compile_progress.time.monotonic", lambda: 100.0)
    out = _Terminal()
    told = Progress(out)
    for done in range(3):
        told(done, 2)
    assert out.getvalue() == written


def test_loaded_objects_are_exempt_from_collection() -> None:
    before = gc.get_threshold()
    gc.unfreeze()
    try:
        with compiling():
            gc.set_threshold(1_000_000)  # as while a command loads its code
        assert gc.get_threshold()[0] == COLLECT_AFTER
        assert gc.get_freeze_count() > COLLECT_AFTER
    finally:
        gc.unfreeze()
        gc.set_threshold(*before)
