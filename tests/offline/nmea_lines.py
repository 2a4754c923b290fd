"""Lines of NMEA as a device writes them."""

from __future__ import annotations

from functools import reduce
from operator import xor


def sentence(body: str) -> bytes:
    """With its checksum and line end."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()
