"""What viewers of Foxglove may cost, and whose pages they may be."""

from __future__ import annotations

import gc
import json
import weakref
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets import Subprotocol
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from fusiond.configuration.outputs import Foxglove
from fusiond.outputs.foxglove.channels import CHANNELS
from fusiond.outputs.foxglove.server import FoxgloveServer
from fusiond.outputs.foxglove.viewer import (
    MOST_REQUEST_BYTES,
    MOST_SUBSCRIPTIONS,
    PROTOCOLS,
    Data,
    Viewer,
    loopback,
)
from fusiond.outputs.tcp import Client, Session
from fusiond.outputs.topics import NAV
from tests.outputs.guest_servers import foxglove, url
from tests.outputs.serving import Around, connected, nav
from tests.outputs.test_hostile_requests import HOSTILE
from tests.patience import until


async def test_subscriptions_are_bounded() -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with foxglove() as server, connect(url(server), subprotocols=protocol) as viewer:
        for _ in range(2):
            await viewer.recv()
        for first in range(0, 200, 100):
            wanted = [{"id": first + k, "channelId": 1 + k % len(CHANNELS)} for k in range(100)]
            await viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            assert f"more than {MOST_SUBSCRIPTIONS}" in str(await viewer.recv())
        (client,) = server.server.clients
        assert sum(client.session.channels.values()) == MOST_SUBSCRIPTIONS  # type: ignore[union-attr]
        assert server.counters["subscriptions_refused"] == 2
        gone = [*range(200)]
        await viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": gone}))
        await viewer.send("{}")
        await viewer.recv()
        assert not client.session.channels  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "said",
    [b"", b"GET / HTTP/1.1\r\n", b"\xff" * 100, b"X: y\r\n" * 5000],
    ids=["nothing", "half", "bytes", "lines"],
)
async def test_a_closed_viewer_leaves_no_cyclic_garbage(said: bytes) -> None:
    """Fifty thousand objects in circles, of those who came and went, cost a tick 0.1 s."""
    seen: list[weakref.ref[object]] = []
    async with foxglove() as server:
        greet = server.server._greet

        def remembered(client: Client) -> Session:
            session = greet(client)
            seen.extend((weakref.ref(client), weakref.ref(session)))
            return session

        server.server._greet = remembered
        gc.disable()
        try:
            for _ in range(5):
                async with connected(server.port.address) as guest:
                    guest.writer.write(said)
                    await until(lambda: bool(server.server.clients))
                await until(lambda: not server.server.clients)
            assert len(seen) == 10
            await until(lambda: [ref() for ref in seen] == [None] * 10)
        finally:
            gc.enable()


async def test_a_message_is_encoded_once_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with (
        foxglove() as server,
        connect(url(server), subprotocols=protocol) as one,
        connect(url(server), subprotocols=protocol) as two,
    ):
        wanted = [{"id": k, "channelId": 1} for k in range(5)]
        for viewer in (one, two):
            await viewer.recv()
            await viewer.recv()
            await viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            await viewer.send("{}")
            await viewer.recv()
        made = 0
        dumps = json.dumps

        def counted(*args: Any, **options: Any) -> str:
            nonlocal made
            made += 1
            return dumps(*args, **options)

        monkeypatch.setattr("fusiond.outputs.foxglove.channels.json.dumps", counted)
        server.publish(NAV, nav())
        got = [await viewer.recv() for viewer in (one, two) for _ in range(5)]
        assert len({bytes(data)[13:] for data in got if isinstance(data, bytes)}) == 1
        assert made == 1


class FakeClient:
    """The connection of a viewer that is given bytes without one."""

    waiting_bytes = 0
    request_due = True
    closed = False
    on_room: Callable[[], None] | None = None

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.finished = False

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def finish(self) -> None:
        self.finished = True

    def drop(self, reason: str) -> None:
        self.finished = True

    def charge(self) -> bool:
        return True


@st.composite
def frames(draw: st.DrawFn) -> bytes:
    """Frames of a client, most of them as they should be, and what is none."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=20))
    payload = draw(
        st.sampled_from([text.encode("utf-8", "replace")[:125] for text in HOSTILE])
        | st.binary(max_size=40)
        | st.just(b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}')
        | st.just(b'{"op":"subscribe","subscriptions":[{"id":1e999,"channelId":[]}]}')
        | st.just(b'{"op":"unsubscribe","subscriptionIds":[[],1]}')
    )
    first = draw(st.sampled_from([0x81, 0x82, 0x01, 0x80, 0x88, 0x89, 0x8A, 0xF1, 0x83]))
    return bytes([first, 0x80 | len(payload)]) + bytes(4) + payload


@given(st.lists(frames(), max_size=12), st.booleans(), st.integers(1, 1024))
@settings(max_examples=200, deadline=None)
def test_a_viewer_survives_everything(sent: list[bytes], upgraded: bool, piece: int) -> None:
    server = FoxgloveServer(Foxglove(port=1), Around().surroundings)
    server.publish(NAV, nav())
    server.greeting = b""  # 0.05 s
    client = FakeClient()
    viewer = Viewer(server, client)  # type: ignore[arg-type]
    data = (UPGRADE if upgraded else b"") + b"".join(sent)
    for begin in range(0, len(data), piece):
        if not client.finished:
            viewer.receive(data[begin : begin + piece])
        viewer.put(CHANNELS[0], Data(1, b"{}"))
    assert len(viewer.channels) <= 1


UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


@pytest.mark.parametrize("send", ["pings", "messages"])
async def test_a_flood_of_frames_ends_the_viewer(send: str) -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with foxglove() as server:
        async with connect(url(server), subprotocols=protocol) as viewer:

            async def flood() -> None:
                while True:
                    await (viewer.ping() if send == "pings" else viewer.send("{}"))

            with pytest.raises(ConnectionClosed):
                await flood()
        await until(lambda: not server.server.clients)
        assert server.counters["clients_flooding"] == 1


@pytest.mark.parametrize(
    ("origin", "may"),
    [
        (None, True),
        ("http://localhost:8080", True),
        ("http://127.0.0.1", True),
        ("http://[::1]:3000", True),
        ("https://app.foxglove.dev", True),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://localhost.evil.example", False),
        ("http://192.168.1.7", False),
        ("null", False),
    ],
)
async def test_pages_of_other_sites_are_refused(origin: str | None, may: bool) -> None:
    around = Around()
    options: dict[str, Any] = {"subprotocols": [Subprotocol(PROTOCOLS[0])], "origin": origin}
    async with foxglove(around, origins=("https://app.foxglove.dev",)) as server:
        for _ in range(2):
            if may:
                async with connect(url(server), **options) as viewer:
                    assert "serverInfo" in str(await viewer.recv())
                continue
            with pytest.raises(InvalidStatus, match="403"):
                async with connect(url(server), **options):
                    pass
        assert server.counters["origins_refused"] == (0 if may else 2)
    assert [code for code, _ in around.events] == ([] if may else ["foxglove_origin_refused"])


def test_invalid_origins_are_not_loopback() -> None:
    for text in ("", "://", "http://[", "file://", "http://127.1", "localhost"):
        assert not loopback(text)


async def test_a_head_is_as_long_as_a_message_at_most() -> None:
    """`websockets` alone would keep 128 lines of 8 KiB for ten seconds."""
    async with foxglove() as server, connected(server.port.address) as client:
        client.writer.write(b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 5000 + b"\r\n")
        client.writer.write(b"X: " + b"y" * (MOST_REQUEST_BYTES - 5000) + b"\r\n")
        await client.ended()
        assert server.counters["malformed"] == 1
