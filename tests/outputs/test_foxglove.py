"""Foxglove's protocol, spoken by the client of the library that serves it."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import cos, nan, radians, sin
from typing import Any

import pytest
from websockets import Subprotocol
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus

from fusiond.configuration.outputs import Foxglove
from fusiond.navigation.solution import Mode
from fusiond.outputs.foxglove.channels import (
    CHANNELS,
    NO_HEIGHT_SD_M,
    frame_transforms,
    location_fix,
)
from fusiond.outputs.foxglove.server import FoxgloveServer
from fusiond.outputs.foxglove.viewer import PROTOCOLS
from fusiond.outputs.topics import EVENT, HEALTH, NAV
from tests.broker import free_port
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, at_work, nav
from tests.patience import PATIENCE_S, until

IDS = {channel.name: channel.id for channel in CHANNELS}


def decoded(payload: bytes | None) -> dict[str, Any]:
    assert payload is not None
    value: dict[str, Any] = json.loads(payload, parse_constant=pytest.fail)
    return value


def test_a_location_is_east_north_up() -> None:
    fix = decoded(location_fix(nav()))
    assert fix["timestamp"] == {"sec": 1_795_217_587, "nsec": 123_000_000}
    assert (fix["latitude"], fix["longitude"]) == (31.025438871, 121.441209483)
    assert fix["position_covariance"] == pytest.approx([0.85**2, 0, 0, 0, 0.9**2, 0, 0, 0, 1.7**2])
    assert fix["position_covariance_type"] == 2
    unknown = decoded(location_fix(nav(height_m=nan, sd_d_m=nan)))
    assert (unknown["altitude"], unknown["position_covariance"][8]) == (0.0, NO_HEIGHT_SD_M**2)
    assert location_fix(nav(mode=Mode.INVALID)) is location_fix(nav(t_ms=None)) is None


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "forward"),
    [(0, 0, 0, (0, 1, 0)), (0, 0, 90, (1, 0, 0)), (0, 90, 0, (0, 0, 1)), (40, 0, 180, (0, -1, 0))],
)
def test_the_attitude_turns_forward_to_where_the_vehicle_looks(
    roll: float, pitch: float, yaw: float, forward: tuple[float, float, float]
) -> None:
    message = nav(roll_deg=float(roll), pitch_deg=float(pitch), yaw_deg=float(yaw))
    (transform,) = decoded(frame_transforms(message))["transforms"]
    x, y, z, w = (transform["rotation"][k] for k in "xyzw")
    turned = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    assert turned == pytest.approx(forward, abs=1e-12)
    if roll:  # right side down: the left side's height
        assert 2 * (y * z + w * x) == pytest.approx(sin(radians(roll)))
        assert 1 - 2 * (x * x + y * y) == pytest.approx(cos(radians(roll)))


@asynccontextmanager
async def serving() -> AsyncIterator[tuple[FoxgloveServer, str]]:
    server = FoxgloveServer(Foxglove(port=free_port()), Around().surroundings)
    async with at_work(server):
        yield server, f"ws://127.0.0.1:{server.port.address[1]}"


async def received(connection: ClientConnection) -> tuple[int, int, dict[str, Any]]:
    """The next message data: subscription, time (ns), payload."""
    async with asyncio.timeout(PATIENCE_S):
        data = await connection.recv()
    assert isinstance(data, bytes)
    opcode, subscription, t_ns = struct.unpack_from("<BIQ", data)
    assert opcode == 1
    return subscription, t_ns, json.loads(data[13:])


async def subscribe(connection: ClientConnection, **channels: int) -> None:
    wanted = [{"id": n, "channelId": IDS[f"/{c}"]} for c, n in channels.items()]
    await connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


@pytest.mark.parametrize("protocol", PROTOCOLS)
async def test_a_viewer_sees_what_it_has_subscribed_to(protocol: str) -> None:
    async with (
        serving() as (server, url),
        connect(url, subprotocols=[Subprotocol(protocol)]) as viewer,
    ):
        server.publish(NAV, nav())
        hello, advertised = [json.loads(await viewer.recv()) for _ in range(2)]
        assert viewer.subprotocol == protocol
        assert (hello["op"], hello["name"]) == ("serverInfo", "fusiond truck")
        assert advertised["op"] == "advertise"
        for channel in advertised["channels"]:
            assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
            assert json.loads(channel["schema"])["type"] == "object"
        names = {c["topic"]: c["schemaName"] for c in advertised["channels"]}
        assert names["/location"] == "foxglove.LocationFix"
        assert names["/health"] == "fusiond.HealthMessage"
        await subscribe(viewer, location=7, health=2**32 - 1)
        subscription, t_ns, fix = await received(viewer)  # the last one, at once
        assert (subscription, t_ns) == (7, 1_795_217_587_123_000_000)
        assert fix["latitude"] == 31.025438871
        server.publish(HEALTH, EXAMPLES["health"])
        subscription, _, health = await received(viewer)
        assert subscription == 2**32 - 1
        assert health == json.loads(EXAMPLES["health"].model_dump_json())
        await viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [2**32 - 1]}))
        await subscribe(viewer, log=3)
        await viewer.send("{}")  # its answer comes when all before it has been carried out
        assert json.loads(await viewer.recv())["op"] == "status"
        server.publish(HEALTH, EXAMPLES["health"])
        server.publish(EVENT, EXAMPLES["event"])
        subscription, _, said = await received(viewer)
        assert (subscription, said["level"], said["name"]) == (3, 3, "rdss")
        assert server.counters["malformed"] == 1


async def test_one_who_does_not_read_costs_the_others_nothing() -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with (
        serving() as (server, url),
        connect(url, subprotocols=protocol) as quick,
        # Its reader stops at once, and so does the connection's flow.
        connect(url, subprotocols=protocol, max_queue=1) as stuck,
    ):
        for viewer in (quick, stuck):
            await viewer.recv()
            await viewer.recv()
        await subscribe(stuck, health=1)
        await subscribe(quick, nav=2)
        async with asyncio.timeout(PATIENCE_S):
            while not server.counters["skipped"]:
                server.publish(HEALTH, EXAMPLES["health"])
                await asyncio.sleep(0)
        server.publish(NAV, nav(height_m=-5.0))
        while (await received(quick))[2]["height_m"] != -5.0:
            pass
        stuck.transport.abort()


@pytest.mark.parametrize(
    "request_", ["no json", "[]", '{"op":"subscribe","subscriptions":[{"id":1,"channelId":999}]}',
                 '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}', b"\x01\x02"],
)  # fmt: skip
async def test_nonsense_is_answered_and_counted(request_: str | bytes) -> None:
    async with (
        serving() as (server, url),
        connect(url, subprotocols=[Subprotocol(PROTOCOLS[1])]) as viewer,
    ):
        await viewer.send(request_)
        for _ in range(2):
            await viewer.recv()
        assert json.loads(await viewer.recv())["op"] == "status"
        assert server.counters["malformed"] == 1


async def test_another_protocol_is_sent_away() -> None:
    async with serving() as (server, url):
        for offered in (None, [Subprotocol("mqtt")]):
            with pytest.raises(InvalidStatus):
                async with connect(url, subprotocols=offered):
                    pass
        await until(lambda: not server.server.clients)
