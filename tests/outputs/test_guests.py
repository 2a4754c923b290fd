"""What guests may cost: turns, allowances, places and descriptors, over real connections."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import resource
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets import Subprotocol
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from fusiond.configuration.outputs import Foxglove, Gpsd, NmeaServed, Prometheus
from fusiond.outputs import guests as door
from fusiond.outputs import tcp
from fusiond.outputs.allowance import BYTES, MESSAGES, Bucket, Rate
from fusiond.outputs.asked import DEEPEST, NotUnderstoodError, parsed
from fusiond.outputs.foxglove.channels import CHANNELS
from fusiond.outputs.foxglove.server import FoxgloveServer
from fusiond.outputs.foxglove.viewer import MOST_SUBSCRIPTIONS, PROTOCOLS, Data, Viewer, loopback
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.guests import BUDGET_NS, WINDOW_NS, Guests
from fusiond.outputs.nmea import NmeaServer
from fusiond.outputs.prometheus import MOST_SCRAPERS, PrometheusEndpoint
from fusiond.outputs.topics import HEALTH, NAV
from tests.broker import free_port
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, at_work, connected, nav
from tests.patience import PATIENCE_S, until

S = 1_000_000_000


@asynccontextmanager
async def gpsd(around: Around | None = None) -> AsyncIterator[GpsdServer]:
    server = GpsdServer(Gpsd(port=free_port()), (around or Around()).surroundings)
    async with at_work(server):
        yield server


@asynccontextmanager
async def foxglove(around: Around | None = None, **options: Any) -> AsyncIterator[FoxgloveServer]:
    server = FoxgloveServer(
        Foxglove(port=free_port(), **options), (around or Around()).surroundings
    )
    async with at_work(server):
        yield server


def url(server: FoxgloveServer) -> str:
    return f"ws://127.0.0.1:{server.port.address[1]}"


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


# ------------------------------------------------------------------ turns


async def test_what_is_to_be_done_waits_for_the_next_window(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each piece costs a third of the budget on a clock of the test's own: three a window."""
    now_ns = 0
    monkeypatch.setattr(door.time, "perf_counter_ns", lambda: now_ns)
    guests, done = Guests(), 0

    def work() -> None:
        nonlocal now_ns, done
        now_ns += BUDGET_NS // 3 + 1
        done += 1

    one, other = socket.socketpair()
    with one, other:
        guests.watch(one.fileno(), 1, lambda _: None)
        for _ in range(100):
            guests.do(work)
        for count in range(3, 33, 3):
            await until(lambda count=count: done >= count)  # type: ignore[misc]
            await asyncio.sleep(2e-9 * WINDOW_NS)
            assert done == count, "in the same window nothing more is done"
            now_ns += WINDOW_NS
        assert guests.postponed >= 10
        guests.forget(one.fileno())


async def test_who_is_loud_does_not_silence_the_others() -> None:
    """Sixty-three who ask without end, and one who asks once."""
    async with gpsd() as server, connected(server.server.port.address) as patient:
        server.take(NAV, nav())
        loud = []
        for _ in range(63):
            sock = socket.create_connection(server.server.port.address)
            sock.setblocking(False)
            loud.append(sock)
        assert json.loads(await patient.line())["class"] == "VERSION"
        for _ in range(20):
            for sock in loud:
                try:
                    sock.send(b"?" * 4096)
                except OSError:
                    continue
            patient.writer.write(b"?DEVICES;")
            assert json.loads(await patient.line())["class"] == "DEVICES"
        for sock in loud:
            sock.close()


# ------------------------------------------------------------------ allowances


