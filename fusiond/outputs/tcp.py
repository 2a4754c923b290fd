"""A TCP port and its clients, none of whom holds up another, or a tick.

What a client has not read waits in its connection: 16 KiB in the process and as much again in the
kernel. While that is full its epochs are skipped; who skips thirty in a row is dropped.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import Awaitable, Callable

from fusiond.outputs.activation import activated
from fusiond.outputs.port import Port

MOST_CLIENTS = 256
"""A quarter of the descriptors that a process has by default (1024, RLIMIT_NOFILE)."""
MOST_WAITING_BYTES = 16384
"""Some ten epochs of gpsd's JSON, 1 to 1.5 kB each: a second at 10 Hz. What is older is no use."""
MOST_SKIPPED = 30
"""Epochs in a row: 3 s at 10 Hz, half a minute at 1 Hz, the time that gpsd's clients wait."""
_TURN = 16
"""Clients written to before the loop may run a tick: some 0.3 ms."""


class Client:
    """One connection."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        counters: Counter[str],
    ) -> None:
        self.reader = reader
        self._writer = writer
        self._counters = counters
        self._skipped = 0

    def send(self, data: bytes) -> None:
        """Send all of `data` or nothing of it; does not wait."""
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > MOST_WAITING_BYTES:
            self._counters["skipped"] += 1
            self._skipped += 1
            if self._skipped >= MOST_SKIPPED:
                self._counters["clients_dropped"] += 1
                self.drop()
            return
        self._skipped = 0
        self._writer.write(data)
        self._counters["sent"] += 1

    async def finish(self, data: bytes) -> None:
        """Send `data`, wait until it is out, and close."""
        self._writer.write(data)
        self._counters["sent"] += 1
        await self._writer.drain()
        self._writer.close()

    def drop(self) -> None:
        self._writer.transport.abort()


class TcpServer:
    """Listens at `host:port`, or at the socket that the service manager holds as `name`.

    `serve(client)` is called for each connection, which ends with it. `counters`: `clients` (since
    the start), `clients_refused` (too many at once), `clients_dropped` (did not read), `sent`,
    `skipped` (epochs that a client was too slow for). `port` says how it stands.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int,
        serve: Callable[[Client], Awaitable[None]],
        on_event: Callable[[str, str], None],
    ) -> None:
        self._name = name
        self._serve = serve
        self.counters: Counter[str] = Counter()
        self.port = Port(name, host, port, on_event)
        self.clients: set[Client] = set()

    async def run(self) -> None:
        """Listen until cancelled; a port that is taken is tried again."""
        server = await self.port.open(self._listening)
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            server.close()
            for client in tuple(self.clients):
                client.drop()

    async def send(self, data: Callable[[Client], bytes]) -> None:
        """Send each client what `data` makes for it, if anything."""
        for turn, client in enumerate(tuple(self.clients)):
            if turn % _TURN == _TURN - 1:
                await asyncio.sleep(0)
            payload = data(client)
            if payload:
                client.send(payload)

    async def _listening(self, host: str, port: int) -> asyncio.Server:
        held = activated(self._name)
        server = (
            await asyncio.start_server(self._connected, host, port)
            if held is None
            else await asyncio.start_server(self._connected, sock=held)
        )
        for sock in server.sockets:
            # Inherited by each connection: the kernel would keep megabytes for who does not read.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_WAITING_BYTES // 2)
        return server

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = Client(reader, writer, self.counters)
        if len(self.clients) >= MOST_CLIENTS:
            self.counters["clients_refused"] += 1
            client.drop()
            return
        self.counters["clients"] += 1
        self.clients.add(client)
        self.port.serves(len(self.clients))
        try:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):
                await self._serve(client)
        finally:
            self.clients.discard(client)
            self.port.serves(len(self.clients))
            writer.close()
