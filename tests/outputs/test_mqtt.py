"""The publisher against a real Mosquitto."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Mqtt
from fusiond.outputs.command_intake import BURST, CommandIntake
from fusiond.outputs.commands import Command, CommandRefusedError, SetPosition
from fusiond.outputs.messages.event import EventMessage
from fusiond.outputs.messages.nav import NavMessage
from fusiond.outputs.mqtt import MqttPublisher
from fusiond.outputs.reconnecting import (
    LONGEST_CONTESTED_S,
    PEACE_S,
    TAKEN_COUNT,
    Reconnecting,
)
from fusiond.outputs.topics import CALIBRATION, EVENT, HEALTH, NAV, STATUS
from tests.broker import Broker, Listener, listening
from tests.outputs.messages_examples import EXAMPLES
from tests.patience import PATIENCE_S

UTC_NS = 1_795_217_587_123_456_789
BASE = "fusiond/truck"


def options(broker: Broker, **more: Any) -> Mqtt:
    return Mqtt(host="127.0.0.1", port=broker.port, **{"keepalive_s": 2, **more})


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


# ------------------------------------------------------------------ publishing


async def test_every_topic_arrives_and_shutdown_says_offline(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with listening(broker) as (listener, _):
            async with running(options(broker)) as it:
                p = it.publisher
                p.take(NAV, EXAMPLES["nav"])
                p.take(STATUS, EXAMPLES["status"])
                p.take(HEALTH, EXAMPLES["health"])
                p.take(CALIBRATION, EXAMPLES["calibration"])
                p.take(EVENT, EXAMPLES["event"])
                for topic in (NAV, STATUS, HEALTH, CALIBRATION, EVENT):
                    payload = (await listener.until(heard(topic.name)))[0]
                    assert topic.message.model_validate_json(payload) == EXAMPLES[topic.name]
                assert heard("online")(listener) == [b"online"]
                p.take(EVENT, event("last words"))
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
            it.publisher.take(NAV, nav(float(k)))
            it.publisher.take(EVENT, event(str(k)))
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
            it.publisher.take(STATUS, EXAMPLES["status"])
            it.publisher.take(CALIBRATION, EXAMPLES["calibration"])
            async with listening(broker) as (listener, _):
                await listener.until(heard("status"))
                await listener.until(heard("calibration"))
            broker.kill()
            await it.until(lambda r: "mqtt_lost" in r.codes())
            it.publisher.take(EVENT, event("while it was away"))
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
            it.publisher.take(STATUS, EXAMPLES["status"])
            async with listening(broker) as (listener, _):
                await listener.until(heard("status"))
            broker.freeze()
            ticks = 0

            def lost(r: Running) -> bool:
                nonlocal ticks
                ticks += 1
                r.publisher.take(NAV, nav(float(ticks)))
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
                it.publisher.take(EVENT, event("nobody hears this"))


async def test_heartbeat_keeps_an_idle_connection(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker, keepalive_s=1)) as it, listening(broker) as (li, _):
            await li.until(lambda li: len(heard("online")(li)) >= 4)
            it.publisher.take(STATUS, EXAMPLES["status"])
            await li.until(lambda li: len(heard("status")(li)) >= 4)
            assert it.codes() == ["mqtt_connected"]


# ------------------------------------------------------------------ access


async def test_user_and_password_from_file_and_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passwords = tmp_path / "passwords"
    run("mosquitto_passwd", "-b", "-c", str(passwords), "truck", "s3cret")
    secret = tmp_path / "secret"
    secret.write_text("s3cret\n")
    secret.chmod(0o644)
    with Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}") as broker:
        async with running(options(broker, username="truck", password_file=secret)) as it:
            await it.until(lambda r: r.publisher.status.state == "running")
            assert it.codes()[0] == "mqtt_password_exposed"
        secret.chmod(0o600)
        monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "wrong")
        async with running(options(broker, username="truck", password_file=secret)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")
            assert "uthori" in it.publisher.status.detail
            assert it.codes() == ["mqtt_absent"]
        monkeypatch.setenv("FUSIOND_MQTT_PASSWORD", "s3cret")
        async with running(options(broker, username="truck")) as it:
            await it.until(lambda r: r.publisher.status.state == "running")


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def openssl(*arguments: str) -> None:
    run("openssl", *arguments)


async def test_tls_verifies_the_broker_and_shows_our_certificate(tmp_path: Path) -> None:
    ca, key, request, cert = (str(tmp_path / n) for n in ("ca.pem", "key.pem", "req", "cert.pem"))
    extensions = tmp_path / "extensions"
    extensions.write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    new_key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    ca_key = str(tmp_path / "ca-key.pem")
    openssl("req", "-x509", *new_key, "-keyout", ca_key, "-out", ca, "-subj", "/CN=test-ca")
    openssl("req", *new_key, "-keyout", key, "-out", request, "-subj", "/CN=broker")
    openssl(
        *["x509", "-req", "-in", request, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial"],
        *["-out", cert, "-extfile", str(extensions)],
    )
    lines = ("allow_anonymous true", f"cafile {ca}", f"certfile {cert}", f"keyfile {key}")
    with Broker(tmp_path, *lines, "require_certificate true") as broker:
        good = {"tls": True, "ca_file": ca, "cert_file": cert, "key_file": key}
        async with running(options(broker, **good)) as it:
            await it.until(lambda r: r.publisher.counters["mqtt_published"])
        async with running(options(broker, tls=True)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")
            assert "certificate verify failed" in it.publisher.status.detail
        async with running(options(broker)) as it:
            await it.until(lambda r: r.publisher.status.state == "absent")


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"password_file": "/nowhere/secret"}, "mqtt.password_file = '/nowhere/secret'"),
        ({"password_file": "/dev/null"}, "empty"),
        ({"ca_file": "/etc/hostname"}, "set mqtt.tls = true"),
        ({"tls": True, "ca_file": "/nowhere/ca.pem"}, "mqtt.ca_file"),
        ({"tls": True, "cert_file": "/dev/null"}, "mqtt.cert_file"),
        ({"tls": True, "key_file": "/dev/null"}, "mqtt.key_file"),
    ],
)
def test_unusable_files_are_named(section: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words.replace(".", r"\.")):
        MqttPublisher(Mqtt(**section), "truck", on_event=lambda *_: None)


# ------------------------------------------------------------------ commands


def handler(taken: list[Command]) -> Callable[[Command], str]:
    def handle(command: Command) -> str:
        if command.id == "no":
            raise CommandRefusedError("not while moving")
        if command.id == "bug":
            raise ZeroDivisionError("oops")
        taken.append(command)
        return "done"

    return handle


async def test_commands_are_checked_carried_out_and_answered(tmp_path: Path) -> None:
    taken: list[Command] = []
    position = {"id": "a1", "lat_deg": 31.0, "lon_deg": 121, "height_m": 12.5, "sd_m": 5.0}
    cases: list[tuple[str, bytes, str | None, bool, str]] = [
        ("set_position", json.dumps(position).encode(), "a1", True, "done"),
        ("set_position", json.dumps(position | {"lat_deg": 91}).encode(), "a1", False, "lat_deg"),
        ("set_position", json.dumps(position | {"lat_deg": "31"}).encode(), "a1", False, "lat_deg"),
        ("set_position", json.dumps(position | {"alt": 1}).encode(), "a1", False, "alt"),
        ("set_position", b'{"id":"a2","lat_deg":NaN}', "a2", False, "lat_deg"),
        ("reset_filter", b"\xff\xfe{", None, False, "payload"),
        ("reset_filter", b"", None, False, "payload"),
        ("reset_filter", b'{"id":"' + b"x" * 5000 + b'"}', None, False, "5009 bytes"),
        ("reset_filter", b'{"id":"no"}', "no", False, "not while moving"),
        ("reset_filter", b'{"id":"bug"}', "bug", False, "failed"),
        ("reset_filter", b'{"id":"r1"}', "r1", True, "done"),
    ]
    with Broker(tmp_path) as broker:
        enabled = options(broker, commands=("set_position", "reset_filter"))
        async with listening(broker) as (listener, client):
            await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"old"}', qos=1, retain=True)
            async with running(enabled, on_command=handler(taken)) as it:
                first = json.loads((await listener.until(heard("reply")))[0])
                assert (first["id"], first["ok"]) == ("old", False)
                assert "retained" in first["text"]
                for name, payload, *_ in cases:
                    await client.publish(f"{BASE}/cmd/{name}", payload, qos=1)
                replies = await listener.until(
                    lambda li: len(r := heard("reply")(li)) == len(cases) + 1 and r[1:]
                )
                for (name, _, request_id, ok, words), raw in zip(cases, replies, strict=True):
                    reply = json.loads(raw)
                    assert (reply["command"], reply["id"], reply["ok"]) == (name, request_id, ok)
                    assert words in reply["text"]
                    assert reply["t_utc"] == "2026-11-20T23:33:07.123Z"
                assert taken[0] == SetPosition(**position)
                assert len(taken) == it.publisher.counters["mqtt_commands"] == 2
                assert it.publisher.counters["mqtt_commands_refused"] == len(cases) - 2 + 1
                assert "mqtt_command_failed" in it.codes()


async def test_commands_that_are_not_configured_do_nothing(tmp_path: Path) -> None:
    taken: list[Command] = []
    with Broker(tmp_path) as broker:
        enabled = options(broker, commands=("reset_filter",))
        async with listening(broker) as (listener, client):
            async with running(enabled, on_command=handler(taken)):
                await listener.until(heard("online"))
                await client.publish(f"{BASE}/cmd/request_fix", b'{"id":"1"}', qos=1)
                await client.publish(f"{BASE}/cmd/reset_fliter", b'{"id":"1"}', qos=1)
                await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"2"}', qos=1)
                raw = await listener.until(lambda li: len(r := heard("reply")(li)) == 3 and r)
                replies = [json.loads(reply) for reply in raw]
                assert [(r["id"], r["ok"]) for r in replies] == [
                    ("1", False),
                    (None, False),
                    ("2", True),
                ]
                assert "not listed in mqtt.commands" in replies[0]["text"]
                assert "no such command; there are set_position" in replies[1]["text"]
            async with running(options(broker), on_command=handler(taken)) as it:
                await it.until(lambda r: r.publisher.counters["mqtt_published"])
                await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"3"}', qos=1)
                it.publisher.take(EVENT, event("after the command"))
                await listener.until(heard("event"))
    assert [c.id for c in taken] == ["2"]


async def test_a_flood_of_commands_is_answered_once_and_starves_nothing(tmp_path: Path) -> None:
    taken: list[Command] = []
    flood = 3000

    def replies(li: Listener) -> list[dict[str, Any]]:
        return [json.loads(payload) for payload in heard("reply")(li)]

    with Broker(tmp_path) as broker:
        async with (
            listening(broker, f"{BASE}/+") as (listener, client),
            running(
                options(broker, commands=("reset_filter",), keepalive_s=60),
                on_command=handler(taken),
            ) as it,
        ):
            # Not at the commands: the broker drops what comes faster than a busy listener reads.
            await listener.until(heard("online"))
            sender = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", FLOOD, str(broker.port), str(flood))
            )
            sent = 0
            while sender.returncode is None:
                it.publisher.take(NAV, nav(float(sent)))
                sent += 1
                await listener.until(lambda li, n=sent: len(heard("nav")(li)) >= n)
            it.publisher.take(EVENT, event("after the flood"))
            await listener.until(heard("event"))
            # Commands and replies keep their order: whoever has the reply to a later one has all of
            # the flood's. One of too many is not answered, so it is asked for until it is.
            while "later" not in [r["id"] for r in replies(listener)]:
                await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"later"}', qos=1)
                it.publisher.take(NAV, nav(float(sent)))
                sent += 1
                await listener.until(lambda li, n=sent: len(heard("nav")(li)) >= n)
    answers = replies(listener)
    refused = [r for r in answers if not r["ok"]]
    carried_out = {c.id for c in taken if c.id.startswith("flood")}
    assert it.publisher.counters["mqtt_commands_limited"] > 0
    assert len(carried_out) >= BURST
    # With QoS 1 a reply may come twice, where the host was too busy to confirm it in time.
    assert {r["id"] for r in answers if r["ok"]} - {"later"} == carried_out
    assert len(refused) < 5
    assert all("too many commands" in r["text"] for r in refused)


FLOOD = """
import sys
import paho.mqtt.client as mqtt
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
client.connect("127.0.0.1", int(sys.argv[1]))
client.loop_start()
for k in range(int(sys.argv[2])):
    last = client.publish("fusiond/truck/cmd/reset_filter", '{"id": "flood%d"}' % k, qos=1)
