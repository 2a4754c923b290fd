"""Base of byte stream splitters: pieces of any size to verified messages, in bounded memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from typing import Generic, TypeVar

SLICE = 4096
"""Bytes scanned at a time, so that the buffer stays bounded."""

Message = TypeVar("Message")


class Splitter(ABC, Generic[Message]):
    """Buffer of incomplete input. Subclasses find messages in it (`_scan`)."""

    def __init__(self, counters: Counter[str] | None = None) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._buffer = bytearray()

    @property
    def waiting(self) -> int:
        """Bytes kept until more come."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message]:
        """Add `data`; return the messages that it completes, in order."""
        found: list[Message] = []
        for start in range(0, len(data), SLICE):
            self._buffer += data[start : start + SLICE]
            self._scan(found, final=False)
        return found

    def finish(self) -> list[Message]:
        """End the stream: drop an incomplete message, and return complete ones inside it."""
        found: list[Message] = []
        self._scan(found, final=True)
        return found

    @abstractmethod
    def _scan(self, found: list[Message], *, final: bool) -> None:
        """Remove complete messages from the buffer, or everything if `final`."""
