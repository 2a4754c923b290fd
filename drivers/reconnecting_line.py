"""Serial line under asyncio that reopens itself when its device disappears and returns.

Every read is bounded and stamped, and an end of the stream is recognised. Each piece is handed over
in a turn of the loop of its own, and bytes no faster than a real line brings them (drivers.port).
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from functools import partial

from drivers.base import Backoff, Now, monotonic_ns
from drivers.detached_call import aside
from drivers.port import (
    OPEN_ERRORS,
    READ_BYTES,
    ByteBudget,
    OpenPort,
    Port,
    open_serial,
    why_not_open,
)

__all__ = ["PENDING_WRITE_BYTES", "READ_BYTES", "SerialLine"]

PENDING_WRITE_BYTES = 4096
"""Most bytes that may wait for a slow line: 2 s of 19200 baud, the slowest terminal."""
PATH_CHECK_S = 1.0
"""Interval of comparing the path with the open device, for replugs that the descriptor cannot see.
"""


class SerialLine:
    """Port reopened indefinitely with `backoff`; serial, unless `open_port` is another one.

    `counters`: `opened`, `closed`, `open_failed`, `bytes_in`, `bytes_out`, `write_refused`,
    `baud_refused`, `paused` (more came than a line brings). `detail` is the last problem in words;
    empty once bytes arrive.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        now_ns: Now = monotonic_ns,
        backoff: Backoff | None = None,
        open_port: OpenPort = open_serial,
    ) -> None:
        self.port = port
        self.baud = baud
        self.counters: Counter[str] = Counter()
        self.detail = ""
        self._now_ns = now_ns
        self._backoff = backoff or Backoff()
        self._open_port = open_port
        self._opened: Port | None = None
        self._gone: asyncio.Future[str] | None = None
        self._pending = bytearray()
        self._budget = ByteBudget(baud)
        self._unread: tuple[bytes, int] = b"", 0
        """Rest of a read, and the instant of its arrival."""
        self._resume: asyncio.Handle | None = None

    @property
    def is_open(self) -> bool:
        return self._opened is not None

    async def run(
        self,
        on_bytes: Callable[[bytes, int], None],
        on_open: Callable[[], None] | None = None,
        on_close: Callable[[str], None] | None = None,
    ) -> None:
        """Keep the line open until cancelled.

        `on_bytes(data, t_seen_ns)` gets at most `READ_BYTES` with the monotonic instant at which
        they were found waiting; `on_close(why)` is called once for every `on_open`. An exception of
        a callback is a bug of the caller: it closes the line and is raised.
        """
        while True:
            try:
                port = await self._open()
            except OPEN_ERRORS as error:
                self.counters["open_failed"] += 1
                why = why_not_open(error)
                why = why if self.port in why else f"{self.port} {why}"
                self.detail = f"{why}; retrying"
                await asyncio.sleep(self._backoff.next())
                continue
            self.counters["opened"] += 1
            self._opened = port
            why = "closed by this side"
            try:
                if on_open is not None:
                    on_open()
                why = await self._serve(port, on_bytes)
            finally:
                self._close(port)
                if on_close is not None:
                    on_close(why)
            self.detail = why
            await asyncio.sleep(self._backoff.next())

    def write(self, data: bytes) -> bool:
        """Send `data` without blocking; False if the line is closed or congested, or nobody at its
        other end can read."""
        port, gone = self._opened, self._gone
        if port is None or gone is None or gone.done() or not port.writable:
            self.counters["write_refused"] += 1
            return False
        if len(self._pending) + len(data) > PENDING_WRITE_BYTES:
            self.counters["write_refused"] += 1
            return False
        idle = not self._pending
        self._pending += data
        if idle:
            self._flush(port, gone)
            if self._pending and not gone.done():
                gone.get_loop().add_writer(port.fileno(), self._flush, port, gone)
        return True

    def set_baud(self, baud: int) -> None:
        """Change the baud rate of the open line and of every later opening."""
        self.baud = baud
        self._budget = ByteBudget(baud)
        if self._opened is None:
            return
        try:
            self._opened.set_baud(baud)
        except OPEN_ERRORS as error:
            self.counters["baud_refused"] += 1
            self._end(f"{self.port}: {baud} baud refused: {error}")

    async def _open(self) -> Port:
        """Open in a thread, since a faulty USB adapter or a network may block `open` for
        seconds."""
        opening = partial(self._open_port, self.port, self.baud, self.counters)
        return await aside(opening, lambda port: port.close())

    async def _serve(self, port: Port, on_bytes: Callable[[bytes, int], None]) -> str:
        """Read until the device is gone; return the reason in words."""
        loop = asyncio.get_running_loop()
        gone: asyncio.Future[str] = loop.create_future()
        self._gone = gone
        loop.add_reader(port.fileno(), self._read, port, gone, on_bytes)
        while True:
            done, _ = await asyncio.wait({gone}, timeout=PATH_CHECK_S)
            if done:
                return gone.result()
            if changed := port.changed():
                return changed

    def _read(
        self,
        port: Port,
        gone: asyncio.Future[str],
        on_bytes: Callable[[bytes, int], None],
    ) -> None:
        if gone.done():
            return
        t_seen_ns = self._now_ns()
        try:
            data = port.read()
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._end(f"{self.port}: {error.strerror}")
            return
        if not data:
            self._end(f"{self.port}: {port.at_end}")
            return
        self.counters["bytes_in"] += len(data)
        if self.detail:  # the first of this opening
            self._backoff.reset()
            self.detail = ""
        self._unread = data, t_seen_ns  # a datagram must be read as a whole
        self._hand_over(port, gone, on_bytes)

    def _hand_over(
        self,
        port: Port,
        gone: asyncio.Future[str],
        on_bytes: Callable[[bytes, int], None],
    ) -> None:
        """Hand over a piece; schedule the next one for when a real line could bring it."""
        data, t_seen_ns = self._unread
        self._unread = data[READ_BYTES:], t_seen_ns
        try:
            on_bytes(data[:READ_BYTES], t_seen_ns)
        except Exception as error:
            if not gone.done():
                gone.set_exception(error)
            return
        wait_s = self._budget.spend(min(len(data), READ_BYTES))
        if wait_s > 0.0:
            self.counters["paused"] += 1
        if (wait_s > 0.0 or self._unread[0]) and not gone.done():
            loop = gone.get_loop()
            loop.remove_reader(port.fileno())
            self._resume = loop.call_later(wait_s, self._go_on, port, gone, on_bytes)

    def _go_on(
        self,
        port: Port,
        gone: asyncio.Future[str],
        on_bytes: Callable[[bytes, int], None],
    ) -> None:
        self._resume = None
        if gone.done():
            return
        if self._unread[0]:
            self._hand_over(port, gone, on_bytes)
        if self._resume is None and not gone.done():
            gone.get_loop().add_reader(port.fileno(), self._read, port, gone, on_bytes)

    def _flush(self, port: Port, gone: asyncio.Future[str]) -> None:
        try:
            sent = port.write(self._pending)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            gone.get_loop().remove_writer(port.fileno())
            self._end(f"{self.port}: {error.strerror}")
            return
        self.counters["bytes_out"] += sent
        del self._pending[:sent]
        if not self._pending:
            gone.get_loop().remove_writer(port.fileno())

    def _end(self, why: str) -> None:
        if self._gone is not None and not self._gone.done():
            self._gone.set_result(why)

    def _close(self, port: Port) -> None:
        loop = asyncio.get_running_loop()
        fd = port.fileno()
        loop.remove_reader(fd)
        loop.remove_writer(fd)
        if self._resume is not None:
            self._resume.cancel()
        self._unread = b"", 0
        port.close()
        self._opened = None
        self._gone = None
        self._pending.clear()
        self.counters["closed"] += 1
