"""Fixtures of the hardware-in-the-loop tests: the bus, serial lines and a broker, all real.

These tests run where `tests/hil/uml.py` puts them: `vcan0` is up, the loopback is empty.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest

from tests.broker import Broker
from tests.hil.bench import SerialLine
from tests.hil.standstill import FAILURES, STANDSTILL_S, watching

LONGEST_S = pytest.StashKey[Callable[[], float]]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Watch whether the guest stands still."""
    with watching() as item.stash[LONGEST_S]:
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note what has failed, and whether the guest stood still meanwhile."""
    report = yield
    if report.failed:
        longest_s = item.stash[LONGEST_S]()
        report.sections.append(("guest", f"stood still for at most {longest_s:.2f} s"))
        if FAILURES in os.environ:
            word = "void" if longest_s > STANDSTILL_S else "failed"
            with Path(os.environ[FAILURES]).open("a") as notes:
                notes.write(f"{word} {item.nodeid}\n")
    return report


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
