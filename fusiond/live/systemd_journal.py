"""Journal entries with level, source and code as fields, and their rate limit.

    journalctl -u fusiond -p warning
    journalctl -u fusiond FUSIOND_SOURCE=gnss FUSIOND_CODE=device_absent

Source: systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from collections.abc import Mapping
from pathlib import Path

from fusiond.live.log_limit import LogLimit
from fusiond.live.stderr_log_handler import StandardErrorHandler

SOCKET = Path("/run/systemd/journal/socket")
PRIORITIES = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
"""Priorities of syslog(3)."""


def fields(source: str, code: str) -> dict[str, str]:
    """`extra` of a log record for an event."""
    return {"fusiond_source": source, "fusiond_code": code}


class JournalHandler(logging.Handler):
    """Handler that writes to the journal without waiting; refused entries are counted in `lost`."""

    def __init__(self, path: Path = SOCKET) -> None:
        super().__init__()
        self._address = str(path)
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        self._socket = socket.socket(socket.AF_UNIX, kind)
        self.lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        said = {
            "MESSAGE": self.format(record),
            "PRIORITY": str(PRIORITIES.get(record.levelname, 6)),
            "SYSLOG_IDENTIFIER": "fusiond",
        }
        for name in fields("", ""):
            if hasattr(record, name):
                said[name.upper()] = str(getattr(record, name))
        if self.lost:
            said["FUSIOND_LOST"] = str(self.lost)
        try:
            self._socket.sendto(b"".join(_field(*each) for each in said.items()), self._address)
            self.lost = 0
        except OSError:
            self.lost += 1

    def close(self) -> None:
        self._socket.close()
        super().close()


def _field(name: str, value: str) -> bytes:
    """Encode NAME=value; a value of several lines is preceded by its length."""
    data = value.encode(errors="replace")
    if b"\n" in data:
        return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
    return name.encode() + b"=" + data + b"\n"


def handler(environ: Mapping[str, str] = os.environ) -> logging.Handler:
    """Log handler: the journal if standard error is connected to it (JOURNAL_STREAM,
    systemd.exec(5)), else standard error. Either is limited to a few lines a minute of one
    cause."""
    found = _handler(environ)
    found.addFilter(LogLimit())
    return found


def _handler(environ: Mapping[str, str]) -> logging.Handler:
    try:
        err = os.fstat(sys.stderr.fileno())
        journal = environ.get("JOURNAL_STREAM") == f"{err.st_dev}:{err.st_ino}" and SOCKET.exists()
    except (OSError, ValueError):  # standard error is closed or not a file
        journal = False
    if journal:
        return JournalHandler()
    return StandardErrorHandler()
