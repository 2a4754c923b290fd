"""Version 5 of MQTT where the broker has it, 3.1.1 where it has not: Mosquitto, amqtt, and brokers
that refuse, hang up or say nothing."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import aiomqtt
import pytest

from fusiond.configuration.schema import Mqtt
from fusiond.demo.broker import DemoBroker
from fusiond.outputs import mqtt_version
from fusiond.outputs.commands import Command
from fusiond.outputs.mqtt_version import MqttVersion
from fusiond.outputs.topics import EVENT
from tests.broker import Broker, listening
from tests.outputs.old_broker import HANGS_UP, REFUSES, SILENT, old_broker
from tests.outputs.publisher import BASE, Running, event, heard, options, running
from tests.patience import PATIENCE_S, until


def _options(port: int) -> Mqtt:
    return Mqtt(host="127.0.0.1", port=port, keepalive_s=60, commands=("reset_filter",))


def _done(command: Command) -> str:
    return "done"


@pytest.mark.parametrize("answer", [REFUSES, HANGS_UP, SILENT], ids=["refuses", "hangs", "silent"])
async def test_a_broker_of_3_1_1_is_spoken_to_in_its_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes | None
) -> None:
    """Version 5 is tried once; what connected is kept when the connection is lost."""
    monkeypatch.setattr(mqtt_version, "ANSWER_S", 0.2)
    with Broker(tmp_path) as broker:
        async with (
            listening(broker) as (listener, client),
            old_broker(broker, answer) as old,
            running(_options(old.port), on_command=_done) as it,
        ):
            await it.until(lambda r: r.codes() == ["mqtt_connected"])
            assert old.versions == [5, 4]
            it.publisher.publish(EVENT, event("by 3.1.1"))
            await listener.until(heard("event"))
            while not heard("reply")(listener):
                await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"1"}', qos=1)
                await asyncio.sleep(0.1)
            old.drop()
            await it.until(lambda r: r.codes()[1:] == ["mqtt_lost", "mqtt_connected"])
            assert old.versions == [5, 4, 4]
            assert it.publisher.counters["mqtt_reconnects"] == 1


async def test_a_broker_that_is_known_to_be_of_3_1_1_is_not_asked_for_5(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with old_broker(broker, SILENT) as old:
            it = Running(_options(old.port))
            it.publisher.begin_with_3_1_1()
            task = asyncio.create_task(it.publisher.run())
            await it.until(lambda r: r.codes() == ["mqtt_connected"])
            task.cancel()
            await asyncio.wait({task}, timeout=PATIENCE_S)
            assert old.versions == [4]


async def test_the_broker_of_the_demo_is_spoken_to_in_its_version() -> None:
    """amqtt waits for the end of a CONNECT of version 5 that it takes for one of 3.1.1."""
    with DemoBroker() as demo:
        async with running(_options(demo.port)) as it:
            await it.until(lambda r: r.codes() == ["mqtt_connected"])
            it.publisher.publish(EVENT, event("taken"))
            await it.until(lambda r: r.publisher.counters["mqtt_published"] >= 2)


async def test_oversized_packets_stay_with_a_version_5_broker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Longer than we answer to but short of the limit it comes, and its sender is told why."""
    monkeypatch.setattr(mqtt_version, "ANSWER_S", PATIENCE_S)  # a busy broker is of version 5, too
    with Broker(tmp_path) as broker:
        async with (
            listening(broker) as (listener, client),
            old_broker(broker, b"5") as relay,
            running(_options(relay.port), on_command=_done) as it,
        ):
            await listener.until(heard("online"))
            command = f"{BASE}/cmd/reset_filter"
            while not heard("reply")(listener):
                await client.publish(command, b'{"id":"subscribed"}', qos=1)
                await asyncio.sleep(0.1)
            assert relay.versions == [5]
            before = relay.bytes_out
            await client.publish(command, b"x" * 1_000_000, qos=1)
            await client.publish(command, b"y" * 60_000, qos=1)

            def refused() -> bool:
                replies = [json.loads(reply) for reply in heard("reply")(listener)]
                return any("60000 bytes or more" in reply["text"] for reply in replies)

            await listener.until(lambda _: refused())
            assert 60_000 < relay.bytes_out - before < 100_000
            assert it.publisher.counters["mqtt_reconnects"] == 0


async def test_a_command_that_is_to_be_kept_is_refused_while_we_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A broker of version 5 says so of it; one of 3.1.1 only to who comes later."""
    monkeypatch.setattr(mqtt_version, "ANSWER_S", PATIENCE_S)
    with Broker(tmp_path) as broker:
        async with (
            listening(broker) as (listener, client),
            running(_options(broker.port), on_command=_done) as it,
        ):
            await listener.until(heard("online"))
            command = f"{BASE}/cmd/reset_filter"
            while not heard("reply")(listener):
                await client.publish(command, b'{"id":"kept"}', qos=1, retain=True)
                await asyncio.sleep(0.1)
            assert not json.loads(heard("reply")(listener)[0])["ok"]
            assert it.publisher.counters["mqtt_commands_retained"] >= 1
            await client.publish(command, b"", qos=1, retain=True)


async def test_a_frozen_broker_is_asked_both_ways_and_then_said_to_be_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt_version, "ANSWER_S", 0.2)
    with Broker(tmp_path) as broker:
        broker.freeze()
        async with running(options(broker, keepalive_s=2)) as it:
            await it.until(lambda r: r.codes()[:1] == ["mqtt_absent"])
            broker.thaw()
            await it.until(lambda r: "mqtt_connected" in r.codes())


async def test_an_attempt_that_is_cancelled_ends_in_silence(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon is told to stop while the broker has yet to answer."""
    monkeypatch.setattr(mqtt_version, "ANSWER_S", PATIENCE_S)
    with Broker(tmp_path) as broker:
        async with old_broker(broker, SILENT) as old:
            async with running(_options(old.port)) as it:
                await until(lambda: old.versions == [5])
                await asyncio.sleep(0.05)
                assert not it.events
            await asyncio.sleep(0.05)
    assert not caplog.records


def test_other_refusals_keep_the_protocol_version() -> None:
    version = MqttVersion(1000)
    for error in (
        aiomqtt.MqttCodeError(135, "Not authorized"),
        aiomqtt.MqttError("[Errno 111] Connection refused"),
        aiomqtt.MqttError("[Errno 110] Connection timed out"),
    ):
        assert not version.failed(error)
        assert version.is_5
    assert version.failed(aiomqtt.MqttCodeError(132))
    assert not version.is_5
    assert not version.failed(aiomqtt.MqttError("Operation timed out"))
    assert version.is_5
