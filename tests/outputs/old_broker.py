"""A broker that speaks MQTT 3.1.1 alone, in one of the three ways that there are: a relay before a
real Mosquitto, which sees the version of each CONNECT."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from tests.broker import Broker

REFUSES, HANGS_UP, SILENT = b"\x20\x02\x00\x01", b"", None
"""What a client of version 5 hears: CONNACK "unacceptable protocol version" (3.1.1, 3.2.2.3), the
end of the connection, or nothing, as from amqtt 0.11."""


class OldBroker:
    """`port` is where it listens; `versions` are those of the clients that came, in order;
    `bytes_out` is what was handed to clients."""

    def __init__(self, broker: Broker, answer: bytes | None) -> None:
        self.port = 0
        self.versions: list[int] = []
        self.bytes_out = 0
        self._clients: set[asyncio.StreamWriter] = set()
        self._broker = broker
        self._answer = answer

    def drop(self) -> None:
        """Hang up on all who are connected."""
        for client in self._clients:
            client.close()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        try:
            with suppress(OSError):
                await self._serve(reader, writer)
        finally:
            self._clients.discard(writer)
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        first = await reader.read(4096)
        if not first:
            return
        version = first[first.index(b"\x00\x04MQTT") + 6]
        self.versions.append(version)
        if version == 5 and self._answer != b"5":
            if self._answer is None:
                await reader.read()
            else:
                writer.write(self._answer)
            return
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._broker.port)
        far_writer.write(first)
        try:
            await asyncio.gather(
                self._relay(reader, far_writer), self._relay(far_reader, writer, count=True)
            )
        finally:
            far_writer.close()

    async def _relay(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, count: bool = False
    ) -> None:
        with suppress(OSError):
            while data := await reader.read(65536):
                self.bytes_out += len(data) if count else 0
                writer.write(data)
                await writer.drain()
        writer.close()


@asynccontextmanager
async def old_broker(broker: Broker, answer: bytes | None = REFUSES) -> AsyncIterator[OldBroker]:
    """Before `broker`; with `answer` b"5" it lets version 5 through."""
    old = OldBroker(broker, answer)
    server = await asyncio.start_server(old.serve, "127.0.0.1", 0)
    old.port = server.sockets[0].getsockname()[1]
    try:
        yield old
    finally:
        server.close()