@given(
    st.lists(st.tuples(st.floats(0.0, 300.0), st.integers(0, 5 * S)), min_size=1, max_size=30),
    st.floats(1.0, 100.0),
    st.floats(1.0, 200.0),
)
@settings(max_examples=100, deadline=None)
def test_no_more_is_spent_than_the_rate_allows(
    wishes: list[tuple[float, int]], per_s: float, burst: float
) -> None:
    bucket, now_ns, spent = Bucket(Rate(per_s, burst), 0), 0, 0.0
    for amount, later_ns in wishes:
        now_ns += later_ns
        if not bucket.empty(now_ns):
            bucket.spend(amount, now_ns)
            spent += amount
            largest = max(amount for amount, _ in wishes)
            assert spent <= burst + per_s * now_ns / S + largest + 1e-6


async def test_who_asks_too_often_is_dropped() -> None:
    async with gpsd() as server, connected(server.server.port.address) as client:
        client.writer.write(b"?POLL;" * 10_900)
        await client.ended()
        assert server.counters["clients_flooding"] == 1
        assert server.counters["requests"] == MESSAGES.burst
        assert not server.server.clients


async def test_a_poll_is_made_once_an_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    made = 0
    reports = GpsdServer.reports

    def counted(self: GpsdServer, message: Any) -> Any:
        nonlocal made
        made += 1
        return reports(self, message)

    monkeypatch.setattr(GpsdServer, "reports", counted)
    async with gpsd() as server, connected(server.server.port.address) as client:
        server.take(NAV, nav())
        await client.line()
        client.writer.write(b"?POLL;" * 20)
        answers = [await client.line() for _ in range(20)]
        assert len(set(answers)) == 1
        assert made == 1
        server.take(NAV, nav(height_m=1.0))
        client.writer.write(b"?POLL;")
        assert json.loads(await client.line())["tpv"][0]["altHAE"] == 1.0
        assert made == 2


async def test_who_sends_too_much_is_read_more_slowly() -> None:
    """Its bytes wait at its own side; nothing of them is kept here."""
    server = NmeaServer(NmeaServed(port=free_port()), Around().surroundings)
    async with at_work(server), connected(server.server.port.address) as talker:
        for _ in range(1000):
            talker.writer.write(b"x" * 4096)
        await until(lambda: server.counters["slowed"] > 0)
        server.take(NAV, nav())
        assert (await talker.line()).startswith(b"$GNRMC")
        # What goes on after a while is read again.
        await until(lambda: server.counters["slowed"] > 1)
        assert not talker.writer.is_closing()


def test_a_plotter_may_talk_as_it_does() -> None:
    assert BYTES.per_s > 3840  # 38400 baud


# ------------------------------------------------------------------ who does not read


