"""Repair of a damaged Vector BLF file's containers, so that python-can reads the intact part.

A BLF file is a header and containers of some 128 kB, mostly zipped, whose objects may continue in
the next container. Containers are split into objects, unreadable data are skipped up to the next
readable container, and complete objects are passed on in new containers.

A stamp counts from the header's time as an unsigned 64-bit number: frames before the trigger have
2^64 - n. So all stamps are shifted by a day, and the reader's start back by a day.

Source: python-can, `can.io.blf`, after Toby Lorenz' Vector BLF library.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO

from drivers.can.python_can_import import can

_BASE = can.io.blf.OBJ_HEADER_BASE_STRUCT
_CONTAINER = can.io.blf.LOG_CONTAINER_STRUCT
_SIGNATURE = b"LOBJ"
_V1, _V2 = 32, 40
"""Bytes of an object's full header by version, 1 and 2."""
_LEAST = {
    can.io.blf.CAN_MESSAGE: can.io.blf.CAN_MSG_STRUCT.size,
    can.io.blf.CAN_MESSAGE2: can.io.blf.CAN_MSG_STRUCT.size,
    can.io.blf.CAN_ERROR_EXT: can.io.blf.CAN_ERROR_EXT_STRUCT.size,
    can.io.blf.CAN_FD_MESSAGE: can.io.blf.CAN_FD_MSG_STRUCT.size,
    can.io.blf.CAN_FD_MESSAGE_64: can.io.blf.CAN_FD_MSG_64_STRUCT.size,
}
"""Least bytes behind the header of a frame's object, by type."""
_LONGEST_OBJECT = 1 << 20
"""Largest size of an object: a frame, a comment or an Ethernet packet takes far less; a larger size
is damage."""
_LONGEST_CONTAINER = 1 << 26
"""Containers have some 128 kB (`BLFWriter.max_container_size`), unzipped."""
_PADDING = 7
"""Most bytes of padding after an object."""
_TIME_AT = 24
"""Offset of the stamp in an object."""
DAY_S = 86_400
"""Shift of the stamps, since a trigger keeps seconds to minutes of earlier data."""
_DAY_TICKS = {True: DAY_S * 10**5, False: DAY_S * 10**9}
"""Day in stamps of 10 microseconds, and of nanoseconds."""


