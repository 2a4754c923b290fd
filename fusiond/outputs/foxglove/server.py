"""WebSocket server for Foxglove, Lichtblick and compatible viewers; needs `websockets`.

A message is encoded once for all viewers. For each of its subscriptions a viewer has one place, in
which a newer message replaces an unsent one: so a slow viewer delays only itself, and only its
bytes in flight occupy memory. A viewer that reads nothing for half a minute, or whose connection is
dead, is disconnected (`fusiond.outputs.tcp`).

A browser sends the page's `Origin`: pages of this computer and of `origins` may connect.

Source: Foxglove WebSocket Protocol v1 (`foxglove.websocket.v1`, and `foxglove.sdk.v1`, which is the
same for this server): serverInfo, advertise, subscribe, unsubscribe; binary message data is opcode
1, subscription (u32), receive time (u64, ns), payload, little-endian.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import deque
from functools import cached_property

from drivers.base import DriverStatus
from fusiond.configuration.load import ConfigError
from fusiond.configuration.outputs import Foxglove
from fusiond.files.install_extra import install_command
from fusiond.outputs.base import Surroundings
from fusiond.outputs.foxglove.channels import CHANNELS, Channel
from fusiond.outputs.listening_port import Port
from fusiond.outputs.messages.base import Message
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.tcp import Client, TcpServer
from fusiond.outputs.topics import Topic

try:
    from fusiond.outputs.foxglove.viewer import Data, Viewer, text_frame
except ImportError as error:  # the extra is not installed
    _MISSING: ImportError | None = error
else:
    _MISSING = None

MOST_VIEWERS = 32
"""Most viewers, each of whom is a person."""
MOST_EVENTS = 32
"""Events that may wait for the task; the latest of every other topic does."""
ORIGIN_EVENT_S = 60.0
"""Between two events about pages that were refused."""


class FoxgloveServer:
    """The protocol at `host:port`. Counters: those of `TcpServer`; `skipped` are messages that were
    replaced by a newer one before they were sent; `subscriptions_refused`, `origins_refused`.

    `on_event` receives `foxglove_origin_refused`, once a minute at most.
    """

    name = "foxglove"
    sets_clocks = True

    def __init__(self, section: Foxglove, around: Surroundings) -> None:
        if _MISSING is not None:
            raise ConfigError(f"outputs.foxglove: {_MISSING}: {install_command('foxglove')}")
        self.nav_rate_hz = section.rate_hz
        self.origins = frozenset(section.origins)
        self._vehicle = around.vehicle
        self._session = str(time.time_ns())
        self._waiting: dict[Topic, Message] = {}
        self._events: deque[tuple[Topic, Message]] = deque(maxlen=MOST_EVENTS)
        self._queued = asyncio.Event()
        self._latest: dict[Topic, Message] = {}
        self._encoded: dict[int, Data | None] = {}
        self._origin_logged_s: float | None = None
        self.port = Port(self.name, section.host, section.port, around.on_event)
        self.server = TcpServer(self.name, self.port, around.guests, self._greet, MOST_VIEWERS)
        self.counters = self.server.counters

    def publish(self, topic: Topic, message: Message) -> None:
        self._latest[topic] = message
        if not self.server.clients:
            self._encoded.clear()
            return
        if isinstance(message, EventMessage):
            self._events.append((topic, message))
        else:
            self._waiting[topic] = message
        self._queued.set()

    @property
    def status(self) -> DriverStatus:
        return self.port.status

    async def run(self) -> None:
        await asyncio.to_thread(lambda: self.greeting)  # the schemas of all topics take 0.05 s
        async with asyncio.TaskGroup() as group:
            group.create_task(self.server.run())
            group.create_task(self._distribute())

    def last(self, channel: Channel) -> Data | None:
        """Newest message of a channel, encoded; None without one to send."""
        if channel.id not in self._encoded:
            message = self._latest.get(channel.topic)
            self._encoded[channel.id] = None if message is None else _data(channel, message)
        return self._encoded[channel.id]

    @cached_property
    def greeting(self) -> bytes:
        """Frames of the first messages to a viewer: server information and channels."""
        hello = {
            "op": "serverInfo",
            "name": f"fusiond {self._vehicle}",
            "capabilities": [],
            "supportedEncodings": [],
            "metadata": {},
            "sessionId": self._session,
        }
        channels = [channel.advertised() for channel in CHANNELS]
        advertised = {"op": "advertise", "channels": channels}
        return text_frame(json.dumps(hello)) + text_frame(json.dumps(advertised))

    def refuse_origin(self, origin: str) -> None:
        """Count and report a page of a site that may not connect."""
        self.counters["origins_refused"] += 1
        now_s = time.monotonic()
        if self._origin_logged_s is None or now_s - self._origin_logged_s > ORIGIN_EVENT_S:
            self._origin_logged_s = now_s
            shown = ascii(origin[:80])
            self.port.report("origin_refused", f"a page of {shown}: outputs.foxglove.origins")

    def _greet(self, client: Client) -> Viewer:
        client.request_due = True
        return Viewer(self, client)

    async def _distribute(self) -> None:
        """Pass the messages that ticks have left to the viewers."""
        while True:
            await self._queued.wait()
            self._queued.clear()
            while self._events or self._waiting:
                if self._events:
                    topic, message = self._events.popleft()
                else:
                    topic = next(iter(self._waiting))
                    message = self._waiting.pop(topic)
                self._place(topic, message)
                await asyncio.sleep(0)  # let a due tick run

    def _place(self, topic: Topic, message: Message) -> None:
        for channel in CHANNELS:
            if channel.topic.name != topic.name:
                continue
            self._encoded.pop(channel.id, None)
            wanted = [
                viewer
                for client in self.server.clients
                if isinstance(viewer := client.session, Viewer) and channel.id in viewer.channels
            ]
            data = _data(channel, message) if wanted else None
            if data is None:
                continue
            self._encoded[channel.id] = data
            for viewer in wanted:
                viewer.put(channel, data)


def _data(channel: Channel, message: Message) -> Data | None:
    payload = channel.payload(message)
    if payload is None:
        return None
    t_ns = time.time_ns() if message.t_ms is None else message.t_ms * 1_000_000
    return Data(t_ns, payload)
