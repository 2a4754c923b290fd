"""`fusiond status` against a real broker: what a publisher of the daemon has left there."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from fusiond.commands.app import app
from fusiond.commands.status_report import duration, status_page
from fusiond.configuration.schema import Mqtt
from fusiond.navigation.solution import Mode
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.topics import CONSISTENCY, EVENT, HEALTH, NAV, STATUS
from tests.broker import Broker, free_port, listening
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S

REPEAT_S = 0.1


@asynccontextmanager
async def daemon(broker: Broker, vehicle: str, **status: Any) -> AsyncIterator[None]:
    """The daemon's own publisher, which says the examples again and again."""
    options = Mqtt(host="127.0.0.1", port=broker.port)
    publisher = MqttPublisher(options, vehicle, on_event=lambda *_: None)

    async def speak() -> None:
        publisher.publish(EVENT, EXAMPLES["event"])
        while True:
            publisher.publish(STATUS, EXAMPLES["status"].model_copy(update=status))
            for topic in (NAV, HEALTH, CONSISTENCY):
                publisher.publish(topic, EXAMPLES[topic.name])
            await asyncio.sleep(REPEAT_S)

    tasks = [asyncio.create_task(publisher.run()), asyncio.create_task(speak())]
    try:
        async with listening(broker, f"fusiond/{vehicle}/+") as (listener, _):
            await listener.until(
                lambda li: (
                    {m.topic.value.rsplit("/")[-1] for m in li.messages}
                    >= {"online", "status", "events", "health", "nav", "consistency"}
                )
            )
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def asked(*arguments: object) -> Result:
    command = ["status", "--wait", str(PATIENCE_S), *map(str, arguments)]
    return await asyncio.to_thread(CliRunner().invoke, app, command)


async def test_a_page_of_what_the_daemon_says(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with daemon(broker, "truck"):
            done = await asked("--mqtt", f"127.0.0.1:{broker.port}")
            assert done.exit_code == 0, done.output
            text = done.stdout
            for said in (
                "truck: fusiond 0.1.0, up 1 h 0 min, configuration 9f2c41d07be3",
                "NAVIGATING for 58 min 20 s: aided by gnss, rdss",
                "31.0254389 121.4412095 deg, 17.4 m; sigma n, e, d 0.90, 0.85, 1.70 m",
                "8.46 m/s towards 346 deg",
                "38.4 m horizontal, 21.1 m vertical",
                "recording /var/lib/fusiond/logs/truck_20261120T223307Z_5e0c1f9a_0001.mcap, 41.3",
                "UTC from gnss; system clock -0.012 s against GNSS",
                "FAULT       gnss velocity is off by 0.521 m/s, 0.081 at one sigma, north",
                "23:33:07 warning: rdss rdss_suppressed: the terminal's transmitter is suppressed",
            ):
                assert said in text
            lines = text.splitlines()
            (rdss,) = (k for k, line in enumerate(lines) if line.startswith("rdss"))
            assert "coloured" in lines[rdss]
            assert lines[rdss + 1] == "  no beam above level 2; refused 4 multi_value, 1 too_old"
            (gnss,) = (k for k, line in enumerate(lines) if line.startswith("gnss"))
            assert " ".join(lines[gnss].split()[1:3]) == "running, out"
            assert lines[gnss + 1].startswith("  gnss velocity is off by")
            assert all(len(line) <= 80 for line in (lines[rdss], lines[gnss]))
            piped = await asked("--mqtt", f"127.0.0.1:{broker.port}", "--json", "-")
            answer = json.loads(piped.stdout)
            assert answer["nav"]["lat_deg"] == EXAMPLES["nav"].lat_deg
            assert [e["code"] for e in answer["events"]["events"]] == ["rdss_suppressed"]
        gone = await asked("--mqtt", f"127.0.0.1:{broker.port}", "--json", "-")
        assert gone.exit_code == 69
        assert "truck is offline; last heard 2026-11-20T23:33:07.123Z: navigating" in gone.stderr
        assert json.loads(gone.stdout)["state"] == "offline"


async def test_without_a_solution_it_exits_1(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with daemon(
            broker, "van", mode=Mode.ALIGNING, why="Waiting for a first position fix"
        ):
            done = await asked("--mqtt", f"127.0.0.1:{broker.port}", "--vehicle", "van")
            assert done.exit_code == 1
            assert "ALIGNING for 58 min 20 s: Waiting for a first position fix" in done.stdout


async def test_which_of_two_vehicles(tmp_path: Path) -> None:
    config = tmp_path / "van.toml"
    with Broker(tmp_path) as broker:
        config.write_text(f'vehicle = "van"\n[mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n')
        async with daemon(broker, "van"), daemon(broker, "truck"):
            done = await asked("--mqtt", f"127.0.0.1:{broker.port}")
            assert done.exit_code == 69
            assert "--vehicle: which of truck, van?" in done.stderr
            done = await asked(config)
            assert done.exit_code == 0, done.output
            assert done.stdout.startswith("van: ")


async def test_online_but_silent(tmp_path: Path) -> None:
    """What a daemon that was stopped has left."""
    with Broker(tmp_path) as broker:
        async with listening(broker) as (_, client):
            status = EXAMPLES["status"].model_dump_json()
            for topic, payload in (("online", "online"), ("status", status)):
                await client.publish(f"fusiond/truck/{topic}", payload, qos=1, retain=True)
        done = await asked("--mqtt", f"127.0.0.1:{broker.port}", "--wait", "0.5")
        assert done.exit_code == 69
        assert "truck is online, but has said nothing for 0.5 s; last heard 2026" in done.stderr


async def test_no_daemon_and_no_broker(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        done = await asked("--mqtt", f"127.0.0.1:{broker.port}", "--wait", "0.5")
        assert done.exit_code == 69
        assert "the broker knows of no daemon: start one" in done.stderr
    port = free_port()
    done = await asked("--mqtt", f"127.0.0.1:{port}", "--json", "-")
    assert done.exit_code == 69
    assert f"no broker answers at 127.0.0.1:{port}" in done.stderr
    assert json.loads(done.stdout)["state"] == "no_broker"


@pytest.mark.parametrize("text", ["", "host:port", "a@b", "host:1/x", "host:99999"])
async def test_no_such_broker_can_be(text: str) -> None:
    assert (await asked("--mqtt", text)).exit_code == 2


def test_a_daemon_that_knows_nothing_yet() -> None:
    """Right after the start: no UTC, no position, no health."""
    unknown = dict.fromkeys(EXAMPLES["nav"].model_dump())
    status = EXAMPLES["status"].model_dump(mode="json") | {
        "mode": "waiting",
        "t_ms": None,
        "since_ms": None,
        "disk_free_mb": None,
        "recording_file": None,
        "recording": "off",
        "uptime_s": 0.4,
    }
    lines = status_page({"vehicle": "truck", "status": status, "nav": unknown})
    assert "up 0.4 s" in lines[0]
    assert lines[1].startswith("WAITING for a time not known before UTC is")
    assert "position    none yet" in lines


def test_duration() -> None:
    said = [duration(s) for s in (0.0, 59.94, 60.0, 3_599.9, 90_061.0)]
    assert said == ["0.0 s", "59.9 s", "1 min 0 s", "59 min 59 s", "1 d 1 h"]
