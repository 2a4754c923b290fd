"""The parts of the test bench: a serial line and a broker, both real."""

from __future__ import annotations

import os
import pty
import shutil
import socket
import subprocess
import time
import tty
from pathlib import Path


class SerialLine:
    """A raw pty: the test holds the device's end, `fd`; the daemon opens `path`."""

    def __init__(self) -> None:
        self.fd, slave = pty.openpty()
        tty.setraw(self.fd)
        self.path = os.ttyname(slave)
        os.close(slave)

    def unplug(self) -> None:
        """Close the device's end: the daemon sees the line hang up."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


class Broker:
    """Mosquitto on a port of the loopback; may be killed and started again on the same port."""

    host = "127.0.0.1"

    def __init__(self, folder: Path) -> None:
        program = shutil.which("mosquitto")
        assert program is not None, "mosquitto is not installed"
        with socket.socket() as probe:
            probe.bind((self.host, 0))
            self.port: int = probe.getsockname()[1]
        self._log = folder / "mosquitto.log"
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} {self.host}\nallow_anonymous true\nuser root\nlog_dest stdout\n"
        )
        self._program = program
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, patience_s: float = 20.0) -> None:
        """Start and wait until it accepts connections."""
        with self._log.open("ab") as log:
            command = [self._program, "-c", str(self._config)]
            self._process = subprocess.Popen(command, stdout=log, stderr=log)
        end = time.monotonic() + patience_s
        while time.monotonic() < end and self._process.poll() is None:
            try:
                socket.create_connection((self.host, self.port), timeout=1.0).close()
                return
            except OSError:
                time.sleep(0.05)
        raise AssertionError(f"mosquitto does not answer:\n{self._log.read_text()}")

    def kill(self) -> None:
        """End it without a goodbye, as a power cut does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
