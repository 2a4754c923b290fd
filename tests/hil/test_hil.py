"""Hardware in the loop: the tests of `tests/hil/inside` with a real CAN bus, ptys and Mosquitto."""

from __future__ import annotations

import io
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.hil.logs import HANDED_OVER, check
from tests.hil.standstill import FAILURES
from tests.hil.uml import HarnessError, Result, run_in_uml, run_with_vcan

INSIDE = Path(__file__).parent / "inside"
GROUPS = (
    ("test_bench.py", "test_daemon.py", "test_daemon_can_log.py", "test_daemon_estimators.py"),
    ("test_daemon_drive.py", "test_daemon_raw.py", "test_daemon_rdss.py"),
)
"""Each group has a guest of its own, side by side on two cores; about equally long."""
RUNS = 3
"""Of a test whose guest stood still each time that it failed."""
TESTS_FAILED = 1
"""Exit status of pytest."""
TIMEOUT_S = 3600.0
"""A guest that hangs must not hold the build; the suite takes some minutes on two quiet cores."""


def test_hardware_in_the_loop(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = tmp_path / "logs"
    monkeypatch.setenv(HANDED_OVER, str(logs))
    # What numba compiles is shared with the guests, where it takes three times as long.
    filters = ("federated.no_reset", "multiscale.filter", "unscented.filter")
    modules = ["fusiond.live.daemon", *(f"fusiond.estimators.{name}" for name in filters)]
    subprocess.run(
        [sys.executable, "-c", f"import {', '.join(modules)}"], check=True, timeout=TIMEOUT_S
    )
    assert sorted(name for group in GROUPS for name in group) == sorted(
        path.name for path in INSIDE.glob("test_*.py")
    )
    with capfd.disabled(), ThreadPoolExecutor() as guests:  # the guests' reports, as they are made
        print()
        files = [[str(INSIDE / name) for name in group] for group in GROUPS]
        failures = [tmp_path / f"failures-{k + 1}" for k in range(len(GROUPS))]
        runs = [
            guests.submit(run_group, f"{k + 1}| ", tests, failures[k])
            for k, tests in enumerate(files)
        ]
        results = [run.result() for run in runs]
    for result, notes in zip(results, failures, strict=True):
        told = notes.read_text().split("\n") if notes.exists() else []
        assert result.status == 0, f"on {result.where}, the report is above: {told}"
    check(logs)


def run_group(mark: str, tests: list[str], failures: Path) -> Result:
    """The tests where there is a bus of its own; their report with a mark each line.

    Those that failed while the guest stood still are run again, in a guest of their own."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-v", "--durations=3"]
    for _ in range(RUNS):
        failures.unlink(missing_ok=True)
        noting = ["env", f"{FAILURES}={failures}", *command]
        result = run_with_vcan([*noting, *tests], TIMEOUT_S, Marked(mark))
        notes = failures.read_text().splitlines() if failures.exists() else []
        tests = [note.removeprefix("void ") for note in notes if note.startswith("void ")]
        if result.status != TESTS_FAILED or not tests or len(tests) < len(notes):
            break
    return result


class Marked(io.StringIO):
    """Standard output, where two guests write in turns, a line each."""

    def __init__(self, mark: str) -> None:
        super().__init__()
        self._mark = mark

    def write(self, text: str) -> int:
        sys.stdout.write(self._mark + text)
        sys.stdout.flush()
        return len(text)


def test_a_failure_inside_is_a_failure_outside() -> None:
    report = io.StringIO()
    result = run_with_vcan(["sh", "-c", "echo heard; exit 3"], TIMEOUT_S, report)
    assert result.status == 3
    assert "heard" in report.getvalue()


def test_a_run_that_does_not_end_is_an_error() -> None:
    with pytest.raises(HarnessError, match="killed"):
        run_with_vcan(["sleep", "1000"], 3.0, io.StringIO())


def test_a_guest_without_a_status_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "shutil.which", lambda program: f"/bin/{program.replace('linux.uml', 'true')}"
    )
    with pytest.raises(HarnessError, match="without an exit status"):
        run_in_uml(["true"], TIMEOUT_S, io.StringIO())