class Containers:
    """BLF file as python-can's reader expects it: the header, then containers of complete objects.

    `refused(text)` receives each lost piece.
    """

    def __init__(self, stream: BinaryIO, refused: Callable[[str], None]) -> None:
        self._stream = stream
        self._refused = refused
        self._ahead = b""
        self._tail = b""
        self._lost = False
        self._made = self._containers()
        self._rest = b""
        self._header = True
        self.damage: Exception | None = None
        """Cause of a premature end of the file."""

    def close(self) -> None:
        """Keep the file open: the reader closes its input, and the opener closes the file."""

    def body(self) -> None:
        """Note that the header has been read, and containers follow."""
        self._header = False

    def read(self, size: int) -> bytes:
        """Read the next bytes, like a file."""
        if self._header:
            return self._stream.read(size)
        while len(self._rest) < size:
            made = next(self._made, None)
            if made is None:
                break
            self._rest += made
        piece, self._rest = self._rest[:size], self._rest[size:]
        return piece

    # ------------------------------------------------------------------ the file

    def _take(self, size: int) -> bytes:
        """Read bytes of the file itself; fewer at its end."""
        piece, self._ahead = self._ahead[:size], self._ahead[size:]
        if len(piece) < size:
            try:
                piece += self._stream.read(size - len(piece))
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                self.damage = error
        return piece

    def _containers(self) -> Iterator[bytes]:
        while len(head := self._take(_BASE.size)) == _BASE.size:
            signature, _, _, size, kind = _BASE.unpack(head)
            if signature != _SIGNATURE or not _BASE.size <= size <= _LONGEST_CONTAINER:
                self._refused(f"{self._find_next(head)} bytes between containers")
                continue
            body = self._take(size - _BASE.size)
            if kind != can.io.blf.LOG_CONTAINER:
                self._take(size % 4)
                continue
            cut = len(body) < size - _BASE.size
            content = self._content(body)
            if content is None:  # the size may be wrong, with other containers inside
                self._find_next(head + body)
                continue
            if cut and self.damage is None:
                self.damage = EOFError("the last container is cut")
            self._take(size % 4)
            objects = self._objects(bytearray(self._tail + content))
            if objects:
                yield _container(objects)

    def _find_next(self, bad: bytes) -> int:
        """Skip damaged data up to the next container; return the number of bytes."""
        self._tail, self._lost = b"", True
        passed, window = 1, bad[1:]
        while True:
            at = window.find(_SIGNATURE)
            if at < 0:
                at = max(0, len(window) - len(_SIGNATURE) + 1)
            passed, window = passed + at, window[at:]
            if len(window) < _BASE.size:
                more = self._take(1 << 16)
                if not more:
                    return passed + len(window)
                window += more
                continue
            signature, _, _, size, kind = _BASE.unpack_from(window)
            known = signature == _SIGNATURE and kind == can.io.blf.LOG_CONTAINER
            if known and _BASE.size < size <= _LONGEST_CONTAINER:
                self._ahead = window + self._ahead
                return passed
            passed, window = passed + 1, window[1:]

    def _content(self, body: bytes) -> bytes | None:
        if len(body) < _CONTAINER.size:
            return None
        method, _ = _CONTAINER.unpack_from(body)
        packed = body[_CONTAINER.size :]
        if method == can.io.blf.NO_COMPRESSION:
            return packed
        if method != can.io.blf.ZLIB_DEFLATE:
            self._refused(f"a container packed by an unknown method, {method}")
            return None
        try:
            return zlib.decompressobj().decompress(packed, _LONGEST_CONTAINER)
        except zlib.error as error:
            self._refused(f"a container of {len(packed)} bytes: {error}")
            return None

    # ------------------------------------------------------------------ objects

    def _objects(self, data: bytearray) -> bytes:
        """Complete objects of the content with moved stamps; an incomplete rest is kept."""
        good = bytearray()
        at = 0
        while True:
            found = data.find(_SIGNATURE, at)
            if found < 0:
                if len(data) - at > _PADDING and not self._lost:
                    self._refused(f"{len(data) - at} bytes behind an object")
                    self._lost = True
                at = max(at, len(data) - _PADDING)
                break
            if found - at > _PADDING and not self._lost:
                self._refused(f"{found - at} bytes between objects")
            self._lost = False
            at = found
            if len(data) - at < _BASE.size:
                break
            _, header, version, size, kind = _BASE.unpack_from(data, at)
            if not _BASE.size <= header <= size <= _LONGEST_OBJECT:
                self._refused("an object of an impossible size")
                self._lost = True  # reported before
                at += len(_SIGNATURE)
                continue
            if len(data) - at < size:
                break
            least = _LEAST.get(kind)
            if least is not None:
                if size < (_V2 if version == 2 else _V1) + least:
                    self._refused("a frame's object that is too short")
                elif _move_time(data, at):
                    good += data[at : at + size]
                else:
                    self._refused("a frame's stamp a day and more before the beginning")
            at += size
        self._tail = bytes(data[at:])
        return bytes(good)


def _move_time(data: bytearray, at: int) -> bool:
    """Shift an object's stamp by a day; False if it is still before the beginning."""
    (flags,) = struct.unpack_from("<L", data, at + _BASE.size)
    (ticks,) = struct.unpack_from("<q", data, at + _TIME_AT)
    ticks += _DAY_TICKS[flags == can.io.blf.TIME_TEN_MICS]
    if not 0 <= ticks < 1 << 63:
        return False
    struct.pack_into("<q", data, at + _TIME_AT, ticks)
    return True


def _container(objects: bytes) -> bytes:
    size = _BASE.size + _CONTAINER.size + len(objects)
    head = _BASE.pack(_SIGNATURE, _BASE.size, 1, size, can.io.blf.LOG_CONTAINER)
    packed = _CONTAINER.pack(can.io.blf.NO_COMPRESSION, len(objects))
    return b"".join((head, packed, objects, bytes(size % 4)))
