"""What tests of the MQTT publisher share: one at work, its messages, what a listener heard."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from fusiond.configuration.schema import Mqtt
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.mqtt import MqttPublisher
from tests.broker import Broker, Listener
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.old_broker import OldBroker
from tests.patience import PATIENCE_S

UTC_NS = 1_795_217_587_123_456_789
BASE = "fusiond/truck"


def options(broker: Broker | OldBroker, **more: Any) -> Mqtt:
    """By default a busy host has ten seconds for each confirmation (`keepalive_s` is 20)."""
    return Mqtt(host="127.0.0.1", port=broker.port, **more)


class Running:
    """A publisher at work, and the events it reported."""

    def __init__(self, options: Mqtt, **more: Any) -> None:
        self.events: list[tuple[str, str]] = []
        self.publisher = MqttPublisher(
            options,
            "truck",
            on_event=lambda code, text: self.events.append((code, text)),
            utc_now=lambda: UTC_NS,
            **more,
        )

    def codes(self) -> list[str]:
        return [code for code, _ in self.events]

    async def until(self, condition: Callable[[Running], Any]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not condition(self):  # noqa: ASYNC110 - the publisher has no such event
                await asyncio.sleep(0.01)


@asynccontextmanager
async def running(options: Mqtt, **more: Any) -> AsyncIterator[Running]:
    it = Running(options, **more)
    task = asyncio.create_task(it.publisher.run())
    try:
        yield it
        assert not task.done(), task
    finally:
        task.cancel()
        await asyncio.wait({task}, timeout=PATIENCE_S)
        assert task.cancelled()


def nav(height_m: float) -> NavMessage:
    example = EXAMPLES["nav"]
    assert isinstance(example, NavMessage)
    return example.model_copy(update={"height_m": height_m})


def event(text: str) -> EventMessage:
    example = EXAMPLES["event"]
    assert isinstance(example, EventMessage)
    return example.model_copy(update={"text": text})


def heard(topic: str) -> Callable[[Listener], list[bytes]]:
    return lambda listener: listener.payloads(f"{BASE}/{topic}")
