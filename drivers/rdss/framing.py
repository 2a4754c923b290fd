"""Framing of both families: search for frames in a stream, and their checksum.

A frame begins with `$`, which may also occur inside a frame. So after a failure the search
continues one byte further with the next `$`: it finds a good frame whatever precedes it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import ClassVar

from drivers.rdss.messages import EncodeError, Message, Unknown


def checksum(data: bytes | bytearray | memoryview) -> int:
    """XOR of all bytes."""
    return reduce(xor, data, 0)


def encode_frame(say: Callable[[Message], bytes], message: Message) -> bytes:
    """Frame of a message. Raises EncodeError for a value that exceeds its field."""
    try:
        return say(message)
    except EncodeError:
        raise
    except (OverflowError, ValueError, TypeError) as error:
        raise EncodeError(f"{message}: {error}") from None


class FrameDecoder(ABC):
    """Decoder of bytes into messages, of both directions. Buffers at most one frame.

    Counters: `frames`, `unknown` (well-formed, not read here), `bad_field` (good checksum,
    impossible value), `abandoned` (frame whose rest never came), `garbage_bytes`, and the faults
    that a family names.
    """

    BETWEEN: ClassVar[bytes] = b""
    """Bytes allowed between frames, which do not count as garbage."""

    def __init__(self, counters: Counter[str] | None = None) -> None:
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._buffer = bytearray()
        self._awaited = 0

    @property
    def awaited_bytes(self) -> int:
        return self._awaited

    def feed(self, data: bytes) -> list[Message]:
        self._buffer += data
        return self._scan(0)

    def expire(self) -> list[Message]:
        if not self._buffer:
            return []
        self.counters["abandoned"] += 1
        return self._scan(1)

    def _scan(self, at: int) -> list[Message]:
        messages: list[Message] = []
        buffer, counters = self._buffer, self.counters
        counters["garbage_bytes"] += at
        self._awaited = 0
        while True:
            start = buffer.find(b"$", at)
            if start < 0:
                start = len(buffer)
            if start > at:
                counters["garbage_bytes"] += len(buffer[at:start].translate(None, self.BETWEEN))
                at = start
            if at == len(buffer):
                break
            length, fault = self._extent(buffer, at)
            if fault:
                counters[fault] += 1
            elif len(buffer) - at < length:
                self._awaited = length
                break
            else:
                message = self._read(bytes(buffer[at : at + length]))
                if message is not None:
                    messages.append(message)
                    at += length
                    continue
            counters["garbage_bytes"] += 1
            at += 1
        del buffer[:at]
        return messages

    def _judge(self, read: Callable[[], Message | None] | None, unknown: Unknown) -> Message | None:
        """Message of a verified frame, counted; `unknown` for an unsupported kind."""
        try:
            message = read() if read is not None else None
        except ValueError:
            self.counters["bad_field"] += 1
            return None
        self.counters["unknown" if message is None else "frames"] += 1
        return unknown if message is None else message

    @abstractmethod
    def _extent(self, buffer: bytearray, at: int) -> tuple[int, str]:
        """Length of the frame at `at`, and the name of its fault or "".

        While the length is unknown, the largest number of bytes needed to find it.
        """

    @abstractmethod
    def _read(self, whole: bytes) -> Message | None:
        """Message of a complete frame; None, and counted, if damaged."""
