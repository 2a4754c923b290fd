"""NTRIP: the request, and a parser of the caster's reply. No I/O, no clock.

NTRIP 1.0 (RTCM 10410.0) answers `ICY 200 OK`, and the corrections follow; NTRIP 2.0 (RTCM 10410.1)
is HTTP/1.1, as a rule in chunks (RFC 9112, section 7.1). A mountpoint that the caster lacks is
answered by 1.0 with the table of those it has, by 2.0 with 404.
"""

from __future__ import annotations

import base64
import re

HEADER_BYTES = 8192
"""Most bytes of a head: the limit of most HTTP servers."""
_SIZE_LINE_BYTES = 64
_HEXADECIMAL = re.compile(rb"[0-9A-Fa-f]{1,8}")
_SOURCE_TABLE = "gnss/sourcetable"


class CasterRefusedError(Exception):
    """Error: the caster gives no corrections; the text is the reason."""


def mountpoint_request(host: str, port: int, mountpoint: str, user: str, password: str) -> bytes:
    """Request for a mountpoint; a caster of version 1.0 ignores the headers of 2.0."""
    lines = [
        f"GET /{mountpoint} HTTP/1.1",
        f"Host: {host}:{port}",
        "Ntrip-Version: Ntrip/2.0",
        "User-Agent: NTRIP fusiond",  # casters of 1.0 serve only user agents that begin so
        "Connection: close",
    ]
    if user:
        secret = base64.b64encode(f"{user}:{password}".encode()).decode("ascii")
        lines.append(f"Authorization: Basic {secret}")
    return "\r\n".join((*lines, "", "")).encode("utf-8")


class CasterReply:
    """Parser of a caster's reply: `feed` its bytes to get the corrections among them.

    Raises CasterRefusedError for any reply but corrections.
    """

    def __init__(self) -> None:
        self.accepted = False
        self.over: EOFError | CasterRefusedError | None = None
        """Reason why the corrections end: the caster closed them, or its chunks are invalid."""
        self._buffer = bytearray()
        self._sought = 0
        """Earliest end of the head: not before."""
        self._chunked = False
        self._left = 0
        """Missing bytes of the chunk, its closing CR LF included."""

    def feed(self, data: bytes) -> bytes:
        """Corrections in `data`."""
        self._buffer += data
        if not self.accepted and not self._head():
            return b""
        if self._chunked:
            return self._chunks()
        found = bytes(self._buffer)
        self._buffer.clear()
        return found

    def _head(self) -> bool:
        """Remove the head from the buffer; true once it is complete."""
        ends = b"\r\n" if self._buffer.startswith(b"ICY ") else b"\r\n\r\n"
        end = self._buffer.find(ends, self._sought)
        found = end >= 0
        if (end if found else len(self._buffer) - len(ends) + 1) > HEADER_BYTES:
            raise CasterRefusedError("no answer of a caster: its head does not end")
        if self._buffer.startswith(b"SOURCETABLE"):
            raise CasterRefusedError("no such mountpoint: the caster answers with its table")
        if not found:
            self._sought = max(0, len(self._buffer) - 3)
            return False
        head, rest = bytes(self._buffer[:end]), self._buffer[end + len(ends) :]
        _judge(head.partition(b"\r\n")[0].decode("latin-1"), head)
        self._chunked = b"transfer-encoding: chunked" in head.lower()
        self.accepted = True
        self._buffer = rest
        return True

    def _chunks(self) -> bytes:
        found, buffer, at = bytearray(), self._buffer, 0
        while at < len(buffer) and self.over is None:
            if self._left:
                taken = min(self._left, len(buffer) - at)
                payload = min(taken, max(0, self._left - 2))
                found += buffer[at : at + payload]
                self._left -= taken
                at += taken
                continue
            ends = buffer.find(b"\r\n", at, at + _SIZE_LINE_BYTES + 2)
            if ends < 0 and len(buffer) - at < _SIZE_LINE_BYTES + 2:
                break
            size = None if ends < 0 else _size(bytes(buffer[at:ends]))
            if not size:
                no_size = CasterRefusedError("a chunk of the answer has no size")
                self.over = no_size if size is None else EOFError()
                break
            self._left = size + 2
            at = ends + 2
        del buffer[:at]
        return bytes(found)


def _size(line: bytes) -> int | None:
    """Size in a chunk's first line; None if invalid."""
    digits = line.partition(b";")[0].strip()
    return int(digits, 16) if _HEXADECIMAL.fullmatch(digits) else None


def _judge(first: str, head: bytes) -> None:
    """Evaluate a head that begins with the line `first`: do corrections follow?"""
    protocol, _, status = first.partition(" ")
    code = status.partition(" ")[0]
    if protocol != "ICY" and not protocol.startswith("HTTP/1."):
        raise CasterRefusedError(f"no answer of a caster: {first[:80]!r}")
    if code == "401":
        raise CasterRefusedError("user or password is wrong (401)")
    if code == "404":
        raise CasterRefusedError("no such mountpoint (404)")
    if code != "200":
        raise CasterRefusedError(f"the caster says {status[:80]!r}")
    if _SOURCE_TABLE in head.decode("latin-1").lower():
        raise CasterRefusedError("no such mountpoint: the caster answers with its table")
