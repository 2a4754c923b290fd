"""What reads a bus starts without what python-can has for logs of measuring instruments."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["imu", "signal_bits"])
def test_whichever_module_comes_first_asammdf_stays_out(module: str) -> None:
    asked = "'asammdf' in sys.modules, 'can' in sys.modules"
    code = f"import sys, drivers.can.{module}; print({asked})"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.split() == ["False", "True"]
