"""Requests of gpsd's clients: bytes in, requests out; no I/O.

A request is `?NAME;` or `?NAME={...};`. Clients end it by the semicolon, by a line end or by both;
an object also ends where its brackets close. The parser examines each byte once, in pieces of any
size.

Source: gpsd_json(5) of gpsd 3.22, "Core protocol commands"; recorded requests of its clients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fusiond.outputs.json_requests import NotUnderstoodError, parsed

MOST_BYTES = 10240
"""Longest line of the protocol (GPS_JSON_RESPONSE_MAX of gpsd 3.22)."""
_ENDS = b";\r\n"


@dataclass(frozen=True, slots=True)
class Request:
    """Request `?name` with its object; `argument` is None without one."""

    name: str
    argument: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Malformed:
    """Input that is no request."""

    text: str


class RequestReader:
    """Parser of a client's requests in pieces of any size."""

    def __init__(self) -> None:
        self._restart()

    def _restart(self) -> None:
        self._waiting = bytearray()
        self._depth = 0
        self._quoted = self._escaped = False

    def feed(self, data: bytes) -> Iterator[Request | Malformed]:
        """Requests that are complete after `data`."""
        begin = 0
        for index, byte in enumerate(data):
            if not self._ends(byte):
                continue
            text = (bytes(self._waiting) + data[begin : index + 1]).strip(b"; \t\r\n")
            begin = index + 1
            self._restart()
            if text:
                yield _parsed(text.decode("utf-8", "replace"))
        self._waiting += data[begin:]
        if len(self._waiting) > MOST_BYTES:
            self._restart()
            yield Malformed("request too long")

    def _ends(self, byte: int) -> bool:
        """True if a request ends with this byte."""
        if self._quoted:
            if self._escaped:
                self._escaped = False
            elif byte == ord("\\"):
                self._escaped = True
            elif byte == ord('"'):
                self._quoted = False
        elif byte == ord('"') and self._depth:
            self._quoted = True
        elif byte == ord("{"):
            self._depth += 1
        elif byte == ord("}") and self._depth:
            self._depth -= 1
            return not self._depth
        else:
            return byte in _ENDS and not self._depth
        return False


def _parsed(text: str) -> Request | Malformed:
    name, equals, rest = text.partition("=")
    if not name.startswith("?") or not name[1:].isalpha():
        return Malformed(f"Unrecognized request '{text[:80]}'")
    if not equals:
        return Request(name[1:])
    try:
        argument = parsed(rest)
    except NotUnderstoodError as error:
        return Malformed(f"Invalid {name[1:20]}: {error}")
    if not isinstance(argument, dict):
        return Malformed(f"Invalid {name[1:20]}: '{rest[:80]}'")
    return Request(name[1:], argument)
