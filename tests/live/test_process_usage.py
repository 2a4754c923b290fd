"""What the process says of itself."""

from __future__ import annotations

import subprocess
import sys

from fusiond.live.process_usage import ProcessUsage


def test_process_usage() -> None:
    usage = ProcessUsage()
    sum(i * i for i in range(200_000))
    percent, resident_mb = usage.sample()
    assert 0.0 < percent <= 400.0
    assert 5.0 < resident_mb < 4000.0


def test_the_compiler_gives_its_pages_back_and_still_works() -> None:
    """In a process of its own, since this one may have compiled anything."""
    script = """
import numba
from fusiond.navigation.rotation import quaternion_from_rpy
from fusiond.live.process_usage import ProcessUsage, release_compiler_pages
before = ProcessUsage().sample()[1]
release_compiler_pages()
after = ProcessUsage().sample()[1]
assert after < before - 20.0, (before, after)
assert abs(quaternion_from_rpy(0.0, 0.0, 0.0)[0] - 1.0) < 1e-15
assert numba.njit(lambda x: x * 2.0 + 1.0)(3.0) == 7.0
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