async def test_who_asks_and_never_reads_is_dropped_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It has no epoch to skip, so that only time tells; and its descriptor goes with it."""
    monkeypatch.setattr(tcp, "STUCK_S", 0.5)
    async with gpsd() as server:
        before = descriptors()
        deaf = socket.socket()
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(server.server.port.address)
        server.take(HEALTH, EXAMPLES["health"])
        server.take(NAV, nav())
        deaf.sendall(b"?POLL;" * int(MESSAGES.burst))
        await until(lambda: server.counters["clients_dropped"] == 1)
        assert not server.server.clients
        assert descriptors() == before + 1  # its own end
        deaf.close()


@pytest.mark.parametrize("count", [300])
async def test_a_connection_counts_until_it_is_closed(count: int) -> None:
    """All who never read, over the limit: no more descriptors than places."""
    async with gpsd() as server:
        before = descriptors()
        socks = []
        for _ in range(count):
            sock = socket.socket()
            sock.setblocking(False)
            await asyncio.get_running_loop().sock_connect(sock, server.server.port.address)
            sock.send(b"?WATCH={};" + b"?POLL;" * 30)
            socks.append(sock)
        refused = count - tcp.MOST_CLIENTS
        await until(lambda: server.counters["clients_refused"] == refused)
        assert descriptors() - before == count + tcp.MOST_CLIENTS
        for sock in socks:
            sock.close()
        await until(lambda: not server.server.clients)
        assert descriptors() == before


# ------------------------------------------------------------------ places and descriptors


async def test_descriptors_are_kept_for_the_daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (300, 300))
    around = Around(guests=Guests())
    assert around.surroundings.guests.most == 150
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, 4096))
    assert Guests().most == 1024 - door.RESERVED_DESCRIPTORS
    around.surroundings.guests.most = 3
    async with gpsd(around) as server:
        ends = [socket.create_connection(server.server.port.address) for _ in range(5)]
        await until(lambda: server.counters["clients_refused"] == 2)
        assert len(server.server.clients) == 3
        for end in ends:
            end.close()


async def test_few_descriptors_are_shared_by_the_servers() -> None:
    """Who takes all places of one server takes none of another's."""
    around = Around(guests=Guests())
    around.surroundings.guests.most = 90
    scraped = PrometheusEndpoint(Prometheus(port=free_port()), around.surroundings)
    async with gpsd(around) as server, at_work(scraped):
        ends = []
        for _ in range(100):
            end = socket.socket()
            end.setblocking(False)
            await asyncio.get_running_loop().sock_connect(end, server.server.port.address)
            ends.append(end)
        came = server.counters
        await until(lambda: came["clients"] + came["clients_refused"] == 100)
        assert len(server.server.clients) == 90 * tcp.MOST_CLIENTS // (256 + MOST_SCRAPERS)
        async with connected(scraped.server.port.address) as client:
            client.writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
            async with asyncio.timeout(PATIENCE_S):
                assert (await client.reader.read()).startswith(b"HTTP/1.1 200")
        for end in ends:
            end.close()
    assert around.surroundings.guests.wanted == 0


async def test_without_a_descriptor_it_pauses_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "PAUSE_S", 0.05)
    tried, short = 0, True
    accept = socket.socket.accept

    def accepting(self: socket.socket) -> Any:
        nonlocal tried
        if short:
            tried += 1
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return accept(self)

    monkeypatch.setattr(socket.socket, "accept", accepting)
    around = Around()
    async with gpsd(around) as server:
        begun_s = time.monotonic()
        async with connected(server.server.port.address) as client:
            await until(lambda: tried >= 4)
            assert time.monotonic() - begun_s > 3 * 0.04  # a pause each, not a loop
            short = False
            assert json.loads(await client.line())["class"] == "VERSION"
    assert [code for code, _ in around.events] == ["gpsd_clients_refused"]
    assert "Too many open files" in around.events[0][1]


async def test_slow_headers_do_not_lock_prometheus_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "HASTY_S", 0.0)
    output = PrometheusEndpoint(Prometheus(port=free_port()), Around().surroundings)
    async with at_work(output):
        slow = []
        for _ in range(MOST_SCRAPERS):
            sock = socket.create_connection(output.server.port.address)
            sock.send(b"GET /me")
            slow.append(sock)
        await until(lambda: len(output.server.clients) == MOST_SCRAPERS)
        async with connected(output.server.port.address) as client:
            client.writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
            async with asyncio.timeout(PATIENCE_S):
                assert (await client.reader.read()).startswith(b"HTTP/1.1 200")
        assert output.counters["malformed"] == 1
        for sock in slow:
            sock.close()


async def test_a_request_that_does_not_come_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "REQUEST_S", 0.3)
    output = PrometheusEndpoint(Prometheus(port=free_port()), Around().surroundings)
    async with at_work(output), connected(output.server.port.address) as client:
        client.writer.write(b"GET /me")
        await client.ended()
    assert output.counters["malformed"] == 1


