"""Serves Foxglove, Lichtblick and whoever speaks their WebSocket protocol; needs `websockets`.

Each viewer has a place for each of its subscriptions, in which a newer message replaces one that
has not been sent, and a task of its own: a slow one waits for itself alone. One that does not
answer a ping within 20 s is disconnected.

Source: Foxglove WebSocket Protocol v1 (`foxglove.websocket.v1`, and `foxglove.sdk.v1`, which is
alike in what is used here): serverInfo, advertise, subscribe, unsubscribe; binary message data is
opcode 1, subscription (u32), receive time (u64, ns), payload, little-endian.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import time
from collections import Counter, deque
from typing import Any

from drivers.base import DriverStatus
from fusiond.configuration.load import ConfigError
from fusiond.configuration.outputs import Foxglove
from fusiond.outputs.base import Surroundings
from fusiond.outputs.foxglove.channels import CHANNELS, Channel
from fusiond.outputs.messages.base import Message
from fusiond.outputs.port import Port
from fusiond.outputs.topics import Topic

try:
    from websockets import Subprotocol
    from websockets.asyncio.server import Server, ServerConnection, serve
    from websockets.exceptions import ConnectionClosed
except ImportError as error:  # the extra is not installed
    _MISSING: ImportError | None = error
else:
    _MISSING = None

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MOST_VIEWERS = 32
"""Each is a person who looks."""
_MOST_REQUEST_BYTES = 65536
_WAITING = 256
"""Messages from the tick to the task: some ten seconds at 20 Hz of all topics."""
_DATA = struct.Struct("<BIQ")
_OPCODE_DATA = 1
# A traceback for everyone who connects and speaks something else.
_LOG = logging.getLogger("fusiond.websockets")
_LOG.setLevel(logging.CRITICAL)
_BY_ID = {channel.id: channel for channel in CHANNELS}


class _Viewer:
    """One connection: subscriptions by their number, and what waits for each."""

    def __init__(self) -> None:
        self.subscriptions: dict[int, Channel] = {}
        self.waiting: dict[int, bytes] = {}
        self.ready = asyncio.Event()


class FoxgloveServer:
    """The protocol at `host:port`. Counters: `clients`, `clients_refused`, `sent`, `skipped`
    (replaced by a newer one before it was sent), `malformed`."""

    name = "foxglove"
    sets_clocks = True

    def __init__(self, section: Foxglove, around: Surroundings) -> None:
        if _MISSING is not None:
            raise ConfigError(f"outputs.foxglove: {_MISSING}: pip install 'fusiond[foxglove]'")
        self.nav_rate_hz = section.rate_hz
        self._vehicle = around.vehicle
        self._session = str(time.time_ns())
        self._queue: deque[tuple[Topic, Message]] = deque(maxlen=_WAITING)
        self._queued = asyncio.Event()
        self._latest: dict[Topic, Message] = {}
        self._viewers: set[_Viewer] = set()
        self.counters: Counter[str] = Counter()
        self.port = Port(self.name, section.host, section.port, around.on_event)

    def take(self, topic: Topic, message: Message) -> None:
        self._latest[topic] = message
        if self._viewers:
            self._queue.append((topic, message))
            self._queued.set()

    @property
    def status(self) -> DriverStatus:
        return self.port.status

    async def run(self) -> None:
        async with await self.port.open(self._listening):
            await self._distribute()

    async def _listening(self, host: str, port: int) -> Server:
        return await serve(
            self._serve,
            host,
            port,
            subprotocols=[Subprotocol(name) for name in PROTOCOLS],
            max_size=_MOST_REQUEST_BYTES,
            logger=_LOG,
            compression=None,  # a core's worth of it, for a local network
        )

    async def _distribute(self) -> None:
        """From the queue of the tick to the places of those who have subscribed."""
        while True:
            await self._queued.wait()
            self._queued.clear()
            while self._queue:
                topic, message = self._queue.popleft()
                for channel in (c for c in CHANNELS if c.topic is topic):
                    self._place(channel, message)
                await asyncio.sleep(0)  # a tick may be due

    def _place(self, channel: Channel, message: Message) -> None:
        wanted = [
            (viewer, number)
            for viewer in self._viewers
            for number, subscribed in viewer.subscriptions.items()
            if subscribed is channel
        ]
        payload = channel.payload(message) if wanted else None
        if payload is None:
            return
        for viewer, number in wanted:
            self._put(viewer, number, message, payload)

    def _put(self, viewer: _Viewer, number: int, message: Message, payload: bytes) -> None:
        t_ns = time.time_ns() if message.t_ms is None else message.t_ms * 1_000_000
        self.counters["skipped"] += number in viewer.waiting
        viewer.waiting[number] = _DATA.pack(_OPCODE_DATA, number, t_ns) + payload
        viewer.ready.set()

    # ------------------------------------------------------------------ a viewer

    async def _serve(self, connection: ServerConnection) -> None:
        if len(self._viewers) >= MOST_VIEWERS:
            self.counters["clients_refused"] += 1
            await connection.close(1013, "too many viewers")
            return
        viewer = _Viewer()
        self._viewers.add(viewer)
        self.counters["clients"] += 1
        self.port.serves(len(self._viewers))
        sending = asyncio.create_task(self._send(connection, viewer))
        try:
            async for request in connection:
                await self._asked(connection, viewer, request)
        except ConnectionClosed:
            pass
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            self._viewers.discard(viewer)
            self.port.serves(len(self._viewers))

    async def _send(self, connection: ServerConnection, viewer: _Viewer) -> None:
        await connection.send(json.dumps(self._greeting()))
        advertised = [channel.advertised() for channel in CHANNELS]
        await connection.send(json.dumps({"op": "advertise", "channels": advertised}))
        while True:
            await viewer.ready.wait()
            viewer.ready.clear()
            while viewer.waiting:
                number = next(iter(viewer.waiting))
                await connection.send(viewer.waiting.pop(number))
                self.counters["sent"] += 1

    def _greeting(self) -> dict[str, Any]:
        return {
            "op": "serverInfo",
            "name": f"fusiond {self._vehicle}",
            "capabilities": [],
            "supportedEncodings": [],
            "metadata": {},
            "sessionId": self._session,
        }

    async def _asked(
        self, connection: ServerConnection, viewer: _Viewer, request: str | bytes
    ) -> None:
        try:
            self._carry_out(viewer, json.loads(request))
        except (ValueError, TypeError, KeyError) as error:
            self.counters["malformed"] += 1
            text = f"not understood: {error!r}"
            await connection.send(json.dumps({"op": "status", "level": 1, "message": text}))

    def _carry_out(self, viewer: _Viewer, asked: dict[str, Any]) -> None:
        """Raises `ValueError`, `TypeError` or `KeyError` for what is no request."""
        if asked["op"] == "subscribe":
            for each in asked["subscriptions"]:
                number, channel = int(each["id"]), _BY_ID[each["channelId"]]
                if not 0 <= number < 2**32:
                    raise ValueError(f"subscription {number}")
                viewer.subscriptions[number] = channel
                last = self._latest.get(channel.topic)
                payload = None if last is None else channel.payload(last)
                if last is not None and payload is not None:
                    self._put(viewer, number, last, payload)
        elif asked["op"] == "unsubscribe":
            for number in asked["subscriptionIds"]:
                viewer.subscriptions.pop(number, None)
                viewer.waiting.pop(number, None)
        else:
            raise ValueError(f"op {asked['op']!r}")
