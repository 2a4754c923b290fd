"""Link of the dashboard to an MQTT broker: receives all vehicles, reconnects, sends commands."""

from __future__ import annotations

import asyncio
import json
import logging
import ssl
from dataclasses import dataclass

import aiomqtt

from fusiond.dashboard.message_parser import topic_parsers
from fusiond.dashboard.vehicles import LARGEST_BYTES, Hub
from fusiond.outputs.oversized_packets import SOCKET_OPTIONS, limit

BASE = "fusiond"
RETRY_S = 1.0
"""Interval of attempts: a person is waiting, and the broker is on this computer or near."""
KEEPALIVE_S = 5
"""MQTT keepalive; a silent broker is noticed after one and a half of it."""
MOST_WAITING = 1000
"""Most messages in the client's queue: ten seconds at 100 Hz; the client discards more."""
COMMANDS_WAITING = 8
_LOG = logging.getLogger("fusiond.dashboard.mqtt")
_LOG.setLevel(logging.ERROR)


@dataclass(frozen=True, slots=True)
class Access:
    """Address of the broker and credentials."""

    host: str = "localhost"
    port: int = 1883
    username: str | None = None
    password: str | None = None
    tls: ssl.SSLContext | None = None


class Broker:
    """Source of a hub: messages of a broker. `send_command` queues a command; beyond
    `COMMANDS_WAITING` waiting ones are dropped."""

    def __init__(self, access: Access, hub: Hub) -> None:
        self._access = access
        self._hub = hub
        self._commands: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue(COMMANDS_WAITING)

    def send_command(self, vehicle: str, name: str, request_id: str) -> None:
        """Queue a command for a vehicle."""
        if self._commands.full():
            self._commands.get_nowait()
        payload = json.dumps({"id": request_id}).encode()
        self._commands.put_nowait((f"{BASE}/{vehicle}/cmd/{name}", payload))

    async def listen(self) -> None:
        """Receive messages until cancelled."""
        while True:
            try:
                async with self._client() as client:
                    named = {"fleet": "fleet/+"}  # of each card one
                    shown = ("online", *(named.get(topic, topic) for topic in topic_parsers()))
                    await client.subscribe([(f"{BASE}/+/{topic}", 0) for topic in shown])
                    self._hub.linked("up")
                    await self._serve(client)
            except aiomqtt.MqttError as error:
                self._hub.linked("lost", str(error))
            await asyncio.sleep(RETRY_S)

    def _client(self) -> aiomqtt.Client:
        access = self._access
        client = aiomqtt.Client(
            access.host,
            access.port,
            username=access.username,
            password=access.password,
            tls_context=access.tls,
            keepalive=KEEPALIVE_S,
            max_queued_incoming_messages=MOST_WAITING,
            logger=_LOG,
            socket_options=SOCKET_OPTIONS,
        )
        limit(client, LARGEST_BYTES)
        return client

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Run both tasks until the connection fails."""
        tasks = [asyncio.create_task(self._listen(client)), asyncio.create_task(self._ask(client))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()

    async def _listen(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            levels = message.topic.value.split("/")
            if isinstance(message.payload, bytes):
                topic = "/".join(levels[2:])
                self._hub.receive(levels[1], topic, message.payload, message.retain)

    async def _ask(self, client: aiomqtt.Client) -> None:
        while True:
            topic, payload = await self._commands.get()
            await client.publish(topic, payload, qos=1)