async def test_a_fault_of_ours_costs_its_client_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gpsd() as server, connected(server.server.port.address) as other:
        await other.line()
        answer = GpsdServer.answer

        def faulty(self: GpsdServer, watch: Any, request: Any) -> bytes:
            if getattr(request, "name", "") == "DEVICE":
                raise RuntimeError("a fault")
            return answer(self, watch, request)

        monkeypatch.setattr(GpsdServer, "answer", faulty)
        async with connected(server.server.port.address) as client:
            client.writer.write(b"?DEVICE;")
            await client.ended()
        other.writer.write(b"?VERSION;")
        assert json.loads(await other.line())["class"] == "VERSION"
        assert server.counters["clients_faulty"] == 1


# ------------------------------------------------------------------ what is no request

HOSTILE = (
    "[" * 4000,
    "[" * 4000 + "]" * 4000,
    '{"a":' * 900 + "1" + "}" * 900,
    "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1),
    '"\\ud800"',
    '{"\\udfff": 1}',
    '{"op": ["\\udc00"]}',
    "NaN",
    '{"id": Infinity}',
    '{"id": 1e999}',
    "9" * 5000,
    "",
    "{",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_it_is_refused_in_one_way(text: str) -> None:
    for given_ in (text, text.encode()):
        with pytest.raises(NotUnderstoodError) as refused:
            parsed(given_)
        assert str(refused.value).isascii()
    with pytest.raises(NotUnderstoodError):
        parsed(b"\xff\xfe\x00")


def test_what_is_a_request_is_understood() -> None:
    assert parsed('{"op":"a","b":[1,{"c":"\\ud83d\\ude00 \u00e9"}]}')["b"][1]["c"] == "😀 é"
    assert parsed("[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)) is not None


@given(st.text(max_size=60) | st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_whatever_comes_is_a_value_that_can_be_said_again_or_refused(text: str | bytes) -> None:
    try:
        value = parsed(text)
    except NotUnderstoodError:
        return
    json.dumps(value, ensure_ascii=False, allow_nan=False).encode()


async def test_gpsd_and_foxglove_refuse_alike() -> None:
    protocol = [Subprotocol(PROTOCOLS[0])]
    async with gpsd() as server, connected(server.server.port.address) as client:
        await client.line()
        for count, text in enumerate(HOSTILE[:7], start=1):
            client.writer.write(b"?WATCH=" + text.encode() + b"\n;")
            if "{" in text and count == 3:
                client.writer.write(b"}" * 900)
            assert json.loads(await client.line())["class"] == "ERROR"
        assert server.counters["clients_faulty"] == 0
    async with foxglove() as fox, connect(url(fox), subprotocols=protocol) as viewer:
        for _ in range(2):
            await viewer.recv()
        for text in HOSTILE:
            await viewer.send(text)
            assert json.loads(await viewer.recv())["op"] == "status"
        assert fox.counters["malformed"] == len(HOSTILE)
        assert fox.counters["clients_faulty"] == 0


# ------------------------------------------------------------------ Foxglove


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
        server.take(NAV, nav())
        got = [await viewer.recv() for viewer in (one, two) for _ in range(5)]
        assert len({bytes(data)[13:] for data in got if isinstance(data, bytes)}) == 1
        assert made == 1


class FakeClient:
    """The connection of a viewer that is given bytes without one."""

    waiting_bytes = 0
    request_due = True
    on_room: Callable[[], None] | None = None

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.finished = False

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def finish(self) -> None:
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
    server.take(NAV, nav())
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


def test_what_is_no_origin_is_not_loopback() -> None:
    for text in ("", "://", "http://[", "file://", "http://127.1", "localhost"):
        assert not loopback(text)


# ------------------------------------------------------------------ the unit


def test_the_unit_has_descriptors_for_all_clients() -> None:
    unit = Path(__file__).parents[2] / "systemd" / "fusiond.service"
    (line,) = [x for x in unit.read_text().splitlines() if x.startswith("LimitNOFILE=")]
    places = 2 * tcp.MOST_CLIENTS + MOST_SCRAPERS + 32
    assert int(line.partition("=")[2]) >= places + door.RESERVED_DESCRIPTORS
