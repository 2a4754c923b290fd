"""The publisher against a real Mosquitto."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest

from fusiond.configuration.schema import Mqtt
from fusiond.outputs.topics import CALIBRATION, EVENT, HEALTH, NAV, STATUS
from tests.broker import Broker, listening
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.publisher import BASE, Running, event, heard, nav, options, running
from tests.patience import PATIENCE_S


async def test_every_topic_arrives_and_shutdown_says_offline(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with listening(broker) as (listener, _):
            async with running(options(broker)) as it:
                p = it.publisher
                p.publish(NAV, EXAMPLES["nav"])
                p.publish(STATUS, EXAMPLES["status"])
                p.publish(HEALTH, EXAMPLES["health"])
                p.publish(CALIBRATION, EXAMPLES["calibration"])
                p.publish(EVENT, EXAMPLES["event"])
                for topic in (NAV, STATUS, HEALTH, CALIBRATION, EVENT):
                    payload = (await listener.until(heard(topic.name)))[0]
                    assert topic.message.model_validate_json(payload) == EXAMPLES[topic.name]
                assert heard("online")(listener) == [b"online"]
                p.publish(EVENT, event("last words"))
            await listener.until(lambda li: b"offline" in heard("online")(li))
            assert json.loads(heard("event")(listener)[-1])["text"] == "last words"
        async with listening(broker) as (late, _):
            await late.until(lambda li: len(li.messages) >= 5)
            kept = {m.topic.value.removeprefix(f"{BASE}/") for m in late.messages if m.retain}
            assert kept == {"online", "status", "health", "calibration", "events"}
            last = json.loads(heard("events")(late)[0])["events"]
            assert [e["text"] for e in last] == [EXAMPLES["event"].text, "last words"]
        assert it.publisher.counters["mqtt_dropped"] == 0
        assert it.publisher.counters["mqtt_reconnects"] == 0


DAEMON = """
import asyncio, sys
from fusiond.configuration.schema import Mqtt
from fusiond.outputs.mqtt import MqttPublisher

async def main():
    options = Mqtt(host="127.0.0.1", port=int(sys.argv[1]))
    await MqttPublisher(options, "truck", on_event=print).run()

asyncio.run(main())
"""


async def test_will_says_offline_when_the_daemon_dies(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with listening(broker) as (listener, _):
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-c", DAEMON, str(broker.port), stdout=asyncio.subprocess.DEVNULL
            )
            await listener.until(heard("online"))
            process.kill()
            await listener.until(lambda li: heard("online")(li) == [b"online", b"offline"])
            await process.wait()


async def test_slow_broker_gets_the_newest_and_the_rest_is_counted(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    async with running(options(broker, queue=3)) as it:
        for k in range(10):
            it.publisher.publish(NAV, nav(float(k)))
            it.publisher.publish(EVENT, event(str(k)))
        assert it.publisher.counters["mqtt_dropped"] == 9 + 7
        await it.until(lambda r: "mqtt_absent" in r.codes())
        assert it.publisher.status.state == "absent"
        with broker:
            async with listening(broker) as (listener, _):
                await listener.until(lambda li: len(heard("event")(li)) == 3)
                texts = [json.loads(p)["text"] for p in heard("event")(listener)]
                assert texts == ["7", "8", "9"]
            assert it.publisher.status.state == "running"
            assert it.codes() == ["mqtt_absent", "mqtt_connected"]


async def test_broker_killed_and_restarted(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker)) as it:
            it.publisher.publish(STATUS, EXAMPLES["status"])
            it.publisher.publish(CALIBRATION, EXAMPLES["calibration"])
            async with listening(broker) as (listener, _):
                await listener.until(heard("status"))
                await listener.until(heard("calibration"))
            broker.kill()
            await it.until(lambda r: "mqtt_lost" in r.codes())
            it.publisher.publish(EVENT, event("while it was away"))
            broker.start()
            async with listening(broker) as (listener, _):
                await listener.until(heard("event"))
                # The broker came back empty: presence, status and calibration are there again.
                assert heard("online")(listener)[-1] == b"online"
                await listener.until(heard("status"))
                await listener.until(heard("calibration"))
            assert it.publisher.counters["mqtt_reconnects"] == 1


async def test_frozen_broker_is_noticed_and_costs_no_tick(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker, keepalive_s=2)) as it:
            it.publisher.publish(STATUS, EXAMPLES["status"])
            async with listening(broker) as (listener, _):
                await listener.until(heard("status"))
            broker.freeze()
            ticks = 0

            def lost(r: Running) -> bool:
                nonlocal ticks
                ticks += 1
                r.publisher.publish(NAV, nav(float(ticks)))
                return r.publisher.status.state == "absent"

            await it.until(lost)
            await it.until(lambda r: lost(r) and ticks > 300)
            dropped = it.publisher.counters["mqtt_dropped"]
            assert dropped > 0
            broker.thaw()
            async with listening(broker) as (listener, _):
                await it.until(lambda r: not lost(r))
                newest = f"{float(ticks)}".encode()
                await listener.until(lambda li: any(newest in p for p in heard("nav")(li)))
                await listener.until(lambda li: heard("online")(li)[-1:] == [b"online"])
            assert it.publisher.counters["mqtt_reconnects"] == 1
            published = it.publisher.counters["mqtt_published"]
            assert published + it.publisher.counters["mqtt_dropped"] >= ticks


async def test_shutdown_with_a_frozen_broker_ends(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with asyncio.timeout(PATIENCE_S):
            async with running(options(broker, keepalive_s=600)) as it:
                await it.until(lambda r: r.publisher.counters["mqtt_published"])
                broker.freeze()
                it.publisher.publish(EVENT, event("nobody hears this"))


async def test_heartbeat_keeps_an_idle_connection(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker, keepalive_s=1)) as it, listening(broker) as (li, _):
            await li.until(lambda li: len(heard("online")(li)) >= 4)
            it.publisher.publish(STATUS, EXAMPLES["status"])
            await li.until(lambda li: len(heard("status")(li)) >= 4)
            assert it.codes() == ["mqtt_connected"]


async def test_supervisor_is_a_plain_task(tmp_path: Path) -> None:
    """Wrong host names and refused ports are retried, never raised."""
    it = Running(Mqtt(host="name.invalid", port=1))
    task = asyncio.create_task(it.publisher.run())
    await it.until(lambda r: "mqtt_absent" in r.codes())
    assert not task.done()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
