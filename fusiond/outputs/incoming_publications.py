"""Subscriptions to publications of others, counted before they are parsed.

A broker forwards publications at any rate on the connection of our own confirmations: behind a
hundred thousand commands a confirmation is seconds late, and QoS 0 messages are withheld meanwhile,
since they may be lost unseen. Reading faster does not help, reading more slowly makes it worse. A
flooded client therefore unsubscribes, drops what was already sent, and subscribes again later.

Little is in flight at that moment, since the kernel buffers only `HELD_BYTES` for us instead of
megabytes.
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
"""Five commands a second are carried out, twenty at once (`command_intake`). A message costs 0.1 ms
until its row is refused: so many a second are a hundredth of a core."""
BYTES = Rate(65_536.0, 131_072.0)
"""Sixteen of the longest commands a second, thirty-two at once (`MAX_PAYLOAD_BYTES`)."""
QUIET_S, LONGEST_QUIET_S = 10.0, 60.0
"""Pause after a flood, doubled by each further one."""
PEACE_S = 60.0
"""Time without a flood after which the pause is the first again."""


class Incoming:
    """Publications of one connection. `counters["mqtt_flooded"]` counts messages dropped unread."""

    def __init__(self, client: aiomqtt.Client, counters: Counter[str], quiet: Backoff) -> None:
        self._counters = counters
        self._quiet = quiet
        self._flooded = asyncio.Event()
        self._restart()
        paho = client._client  # aiomqtt has no place to look at a message before it is queued
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
        """Wait for a flood; return the pause of the subscriptions, s."""
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
    """Pauses after floods."""
    return Backoff(first_s=QUIET_S, longest_s=LONGEST_QUIET_S)
