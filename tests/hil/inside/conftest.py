"""Fixtures of the hardware-in-the-loop tests: the bus, serial lines and a broker, all real.

These tests run where `tests/hil/uml.py` puts them: `vcan0` is up, the loopback is empty.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.broker import Broker
from tests.hil.bench import SerialLine


@pytest.fixture
def can_channel() -> str:
    """Name of a SocketCAN interface that is up."""
    return "vcan0"


@pytest.fixture
def serial_line() -> Iterator[SerialLine]:
    """A serial line with a device on it."""
    line = SerialLine()
    yield line
    line.unplug()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """A running broker."""
    with Broker(tmp_path) as broker:
        yield broker
