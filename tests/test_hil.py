"""Hardware in the loop: the tests of `tests/hil/inside` with a real CAN bus, ptys and Mosquitto."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hil.uml import HarnessError, run_in_uml, run_with_vcan

INSIDE = Path(__file__).parent / "hil" / "inside"
# A guest that hangs must not hold the build; the suite takes a third of it.
TIMEOUT_S = 1200.0


def test_hardware_in_the_loop(capfd: pytest.CaptureFixture[str]) -> None:
    # What numba compiles is shared with the guest, where it takes three times as long.
    subprocess.run([sys.executable, "-c", "import fusiond.daemon"], check=True, timeout=TIMEOUT_S)
    command = [sys.executable, "-m", "pytest", str(INSIDE), "-p", "no:cacheprovider", "-v"]
    with capfd.disabled():  # the guest's report, as it is made
        print()
        result = run_with_vcan(command, TIMEOUT_S, sys.stdout)
    assert result.status == 0, f"failures in the report above (ran on: {result.where})"


def test_a_failure_inside_is_a_failure_outside() -> None:
    report = io.StringIO()
    result = run_with_vcan(["sh", "-c", "echo heard; exit 3"], 60.0, report)
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
        run_in_uml(["true"], 10.0, io.StringIO())
