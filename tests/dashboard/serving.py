"""A dashboard at work on a free port, and browsers made of a WebSocket."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import websockets
from websockets.asyncio.client import ClientConnection, connect

from fusiond.dashboard.serve import PageAddress, listening_socket, serve
from fusiond.dashboard.vehicles import Hub
from fusiond.outputs.topics import TOPICS
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S

NAMES = [topic.name for topic in TOPICS if topic.name in EXAMPLES]


def payload(topic: str, **changed: Any) -> bytes:
    """The example of docs/mqtt.md with some figures changed."""
    message = EXAMPLES[topic].model_copy(update=changed)
    return bytes(message.model_dump_json().encode())


def said(topic: str, **changed: Any) -> Any:
    return json.loads(payload(topic, **changed))


async def _nothing() -> None:
    await asyncio.Event().wait()


@asynccontextmanager
async def at_work(
    hub: Hub,
    source: Callable[[], Coroutine[Any, Any, None]] = _nothing,
    token: str | None = None,
    base_map: Path | None = None,
) -> AsyncIterator[str]:
    """Its address as HOST:PORT."""
    serving = PageAddress(port=0, token=token, base_map=base_map)
    listener = listening_socket(serving)
    stop = asyncio.Event()
    task = asyncio.create_task(serve(hub, source, serving, listener, stop))
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        assert not task.done(), task
    finally:
        stop.set()
        await asyncio.wait_for(task, PATIENCE_S)


class Browser:
    """What a page has heard: the last message of each topic, all rows, the last link."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.hello: dict[str, Any] = {}
        self.frames = 0
        self.latest: dict[str, dict[str, Any]] = {}
        self.rows: dict[str, list[Any]] = {}
        self.last: dict[str, Any] = {}
        self.answers: list[dict[str, Any]] = []

    def receive(self, text: str | bytes) -> None:
        frame = json.loads(text)
        if "hello" in frame:
            self.hello = frame["hello"]
            return
        self.frames += 1
        if frame.get("first"):
            self.latest, self.rows = {}, {}
        self.last = frame
        self.latest.update(frame["messages"])
        for kind, rows in frame["rows"].items():
            self.rows.setdefault(kind, []).extend(rows)
        self.answers += frame["answers"]

    async def until(self, condition: Callable[[Browser], Any]) -> Any:
        """The first true value of `condition(self)`."""
        async with asyncio.timeout(PATIENCE_S):
            while not (value := condition(self)):
                self.receive(await self.connection.recv())
        return value

    async def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to a request."""
        before = len(self.answers)
        await self.connection.send(json.dumps(request))
        await self.until(lambda b: len(b.answers) > before)
        return self.answers[-1]


@asynccontextmanager
async def browsing(address: str, **options: Any) -> AsyncIterator[Browser]:
    async with connect(f"ws://{address}/watch", **options) as connection:
        yield Browser(connection)


async def refused(address: str, **options: Any) -> int:
    """The HTTP status with which a WebSocket is refused."""
    try:
        async with connect(f"ws://{address}/watch", **options):
            return 101
    except websockets.InvalidStatus as error:
        return error.response.status_code
