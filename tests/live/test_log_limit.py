"""However often something is said, the log has a few lines a minute of it, and how many it was."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from fusiond.live.log_limit import CAUSES, MOST, LogLimit
from fusiond.live.systemd_journal import fields, handler


class Kept(logging.Handler):
    """Keeps what it is given, as it would be written."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.now_s = 0.0
        self.limit = LogLimit(lambda: self.now_s)
        self.addFilter(self.limit)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))


@pytest.fixture
def kept() -> Iterator[Kept]:
    made = Kept()
    log = logging.getLogger("fusiond.limited")
    log.setLevel(logging.DEBUG)
    log.propagate = False
    log.addHandler(made)
    yield made
    log.removeHandler(made)


LOG = logging.getLogger("fusiond.limited")


def storm(count: int) -> None:
    for number in range(count):
        try:
            raise OSError(24, f"Too many open files {number}")
        except OSError:
            LOG.exception("accept %d failed", number)


def test_a_storm_is_a_few_lines_a_minute(kept: Kept) -> None:
    for _ in range(600):  # ten minutes of 100 a second
        storm(100)
        kept.now_s += 1.0
    assert len(kept.lines) <= 10 * (MOST + 1)
    assert "more like it are left out" in kept.lines[MOST]
    assert "Traceback" not in kept.lines[MOST]
    assert f"({6000 - MOST - 1} more like it were left out)" in kept.lines[MOST + 1]
    assert kept.limit.left_out == 60_000 - len(kept.lines)


def test_each_cause_has_its_own(kept: Kept) -> None:
    storm(50)
    LOG.warning("of another place")
    for code in ("device_absent", "device_silent"):
        for number in range(3):
            LOG.warning("gnss: %s: %d", code, number, extra=fields("gnss", code))
    assert len(kept.lines) == MOST + 1 + 1 + 6
    for _ in range(50):
        LOG.debug("for who asks for it")
    assert len(kept.lines) == MOST + 1 + 1 + 6 + 50


def test_what_it_remembers_is_bounded(kept: Kept) -> None:
    for number in range(3 * CAUSES):
        LOG.warning("once", extra=fields(f"source {number}", "code"))
    assert len(kept.lines) == 3 * CAUSES
    assert len(kept.limit._causes) == CAUSES


def test_the_daemons_own_handler_is_limited() -> None:
    assert [type(f) for f in handler({}).filters] == [LogLimit]
