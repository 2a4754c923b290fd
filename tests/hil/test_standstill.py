"""What fails while a guest stands still is told from what fails, and only that is run again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TextIO

import pytest

from tests.hil import test_hil
from tests.hil.standstill import FAILURES, STANDSTILL_S
from tests.hil.uml import Result
from tests.places import REPOSITORY

STOPPED = f"""
import os, signal, subprocess
def stop():
    again = f"sleep {4 * STANDSTILL_S}; kill -CONT {{os.getpid()}}"
    subprocess.Popen(["sh", "-c", again])
    os.kill(os.getpid(), signal.SIGSTOP)
"""
NEVER = "import tests.hil.inside.conftest as c; c.STANDSTILL_S = 1e9"


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        (f"{STOPPED}\ndef test_it(): stop(); assert False", "void"),
        (f"{NEVER}\ndef test_it(): assert False", "failed"),
        (f"{NEVER}\ndef test_it(no_such_fixture): pass", "failed"),
        (f"{STOPPED}\ndef test_it(): stop()", None),
    ],
)
def test_a_failure_is_noted(tmp_path: Path, lines: str, word: str | None) -> None:
    (tmp_path / "test_one.py").write_text(lines)
    notes = tmp_path / "notes"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    ended = subprocess.run(
        [*command, "-p", "tests.hil.inside.conftest", "--rootdir", tmp_path, tmp_path],
        cwd=REPOSITORY,
        env={**os.environ, FAILURES: str(notes), "PYTHONPATH": str(REPOSITORY)},
        check=False,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == (1 if word else 0), ended.stdout
    told = [f"{word} test_one.py::test_it"] if word else []
    assert (notes.read_text().splitlines() if notes.exists() else []) == told
    assert ("stood still" in ended.stdout) == bool(word)


@pytest.mark.parametrize(
    ("told", "status", "runs"),
    [
        ([["void a::b", "void a::c"], []], 0, [["a"], ["a::b", "a::c"]]),
        ([["void a::b", "failed a::c"]], 1, [["a"]]),
        ([[]], 1, [["a"]]),
        ([["void a::b"]] * test_hil.RUNS, 1, [["a"], ["a::b"], ["a::b"]]),
    ],
)
def test_what_is_void_is_run_again(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    told: list[list[str]],
    status: int,
    runs: list[list[str]],
) -> None:
    seen: list[list[str]] = []

    def guest(command: list[str], timeout_s: float, output: TextIO) -> Result:
        tests = command[command.index("--durations=3") + 1 :]
        lines = told[len(seen)]
        seen.append(tests)
        Path(command[1].removeprefix(f"{FAILURES}=")).write_text("\n".join(lines))
        return Result(1 if lines or status else 0, "uml")

    monkeypatch.setattr(test_hil, "run_with_vcan", guest)
    assert test_hil.run_group("1| ", ["a"], tmp_path / "notes").status == status
    assert seen == runs
