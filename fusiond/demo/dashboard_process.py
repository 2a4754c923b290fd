"""Dashboard of the demo: a process `fusiond dashboard` on the demo's broker."""

from __future__ import annotations

import ctypes
import signal
import socket
import subprocess
import sys
from types import TracebackType

from fusiond.demo.broker import DemoError

PORT = 8088
"""Preferred port of the page, so that its address stays the same from demo to demo."""
_END_S = 5.0
_PR_SET_PDEATHSIG = 1


def _end_with_the_demo() -> None:
    """Ask the kernel for SIGTERM when the parent dies (prctl(2))."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _free(port: int) -> bool:
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class DemoPage:
    """Context manager of a dashboard process; `address` is the page's URL.

    Raises `DemoError` if it cannot start; standard error has the reason.
    """

    def __init__(self, broker_port: int) -> None:
        port = PORT if _free(PORT) else 0
        command = [sys.executable, "-m", "fusiond", "dashboard", "--port", str(port)]
        self._process = subprocess.Popen(
            [*command, "--mqtt", f"127.0.0.1:{broker_port}"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C goes to the whole terminal; the demo ends in order
            preexec_fn=_end_with_the_demo,  # noqa: PLW1509 - no thread has begun yet
        )
        self.address = ""

    def __enter__(self) -> DemoPage:
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()
        if not self.address:
            self._process.wait()
            raise DemoError("the dashboard did not start; its error stands above")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
