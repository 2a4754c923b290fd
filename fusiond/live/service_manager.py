"""Notifications to the service manager: sd_notify(3)."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping


class ServiceManager:
    """State notifications to systemd over NOTIFY_SOCKET; does nothing without one.

    No method raises or blocks: `failed` counts notifications that the service manager did not take.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        self.failed = 0
        if address.startswith(("/", "@")):
            # "@" names a socket of the abstract namespace, whose address starts with NUL.
            self._address = "\0" + address[1:] if address[0] == "@" else address
            self._socket = socket.socket(
                socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
            )
        self._watchdog_ns = _watchdog_ns(environ)
        self._fed_ns: int | None = None

    @property
    def watchdog_s(self) -> float | None:
        """Watchdog period (WATCHDOG_USEC); None if off or for another process."""
        return None if self._watchdog_ns is None else self._watchdog_ns / 1e9

    def _send(self, state: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(state.encode(), self._address)
        except OSError:
            self.failed += 1

    def ready(self, status: str = "") -> None:
        """Report that the start is complete."""
        self._send("READY=1" + (f"\nSTATUS={_one_line(status)}" if status else ""))

    def status(self, text: str) -> None:
        """Send a sentence for `systemctl status`."""
        self._send(f"STATUS={_one_line(text)}")

    def reloading(self) -> None:
        """Report that the configuration is being reloaded, until `ready`."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Report the start of the shutdown."""
        self._send("STOPPING=1")

    def feed_watchdog(self, t_ns: int) -> None:
        """Note a tick on time at `t_ns` (monotonic); notifies at most four times a watchdog
        period."""
        if self._watchdog_ns is None:
            return
        if self._fed_ns is None or t_ns - self._fed_ns >= self._watchdog_ns // 4:
            self._fed_ns = t_ns
            self._send("WATCHDOG=1")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _watchdog_ns(environ: Mapping[str, str]) -> int | None:
    try:
        period_ns = int(environ["WATCHDOG_USEC"]) * 1000
        pid = int(environ.get("WATCHDOG_PID", os.getpid()))
    except (KeyError, ValueError):
        return None
    return period_ns if period_ns > 0 and pid == os.getpid() else None


def _one_line(text: str) -> str:
    return " ".join(text.split())
