"""Flood protection of subscriptions: publications are counted before they are parsed.

A broker forwards others' publications at any rate, on the connection that also carries our
confirmations. Behind a hundred thousand commands a confirmation comes seconds late, and meanwhile
QoS 0 messages are withheld, since they might be lost unnoticed. Reading faster does not help,
reading more slowly makes it worse. So a flooded client unsubscribes, drops what is already on its
way, and subscribes again later.

Little is on its way then, since the kernel buffers only `HELD_BYTES` instead of megabytes.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from typing import Any

import aiomqtt

from drivers.base import Backoff
from fusiond.outputs.client_rate_limits import Bucket, Rate

MESSAGES = Rate(100.0, 500.0)
"""Limit of messages. A message costs 0.1 ms until it is refused: 100 a second are a hundredth of a
core. `command_intake` executes at most five commands a second, twenty at once."""
BYTES = Rate(65_536.0, 131_072.0)
"""Limit of bytes: 16 of the longest commands a second, 32 at once (`MAX_PAYLOAD_BYTES`)."""
QUIET_S, LONGEST_QUIET_S = 10.0, 60.0
"""First pause after a flood, and the longest; each further flood doubles the pause."""
PEACE_S = 60.0
"""Time without a flood after which the next pause is the first one again."""


class Incoming:
    """Publications that arrive on one connection. `counters["mqtt_flooded"]` counts those dropped
    unread."""

    def __init__(self, client: aiomqtt.Client, counters: Counter[str], quiet: Backoff) -> None:
        self._counters = counters
        self._quiet = quiet
        self._flooded = asyncio.Event()
        self._restart()
        paho = client._client  # aiomqtt has no hook before it queues a message
        self._on_message: Any = paho.on_message
        paho.on_message = self._count

    def _count(self, paho: Any, userdata: Any, message: Any) -> None:
        now_ns = time.perf_counter_ns()
        self._messages.spend(1.0, now_ns)
        self._bytes.spend(len(message.payload), now_ns)
        if self._messages.empty(now_ns) or self._bytes.empty(now_ns) or self._flooded.is_set():
            self._counters["mqtt_flooded"] += 1
            self._flooded.set()
        else:
            self._on_message(paho, userdata, message)

    async def flood(self) -> float:
        """Wait for a flood; return how long to pause the subscriptions, s."""
        await self._flooded.wait()
        if time.monotonic() - self._since_s > PEACE_S:
            self._quiet.reset()
        return self._quiet.next()

    def over(self) -> None:
        """End the pause."""
        self._flooded.clear()
        self._restart()

    def _restart(self) -> None:
        self._since_s, now_ns = time.monotonic(), time.perf_counter_ns()
        self._messages, self._bytes = Bucket(MESSAGES, now_ns), Bucket(BYTES, now_ns)


def quiet() -> Backoff:
    """Backoff of the pauses after floods."""
    return Backoff(first_s=QUIET_S, longest_s=LONGEST_QUIET_S)
