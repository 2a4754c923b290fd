"""What tests of the outputs share: one at work, and a client that speaks TCP to it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from fusiond.outputs.base import Output, Surroundings
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.topics import NAV
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S, until

GEOID_M = 11.3


class Around:
    """The rest of the daemon, as an output sees it."""

    def __init__(self, **more: Any) -> None:
        self.events: list[tuple[str, str]] = []
        self.surroundings = Surroundings(
            **{
                "vehicle": "truck",
                "on_event": lambda code, text: self.events.append((code, text)),
                "geoid_separation_m": GEOID_M,
                **more,
            }
        )


@asynccontextmanager
async def at_work(output: Output) -> AsyncIterator[None]:
    """Its task runs, and has not failed in the end."""
    task = asyncio.create_task(output.run())
    try:
        await until(lambda: output.status.state == "running" or task.done())
        yield
        assert not task.done(), task
    finally:
        task.cancel()
        await asyncio.wait({task}, timeout=PATIENCE_S)
        assert task.cancelled(), task


def nav(**changed: Any) -> NavMessage:
    """The `nav` of docs/mqtt.md with some figures changed."""
    example = EXAMPLES["nav"]
    assert isinstance(example, NavMessage)
    return example.model_copy(update=changed)


@asynccontextmanager
async def connected(address: tuple[str, int]) -> AsyncIterator[TcpClient]:
    """A client that has connected."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        yield TcpClient(reader, writer)
    finally:
        writer.transport.abort()


class TcpClient:
    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def line(self) -> bytes:
        """The next line, without its CR LF; fails where the line ends otherwise."""
        async with asyncio.timeout(PATIENCE_S):
            line = await self.reader.readline()
        assert line.endswith(b"\r\n"), line
        return line[:-2]

    async def ended(self) -> None:
        """Wait for the end that the server makes."""
        async with asyncio.timeout(PATIENCE_S):
            try:
                while await self.reader.read(65536):
                    pass
            except ConnectionResetError:
                pass


async def feed(output: Output, done: Callable[[], bool], **changed: Any) -> None:
    """Epoch after epoch, each taken before the next, until `done`."""
    async with asyncio.timeout(PATIENCE_S):
        while not done():
            output.publish(NAV, nav(**changed))
            await asyncio.sleep(0.001)
