"""A part of the test bench: a serial line. The broker is `tests.broker`."""

from __future__ import annotations

import os
import pty
import tty


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
