"""Version of MQTT for a broker: 5, or 3.1.1 for a broker without 5.

A client of version 5 states its largest packet (Maximum Packet Size, MQTT 5, 3.1.2.11.4), and the
broker does not send longer ones. It also learns whether a command was retained (Retain As
Published, 3.8.3.1). A broker of 3.1.1 refuses version 5 (CONNACK 1; MQTT 3.1.1, 3.1.2-2),
disconnects, or misreads the properties and is silent: so a missing reply counts as a refusal. The
first version that gets a reply is used as long as the process runs.
"""

from __future__ import annotations

from typing import Any

import aiomqtt
from aiomqtt import ProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

ANSWER_S = 1.0
"""Timeout of the reply to CONNECT of version 5, on an open connection: a satellite round trip takes
0.6 s. A slower broker gets the full timeout with 3.1.1."""
_UNSUPPORTED = 132
"""Reason code Unsupported Protocol Version; paho translates 1 of 3.1.1 to it."""

_UNANSWERED = "Operation timed out"
"""Text of aiomqtt's error for a missing reply, also for a disconnection before it."""


class MqttVersion:
    """Protocol version of one broker, for a client that accepts packets of `most_bytes`."""

    def __init__(self, most_bytes: int) -> None:
        self.is_5 = True
        self._most_bytes = most_bytes
        self._other_tried = False

    def client(self, host: str, port: int, *, timeout: float, **options: Any) -> aiomqtt.Client:
        """Make an unconnected client of this version; `timeout` (s) limits the wait for replies."""
        if not self.is_5:
            return aiomqtt.Client(host, port, timeout=timeout, **options)
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = self._most_bytes
        return aiomqtt.Client(
            host,
            port,
            protocol=ProtocolVersion.V5,
            properties=properties,
            timeout=min(timeout, ANSWER_S),
            **options,
        )

    def connected(self) -> None:
        """Note that the broker supports this version."""
        self._other_tried = False

    def failed(self, error: aiomqtt.MqttError) -> bool:
        """Switch to the other version if this one may be the cause; True for an immediate retry."""
        code = error.rc if isinstance(error, aiomqtt.MqttCodeError) else None
        refused = getattr(code, "value", code) == _UNSUPPORTED
        if not (refused or str(error) == _UNANSWERED):
            return False
        self.is_5 = not self.is_5
        self._other_tried = not self._other_tried
        return self._other_tried

    async def subscribe(self, client: aiomqtt.Client, address: str) -> None:
        """Subscribe with QoS 1. Raises `MqttError`."""
        if self.is_5:
            options = SubscribeOptions(qos=1, retainAsPublished=True)
            await client.subscribe(address, options=options)
        else:
            await client.subscribe(address, 1)
