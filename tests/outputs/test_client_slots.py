"""Places at a server, and descriptors: who has them, who gives way."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import resource
import socket
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fusiond.configuration.outputs import Prometheus
from fusiond.outputs import client_sockets as door
from fusiond.outputs import tcp
from fusiond.outputs.client_slots import gives_way, host_of
from fusiond.outputs.client_sockets import Guests
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.prometheus import MOST_SCRAPERS, PrometheusEndpoint
from tests.broker import free_port
from tests.outputs.guest_servers import gpsd
from tests.outputs.serving import Around, at_work, connected
from tests.patience import PATIENCE_S, until

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


# ------------------------------------------------------------------ the unit


def test_the_unit_has_descriptors_for_all_clients() -> None:
    unit = Path(__file__).parents[2] / "systemd" / "fusiond.service"
    (line,) = [x for x in unit.read_text().splitlines() if x.startswith("LimitNOFILE=")]
    places = 2 * tcp.MOST_CLIENTS + MOST_SCRAPERS + 32
    assert int(line.partition("=")[2]) >= places + door.RESERVED_DESCRIPTORS


# ------------------------------------------------------------------ who gives way


class Placed(NamedTuple):
    host: str
    overdue: bool = False

    def owes(self, now_ns: int) -> bool:
        return self.overdue


@pytest.mark.parametrize(
    ("taken", "comes", "gives"),
    [
        ("", "a", None),
        ("aaa", "a", None),
        ("aaa", "b", 2),
        ("aab", "c", 1),
        ("abc", "d", None),
        ("aab", "b", None),
        ("aaab", "b", 2),
        ("bAaa", "b", 1),
        ("bAaa", "a", 1),
        ("abBA", "c", 2),
    ],
)
def test_eviction_order_of_clients(taken: str, comes: str, gives: int | None) -> None:
    """Hosts are letters, great ones owe something."""
    placed = [Placed(letter.lower(), letter.isupper()) for letter in taken]
    found = gives_way(placed, comes, 0)
    assert found is (None if gives is None else placed[gives])


def test_a_host_of_ipv6_is_its_network() -> None:
    def host(name: str) -> str:
        return host_of((name, 5000, 0, 0))

    assert host_of(("10.0.0.7", 5000)) == "10.0.0.7"
    assert host("::ffff:10.0.0.7") == "10.0.0.7"
    assert host("2001:db8:1:2::9") == host("2001:db8:1:2:ffff:ffff:ffff:fff7")
    assert host("2001:db8:1:2::9") != host("2001:db8:1:3::9")
    assert host("fe80::1%eth0") == host("fe80::2%eth0")
    assert host_of("") == host_of(("", 0)) == ""


async def test_one_host_keeps_all_places_only_while_nobody_else_comes() -> None:
    """Loopback has sixteen million addresses: who comes from each is another host."""

    async def come(host: str) -> socket.socket:
        sock = socket.socket()
        sock.setblocking(False)
        sock.bind((host, 0))
        await asyncio.get_running_loop().sock_connect(sock, server.server.port.address)
        return sock

    around = Around(guests=Guests())
    around.surroundings.guests.most = 8
    async with gpsd(around) as server:
        crowd = [await come("127.0.0.2") for _ in range(12)]
        await until(lambda: server.counters["clients_refused"] == 4)
        others = [await come(f"127.0.0.{3 + n}") for n in range(3)]
        others += [await come("127.0.0.3") for _ in range(3)]
        # 5 of the crowd were left; the first of the others may have three as it has, no more.
        await until(lambda: server.counters["clients_refused"] == 4 + 1)
        assert server.counters["clients_gave_way"] == 5
        hosts = Counter(client.host for client in server.server.clients)
        assert hosts == {"127.0.0.2": 3, "127.0.0.3": 3, "127.0.0.4": 1, "127.0.0.5": 1}
        for sock in crowd + others:
            sock.close()


async def test_a_client_that_reads_no_answer_gives_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would have half a minute, as long as no one else wants its place."""
    monkeypatch.setattr(tcp, "HASTY_S", 0.0)
    output = PrometheusEndpoint(Prometheus(port=free_port()), Around().surroundings)
    monkeypatch.setattr(output, "_metrics", lambda: b"x" * 500_000)
    async with at_work(output):
        deaf = []
        for _ in range(MOST_SCRAPERS):
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.connect(output.server.port.address)
            sock.send(b"GET /metrics HTTP/1.1\r\n\r\n")
            deaf.append(sock)
        await until(lambda: output.counters["scrapes"] == MOST_SCRAPERS)
        async with connected(output.server.port.address) as client:
            client.writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
            async with asyncio.timeout(PATIENCE_S):
                assert len(await client.reader.read()) > 500_000
        assert output.counters["clients_gave_way"] == 1
        for sock in deaf:
            sock.close()
