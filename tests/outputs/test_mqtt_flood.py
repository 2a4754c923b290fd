"""What others publish to the daemon without end, over a real Mosquitto: it holds up nothing."""

from __future__ import annotations

import asyncio
import json
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fusiond.outputs import incoming_publications
from fusiond.outputs.commands import MAX_PAYLOAD_BYTES, Command
from fusiond.outputs.incoming_publications import BYTES, MESSAGES, Incoming, quiet
from fusiond.outputs.topics import EVENT, NAV
from tests.broker import Broker, listening
from tests.outputs.publisher import BASE, event, heard, nav, options, running
from tests.places import REPOSITORY

SENDER = """
import socket, sys, time
from benchmarks.attackers import joined, publication
sock = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
sock.sendall(joined())
data = publication(sys.argv[2], b"x" * int(sys.argv[3])) * 50
while True:
    sock.sendall(data)
"""


def _carry_out(command: Command) -> str:
    return "done"


@pytest.mark.parametrize(
    ("topic", "size"),
    [(f"{BASE}/cmd/request_fix", 2), (f"{BASE}/cmd/x", 60_000), ("home/status", 6)],
    ids=["commands", "large", "heard"],
)
async def test_a_flood_delays_no_confirmation_and_is_not_listened_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str, size: int
) -> None:
    """Events are confirmed one by one: each would wait for all that was sent before."""
    monkeypatch.setattr(incoming_publications, "QUIET_S", 0.5)
    births: list[bytes] = []
    with Broker(tmp_path, "allow_anonymous true", "log_type error") as broker:
        async with (
            listening(broker, f"{BASE}/+") as (listener, client),
            running(
                options(broker, commands=("request_fix",), keepalive_s=60), on_command=_carry_out
            ) as it,
        ):
            it.publisher.listen("home/status", births.append)
            await listener.until(heard("online"))
            sender = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", SENDER, str(broker.port), topic, str(size)),
                cwd=REPOSITORY,
            )
            try:
                await it.until(lambda it: "mqtt_flooded" in it.codes())
                for number in range(20):
                    it.publisher.publish(EVENT, event(f"meanwhile {number}"))
                    it.publisher.publish(NAV, nav(float(number)))
                    await listener.until(lambda li, n=number: len(heard("event")(li)) > n)
                    await listener.until(lambda li, n=number: len(heard("nav")(li)) > n)
            finally:
                sender.kill()
                await sender.wait()
            assert it.publisher.counters["mqtt_reconnects"] == 0
            assert it.publisher.counters["mqtt_flooded"] > 0
            assert bool(births) == (topic == "home/status")
            # Afterwards it is listened to again.
            asked = 0
            while not any(json.loads(reply)["ok"] for reply in heard("reply")(listener)):
                asked += 1
                command = json.dumps({"id": f"later {asked}"})
                await client.publish(f"{BASE}/cmd/request_fix", command, qos=1)
                await asyncio.sleep(0.1)


def _coming(monkeypatch: pytest.MonkeyPatch) -> tuple[Incoming, Any, list[int], list[float]]:
    """Of a client without a connection: how to let a message of so many bytes come, what of them
    got through, and the clock."""
    now_s, through = [100.0], list[int]()
    monkeypatch.setattr(
        incoming_publications.time, "perf_counter_ns", lambda: round(now_s[0] * 1e9)
    )
    monkeypatch.setattr(incoming_publications.time, "monotonic", lambda: now_s[0])
    paho = SimpleNamespace(on_message=lambda _p, _u, message: through.append(len(message.payload)))
    counters: Counter[str] = Counter()
    it = Incoming(SimpleNamespace(_client=paho), counters, quiet())  # type: ignore[arg-type]

    def come(size: int) -> None:
        paho.on_message(None, None, SimpleNamespace(payload=bytes(size)))

    return it, come, through, now_s


async def test_ordinary_command_rates_are_not_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    it, come, through, now_s = _coming(monkeypatch)
    for _ in range(200):
        now_s[0] += 1.0
        for _ in range(15):
            come(MAX_PAYLOAD_BYTES)
    assert len(through) == 3000
    now_s[0] += 10.0
    for _ in range(round(MESSAGES.burst)):
        come(100)
    assert len(through) == 3000 + MESSAGES.burst
    come(100)
    async with asyncio.timeout(1.0):
        assert await it.flood() == incoming_publications.QUIET_S


async def test_a_row_of_floods_is_listened_to_less_and_less(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    it, come, through, now_s = _coming(monkeypatch)
    waited = []
    for _ in range(5):
        while True:
            before = len(through)
            come(60_000)
            if len(through) == before:
                break
        assert sum(through[-3:]) <= BYTES.burst + 60_000
        now_s[0] += 1.0
        before = len(through)
        come(1)
        assert len(through) == before, "dropped until the broker has stopped"
        waited.append(await it.flood())
        it.over()
    assert waited == [10.0, 20.0, 40.0, 60.0, 60.0]
    now_s[0] += incoming_publications.PEACE_S + 1.0
    for _ in range(10):
        come(60_000)
    assert await it.flood() == incoming_publications.QUIET_S
