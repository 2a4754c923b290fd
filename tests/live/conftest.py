"""The bench of a daemon that runs in the test's own process."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from tests.live.daemon_bench import Bench


@pytest.fixture
def bench(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Bench:
    caplog.set_level(logging.INFO, logger="fusiond")
    return Bench(tmp_path, caplog)
