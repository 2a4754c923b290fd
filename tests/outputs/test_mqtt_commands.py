"""Commands over a real Mosquitto: checked, carried out, answered, limited."""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusiond.outputs import incoming_publications
from fusiond.outputs.command_intake import BURST, REMEMBERED, CommandIntake
from fusiond.outputs.commands import Command, CommandRefusedError, SetPosition
from fusiond.outputs.topics import EVENT, NAV
from tests.broker import Broker, Listener, listening
from tests.outputs.old_broker import old_broker
from tests.outputs.publisher import BASE, UTC_NS, event, heard, nav, options, running


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
                it.publisher.publish(EVENT, event("after the command"))
                await listener.until(heard("event"))
    assert [c.id for c in taken] == ["2"]


async def test_a_flood_of_commands_is_answered_once_and_starves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(incoming_publications, "QUIET_S", 0.5)
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
                it.publisher.publish(NAV, nav(float(sent)))
                sent += 1
                await listener.until(lambda li, n=sent: len(heard("nav")(li)) >= n)
            it.publisher.publish(EVENT, event("after the flood"))
            await listener.until(heard("event"))
            # Commands and replies keep their order: whoever has the reply to a later one has all of
            # the flood's. One of too many is not answered, so it is asked for until it is.
            while not any(r["id"] and r["id"].startswith("later") for r in replies(listener)):
                again = json.dumps({"id": f"later{sent}"})
                await client.publish(f"{BASE}/cmd/reset_filter", again, qos=1)
                it.publisher.publish(NAV, nav(float(sent)))
                sent += 1
                await listener.until(lambda li, n=sent: len(heard("nav")(li)) >= n)
    answers = replies(listener)
    refused = [r for r in answers if not r["ok"]]
    carried_out = {c.id for c in taken if c.id.startswith("flood")}
    assert it.publisher.counters["mqtt_commands_limited"] > 0
    assert len(carried_out) >= BURST
    # With QoS 1 a reply may come twice, where the host was too busy to confirm it in time.
    answered = {r["id"] for r in answers if r["ok"]}
    assert {one for one in answered if one.startswith("flood")} == carried_out
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

    ids = itertools.count()

    def ask() -> bool | None:
        reply = intake.answer("reset_filter", b'{"id":"%d"}' % next(ids), False)
        return None if reply is None else reply.ok

    assert [ask() for _ in range(23)] == [True] * 20 + [False, None, None]
    now_s += 1.0
    assert [ask() for _ in range(7)] == [True] * 5 + [None] * 2  # the same row
    now_s += 10.0
    assert [ask() for _ in range(22)] == [True] * 20 + [False, None]
    assert counters == {"mqtt_commands": 45, "mqtt_commands_limited": 7}


def intake_of(taken: list[Command], counters: Counter[str]) -> CommandIntake:
    """Everything is allowed, and the bucket is always full."""
    ticks = itertools.count(step=10.0)
    names = ("reset_filter", "request_fix")
    return CommandIntake(
        names, handler(taken), counters, lambda *_: None, lambda: UTC_NS, lambda: next(ticks)
    )


def test_a_command_that_comes_again_is_carried_out_once() -> None:
    taken: list[Command] = []
    counters: Counter[str] = Counter()
    intake = intake_of(taken, counters)

    def ok(name: str, request: str) -> bool:
        reply = intake.answer(name, json.dumps({"id": request}).encode(), False)
        assert reply is not None
        assert reply.id == request
        return reply.ok

    assert ok("reset_filter", "a")
    assert not ok("reset_filter", "a")
    assert ok("request_fix", "a")  # another command
    assert not ok("reset_filter", "no")  # refused: nothing was done, it may be asked again
    assert not ok("reset_filter", "no")
    assert counters == {
        "mqtt_commands": 2,
        "mqtt_commands_refused": 3,
        "mqtt_commands_repeated": 1,
    }
    for k in range(REMEMBERED):
        assert ok("reset_filter", f"b{k}")
    assert not ok("reset_filter", "b0")
    assert ok("reset_filter", "a")  # so long ago that nobody repeats it


def test_a_retained_command_is_refused_by_its_mark_whatever_it_says() -> None:
    taken: list[Command] = []
    counters: Counter[str] = Counter()
    intake = intake_of(taken, counters)
    for payload, sent_id in ((b'{"id":"a"}', "a"), (b"{", None), (b'{"id":"b","more":1}', "b")):
        reply = intake.answer("reset_filter", payload, True)
        assert reply is not None
        assert (reply.id, reply.ok) == (sent_id, False)
        assert "retained" in reply.text
    assert not taken
    assert counters == {"mqtt_commands_refused": 3, "mqtt_commands_retained": 3}


async def test_a_retained_command_is_carried_out_once_over_reconnections(tmp_path: Path) -> None:
    """A broker of 3.1.1 delivers it unmarked to who is there, and marked to who comes later."""
    taken: list[Command] = []
    with Broker(tmp_path) as broker:
        async with listening(broker) as (listener, client), old_broker(broker) as old:
            enabled = options(old, commands=("reset_filter",))
            async with running(enabled, on_command=handler(taken)):
                await listener.until(heard("online"))  # it has subscribed before
                command = f"{BASE}/cmd/reset_filter"
                await client.publish(command, b'{"id":"kept"}', qos=1, retain=True)
                await listener.until(lambda li: len(heard("reply")(li)) == 1)
            async with running(enabled, on_command=handler(taken)):
                raw = await listener.until(lambda li: len(r := heard("reply")(li)) == 2 and r)
            assert [json.loads(reply)["ok"] for reply in raw] == [True, False]
            await client.publish(command, b"", qos=1, retain=True)
    assert len(taken) == 1


HUGE = """
import sys
import paho.mqtt.client as mqtt
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
client.connect("127.0.0.1", int(sys.argv[1]))
client.loop_start()
for name in ("cmd/reset_filter", "cmd/" + "n" * 60_000):
    sent = client.publish("fusiond/truck/" + name, b" " * int(sys.argv[2]), qos=1, retain=True)
    sent.wait_for_publish()
"""


async def test_a_message_of_megabytes_is_not_held_and_the_connection_goes_on(
    tmp_path: Path,
) -> None:
    taken: list[Command] = []
    size = 20_000_000
    with Broker(tmp_path) as broker:
        async with (
            listening(broker, f"{BASE}/reply") as (listener, client),
            old_broker(broker) as old,
        ):
            enabled = options(old, commands=("reset_filter",), keepalive_s=60)
            async with running(enabled, on_command=handler(taken)) as it:
                await it.until(lambda r: r.publisher.counters["mqtt_published"])
                tracemalloc.start()
                sender = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-c", HUGE, str(broker.port), str(size))
                )
                await sender.wait()
                raw = await listener.until(lambda li: len(r := heard("reply")(li)) == 2 and r)
                most = tracemalloc.get_traced_memory()[1]
                tracemalloc.stop()
                assert "at most 4096 are read" in json.loads(raw[0])["text"]
                assert "no such command" in json.loads(raw[1])["text"]
                await client.publish(f"{BASE}/cmd/reset_filter", b'{"id":"after"}', qos=1)
                await listener.until(lambda li: len(heard("reply")(li)) == 3)
                assert it.publisher.counters["mqtt_reconnects"] == 0
            assert [command.id for command in taken] == ["after"]
            assert most < 2_000_000
