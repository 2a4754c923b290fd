"""What the process says of itself."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from fusiond.live import process_usage
from fusiond.live.process_usage import ProcessUsage, release_start_memory


def test_process_usage() -> None:
    usage = ProcessUsage()
    sum(i * i for i in range(200_000))
    percent, resident_mb = usage.sample()
    assert 0.0 < percent <= 400.0
    assert resident_mb is not None
    assert 5.0 < resident_mb < 4000.0


@pytest.mark.parametrize("content", [None, "", "12", "a b c", "\xff"])
def test_a_figure_that_the_kernel_does_not_show_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None
) -> None:
    """As under `ProcSubset=pid` of systemd, or without /proc."""
    if content is not None:
        (tmp_path / "statm").write_text(content)
    monkeypatch.setattr(process_usage, "STATM", tmp_path / "statm")
    monkeypatch.setattr(process_usage, "SMAPS", tmp_path / "smaps")
    percent, resident_mb = ProcessUsage().sample()
    assert math.isfinite(percent)
    assert resident_mb is None
    release_start_memory()


def test_what_the_start_needed_is_given_back_and_still_works() -> None:
    """In a process of its own, since this one may have compiled anything. A kernel whose bitcode
    went is inlined into one that is compiled afterwards."""
    script = """
import numba
from fusiond.navigation.rotation import rotation_vector_to_quaternion as turned
from fusiond.live.process_usage import ProcessUsage, release_start_memory
turned(0.1, 0.2, 0.3)  # links it
before = ProcessUsage().sample()[1]
release_start_memory()
after = ProcessUsage().sample()[1]
assert after < before - 30.0, (before, after)
assert abs(turned(0.0, 0.0, 0.0)[0] - 1.0) < 1e-15
assert numba.njit(lambda x: x * 2.0 + 1.0)(3.0) == 7.0
assert numba.njit(lambda: turned(0.0, 0.0, 0.0)[0] + 1.0)() == 2.0
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)


def test_the_table_of_descriptors_never_grows_while_threads_wait() -> None:
    """`FDSize` of proc(5) is the size of the table; a process has 64 or 256 at its start."""
    script = """
import resource
from pathlib import Path
from fusiond.live.process_usage import widen_descriptor_table
resource.setrlimit(resource.RLIMIT_NOFILE, (1000, 1000))
widen_descriptor_table()
fields = dict(l.split(":", 1) for l in Path("/proc/self/status").read_text().splitlines())
assert int(fields["FDSize"]) >= 1000, fields["FDSize"]
assert len(list(Path("/proc/self/fd").iterdir())) < 20
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
