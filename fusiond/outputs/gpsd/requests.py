"""Requests of gpsd's clients: bytes in, requests out; no I/O.

A request is `?NAME;` or `?NAME={...};`. Clients end it with the semicolon, with a line end, with
both, or, after an object, with neither: an object ends where its brackets close.

Source: gpsd_json(5) of gpsd 3.22, "Core protocol commands"; what its clients really send.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

MOST_BYTES = 10240
"""Longest line of the protocol (GPS_JSON_RESPONSE_MAX of gpsd 3.22)."""
_ENDS = b";\r\n"


@dataclass(frozen=True, slots=True)
class Request:
    """`?name` with its object; `argument` is None where there is none."""

    name: str
    argument: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Malformed:
    """Something that is no request."""

    text: str


class RequestReader:
    """Takes what a client has sent, in pieces of any size."""

    def __init__(self) -> None:
        self._waiting = b""

    def feed(self, data: bytes) -> Iterator[Request | Malformed]:
        """The requests that are complete now."""
        self._waiting += data
        while self._waiting:
            end = _end(self._waiting)
            if end is None:
                if len(self._waiting) > MOST_BYTES:
                    self._waiting = b""
                    yield Malformed("request too long")
                return
            text, self._waiting = self._waiting[:end], self._waiting[end:]
            found = text.strip(b"; \t\r\n")
            if found:
                yield _parsed(found.decode("utf-8", "replace"))


def _end(data: bytes) -> int | None:
    """Where the first request ends; None if it goes on."""
    depth, quoted, escaped = 0, False, False
    for index, byte in enumerate(data):
        if quoted:
            if escaped:
                escaped = False
            elif byte == ord("\\"):
                escaped = True
            elif byte == ord('"'):
                quoted = False
        elif byte == ord('"') and depth:
            quoted = True
        elif byte == ord("{"):
            depth += 1
        elif byte == ord("}") and depth:
            depth -= 1
            if not depth:
                return index + 1
        elif byte in _ENDS and not depth:
            return index + 1
    return None


def _parsed(text: str) -> Request | Malformed:
    name, equals, rest = text.partition("=")
    if not name.startswith("?") or not name[1:].isalpha():
        return Malformed(f"Unrecognized request '{text[:80]}'")
    if not equals:
        return Request(name[1:])
    try:
        argument = json.loads(rest)
    except ValueError:
        argument = None
    if not isinstance(argument, dict):
        return Malformed(f"Invalid {name[1:]}: '{rest[:80]}'")
    return Request(name[1:], argument)
