"""Socket activation: a port that the service manager has opened, sd_listen_fds(3)."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

_FIRST_FD = 3
"""First passed descriptor, SD_LISTEN_FDS_START."""


def activated(name: str, environ: Mapping[str, str] = os.environ) -> socket.socket | None:
    """Listening socket of the unit's `FileDescriptorName=name`; None without one.

    Each call gives a duplicate, which a server may close and request again.
    """
    try:
        meant, count = int(environ["LISTEN_PID"]), int(environ["LISTEN_FDS"])
    except (KeyError, ValueError):
        return None
    names = environ.get("LISTEN_FDNAMES", "").split(":")[:count]
    if meant != os.getpid() or name not in names:
        return None
    return socket.socket(fileno=os.dup(_FIRST_FD + names.index(name)))
