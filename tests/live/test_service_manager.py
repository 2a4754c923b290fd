"""sd_notify over real datagram sockets."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusiond.live.service_manager import ServiceManager


@pytest.fixture(params=["path", "abstract"])
def listener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
        s.settimeout(5.0)
        if request.param == "path":
            name = str(tmp_path / "notify")
            s.bind(name)
        else:
            name = f"@fusiond-test-{os.getpid()}-{id(s)}"
            s.bind("\0" + name[1:])
        yield s, name


def test_states_as_systemd_reads_them(listener: tuple[socket.socket, str]) -> None:
    s, name = listener
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    manager.ready("aligned\ninputs are up")
    manager.status("navigating")
    manager.stopping()
    assert s.recv(256) == b"READY=1\nSTATUS=aligned inputs are up"
    assert s.recv(256) == b"STATUS=navigating"
    assert s.recv(256) == b"STOPPING=1"
    assert manager.failed == 0
    manager.close()
    manager.status("after the end")


def test_watchdog_is_fed_at_a_quarter_of_its_period(listener: tuple[socket.socket, str]) -> None:
    s, name = listener
    manager = ServiceManager(
        {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}
    )
    assert manager.watchdog_s == 2.0
    for k in range(201):  # 100 Hz for 2 s
        manager.feed_watchdog(7_000_000_000 + k * 10_000_000)
    s.settimeout(0.0)
    received = []
    while True:
        try:
            received.append(s.recv(256))
        except BlockingIOError:
            break
    assert received == [b"WATCHDOG=1"] * 5
    manager.close()


@pytest.mark.parametrize(
    "environ",
    [
        {},
        {"WATCHDOG_USEC": "x"},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"},
    ],
)
def test_no_watchdog_without_a_period_for_us(environ: dict[str, str]) -> None:
    manager = ServiceManager(environ)
    assert manager.watchdog_s is None
    manager.feed_watchdog(0)
    manager.ready()
    manager.close()


def test_nobody_listening_is_counted_not_raised(tmp_path: Path) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    manager.ready()
    assert manager.failed == 1
    manager.close()
