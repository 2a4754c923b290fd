"""Listening port of a server: retried while in use, with its state."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable, Iterable
from typing import Protocol, TypeVar

from drivers.base import Backoff, DriverStatus


class Listening(Protocol):
    """Server that listens."""

    @property
    def sockets(self) -> Iterable[socket.socket]: ...


S = TypeVar("S", bound=Listening)


class Port:
    """Listening port. `on_event` receives `<name>_absent` once when the port is unavailable;
    `status` is its state, `address` its address once `running`."""

    def __init__(
        self, name: str, host: str, port: int, on_event: Callable[[str, str], None]
    ) -> None:
        self._name = name
        self._on_event = on_event
        self.address: tuple[str, int] = (host, port)
        self.status = DriverStatus()

    async def open(self, listen: Callable[[str, int], Awaitable[S]]) -> S:
        """Open the port by `listen(host, port)`; retry while that raises `OSError`."""
        backoff = Backoff()
        while True:
            try:
                server = await listen(*self.address)
            except OSError as error:
                text = f"{self.address[0]}:{self.address[1]}: {error.strerror or error}"
                if self.status.state != "absent":
                    self.report("absent", text)
                self.status = DriverStatus("absent", text)
                await asyncio.sleep(backoff.next())
                continue
            bound = next(iter(server.sockets)).getsockname()
            self.address = (bound[0], bound[1])
            self.serves(0)
            return server

    def report(self, code: str, text: str) -> None:
        """Report an event `<name>_<code>`."""
        self._on_event(f"{self._name}_{code}", text)

    def serves(self, clients: int) -> None:
        """Set the state to the number of connected clients."""
        host, port = self.address
        self.status = DriverStatus("running", f"{host}:{port}, {clients} connected")
