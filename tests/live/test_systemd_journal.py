"""Records as the journal takes them, at a real datagram socket; and when it is not the journal."""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path

import pytest

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import ClockOptions
from fusiond.live.events import Events
from fusiond.live.stderr_log_handler import StandardErrorHandler
from fusiond.live.systemd_journal import JournalHandler, handler


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "socket"))
        bound.settimeout(5.0)
        yield bound


@pytest.fixture
def log(journal: socket.socket, tmp_path: Path) -> Iterator[JournalHandler]:
    made = JournalHandler(tmp_path / "socket")
    logging.getLogger("fusiond").addHandler(made)
    yield made
    logging.getLogger("fusiond").removeHandler(made)
    made.close()


def test_an_event_has_level_source_and_code(journal: socket.socket, log: JournalHandler) -> None:
    Events(Clock(ClockOptions())).report("gnss", "device_absent", "/dev/gnss: gone")
    assert journal.recv(4096).decode().splitlines() == [
        "MESSAGE=gnss: device_absent: /dev/gnss: gone",
        "PRIORITY=4",
        "SYSLOG_IDENTIFIER=fusiond",
        "FUSIOND_SOURCE=gnss",
        "FUSIOND_CODE=device_absent",
    ]


def test_what_has_several_lines_stays_one_record(
    journal: socket.socket, log: JournalHandler
) -> None:
    logging.getLogger("fusiond").error("one\ntwo")
    assert journal.recv(4096) == (
        b"MESSAGE\n" + struct.pack("<Q", 7) + b"one\ntwo\nPRIORITY=3\nSYSLOG_IDENTIFIER=fusiond\n"
    )


def test_a_journal_that_takes_nothing_costs_records_and_no_time(
    journal: socket.socket, log: JournalHandler
) -> None:
    while not log.lost:
        logging.getLogger("fusiond").error("x" * 1000)
    journal.recv(4096)
    logging.getLogger("fusiond").error("again")
    received = [journal.recv(4096)]
    while b"again" not in received[-1]:
        received.append(journal.recv(4096))
    assert b"FUSIOND_LOST=1\n" in received[-1]
    assert log.lost == 0


def test_standard_error_where_that_is_not_the_journal(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(handler({}), logging.StreamHandler)
    assert isinstance(handler({"JOURNAL_STREAM": "1:1"}), logging.StreamHandler)
    with open(os.devnull, "w") as err:
        found = os.fstat(err.fileno())
        monkeypatch.setattr(sys, "stderr", err)
        monkeypatch.setattr("fusiond.live.systemd_journal.SOCKET", Path("/"))
        made = handler({"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"})
        assert isinstance(made, JournalHandler)
        made.close()


@contextmanager
def standard_error_in_a_pipe() -> Iterator[int]:
    """Nobody else reads it."""
    ours, theirs = os.pipe()
    with open(theirs, "w") as err, redirect_stderr(err):
        yield ours
    os.close(ours)


def _read_lines(pipe: int, last: str) -> list[str]:
    text = ""
    while last not in text:
        text += os.read(pipe, 65536).decode()
    return text.splitlines()


def test_standard_error_that_nobody_reads_costs_lines_and_no_time() -> None:
    """More than the pipe and the queue hold: whoever logs would wait for ever."""
    log = logging.getLogger("fusiond.unread")
    log.propagate = False
    with standard_error_in_a_pipe() as pipe:
        made = StandardErrorHandler()
        log.addHandler(made)
        made.begin_thread()
        while made.lost < 10:
            log.error("x" * 1000)
        os.read(pipe, 65536)
        while made.lost:
            log.error("again")
        lines = _read_lines(pipe, "were lost)")
        assert "lines before it were lost" in lines[-1]
        made.close()
    log.removeHandler(made)


def test_the_last_lines_are_written_at_the_end() -> None:
    log = logging.getLogger("fusiond.last")
    log.propagate = False
    with standard_error_in_a_pipe() as pipe:
        made = StandardErrorHandler()
        log.addHandler(made)
        log.error("before the loop")
        made.begin_thread()
        for number in range(100):
            log.error("in the loop %d", number)
        made.close()
        log.error("after the loop")
        lines = _read_lines(pipe, "after the loop")
    log.removeHandler(made)
    assert lines == [
        "ERROR before the loop",
        *(f"ERROR in the loop {number}" for number in range(100)),
        "ERROR after the loop",
    ]
