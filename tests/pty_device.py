"""The far end of a serial line, for tests: a pseudo terminal that can be unplugged."""

from __future__ import annotations

import os
import tty
from pathlib import Path


class Device:
    """The far end of a line: a pty whose slave is reached through a symlink, like by-id paths."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.master = -1

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        fresh = self.link.with_suffix(".new")
        fresh.symlink_to(os.ttyname(slave))
        fresh.replace(self.link)
        os.close(slave)

    def unplug(self) -> None:
        self.link.unlink(missing_ok=True)
        if self.master >= 0:
            os.close(self.master)
            self.master = -1

    def send(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)