last.wait_for_publish()
"""


def test_the_bucket_fills_at_its_rate_and_the_first_of_a_row_is_answered() -> None:
    now_s = 100.0
    counters: Counter[str] = Counter()
    intake = CommandIntake(
        ("reset_filter",),
        handler([]),
        counters,
        lambda *_: None,
        lambda: UTC_NS,
        lambda: now_s,
    )

    def ask() -> bool | None:
        reply = intake.answer("reset_filter", b'{"id":"1"}', False)
        return None if reply is None else reply.ok

    assert [ask() for _ in range(23)] == [True] * 20 + [False, None, None]
    now_s += 1.0
    assert [ask() for _ in range(7)] == [True] * 5 + [None] * 2  # the same row
    now_s += 10.0
    assert [ask() for _ in range(22)] == [True] * 20 + [False, None]
    assert counters == {"mqtt_commands": 45, "mqtt_commands_limited": 7}


# ------------------------------------------------------------------ another client of our name


async def test_two_of_one_name_say_so_and_stop_throwing_each_other_out(tmp_path: Path) -> None:
    with Broker(tmp_path) as broker:
        async with running(options(broker)) as a, running(options(broker)) as b:
            await a.until(lambda r: "client_name_taken" in r.codes() + b.codes())
            told = a if "client_name_taken" in a.codes() else b
            assert told.publisher.counters["mqtt_taken_over"] >= 1
            text = dict(told.events)["client_name_taken"]
            assert "'fusiond-truck'" in text
            assert "mqtt.client_id" in text
            # Whoever is in now stays, until the one that waits comes back: seconds, not 250 ms.
            assert told.publisher.status.state == "absent"
            assert "another client" in told.publisher.status.detail
            ended = a.codes().count("mqtt_lost") + b.codes().count("mqtt_lost")
            assert ended <= 2 * TAKEN_COUNT


def test_a_rival_is_told_from_a_broker_that_restarts() -> None:
    rival = Reconnecting()
    assert [rival.ended(0.3, by_broker=True) for _ in range(4)] == [False, False, True, False]
    waits = [rival.wait_s() for _ in range(6)]
    assert waits == [5.0, 10.0, 20.0, 40.0, LONGEST_CONTESTED_S, LONGEST_CONTESTED_S]
    assert not rival.ended(50.0, by_broker=True)
    assert rival.taken  # a rival waits as long
    rival.ended(PEACE_S + 1.0, by_broker=True)
    assert not rival.taken
    assert rival.wait_s() < 1.0

    restarting = Reconnecting()
    for _ in range(5):
        restarting.ended(0.3, by_broker=True)
        restarting.failed()
    frozen = Reconnecting()
    for _ in range(5):
        frozen.ended(2.0, by_broker=False)
    assert not restarting.taken
    assert not frozen.taken


async def test_supervisor_is_a_plain_task(tmp_path: Path) -> None:
    """Wrong host names and refused ports are retried, never raised."""
    it = Running(Mqtt(host="name.invalid", port=1))
    task = asyncio.create_task(it.publisher.run())
    await it.until(lambda r: "mqtt_absent" in r.codes())
    assert not task.done()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
