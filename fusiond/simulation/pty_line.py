"""Serial line of a simulated device: a pseudo terminal behind a symbolic link."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from pathlib import Path

_READ_BYTES = 4096


class PtyLine:
    """Device's end of a serial line, a pseudo terminal behind a symbolic link.

    Bytes written while no host has the line open are lost, as on a real line.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self._master: int | None = None
        self._hangup = select.poll()

    def plug(self) -> None:
        """Make the port appear. Raises OSError."""
        if self._master is not None:
            return
        master, slave = os.openpty()
        try:
            tty.setraw(slave)
            os.set_blocking(master, False)
            path = os.ttyname(slave)
            fresh = self.link.with_name(self.link.name + ".new")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(path)
            fresh.replace(self.link)
        except OSError:
            os.close(master)
            raise
        finally:
            os.close(slave)
        self._master = master
        self._hangup = select.poll()
        self._hangup.register(master, 0)

    def unplug(self) -> None:
        """Make the port vanish; a host that has it open sees a hang-up."""
        if self._master is None:
            return
        self.link.unlink(missing_ok=True)
        os.close(self._master)
        self._master = None

    def _open_by_host(self) -> bool:
        """True while the host has the slave open; else Linux reports a hang-up on the master."""
        return self._master is not None and not self._hangup.poll(0)

    def read(self) -> bytes:
        """Read bytes of the host, b"" for none."""
        if self._master is not None and self._open_by_host():
            with contextlib.suppress(OSError):
                return os.read(self._master, _READ_BYTES)
        return b""

    def write(self, data: bytes) -> bool:
        """Send bytes; False if some were lost because no host reads them."""
        if self._master is None or not self._open_by_host():
            return False
        try:
            return os.write(self._master, data) == len(data)
        except OSError:
            return False
