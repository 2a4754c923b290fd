"""What guests may cost: turns and allowances, over real connections."""

from __future__ import annotations

import asyncio
import json
import socket
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.configuration.outputs import NmeaServed
from fusiond.outputs import client_sockets as door
from fusiond.outputs import tcp
from fusiond.outputs.client_rate_limits import BYTES, MESSAGES, Bucket, Rate
from fusiond.outputs.client_sockets import BUDGET_NS, WINDOW_NS, Guests, ServerQueue
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.nmea import NmeaServer
from fusiond.outputs.topics import HEALTH, NAV
from tests.broker import free_port
from tests.outputs.guest_servers import descriptors, gpsd
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, at_work, connected, nav
from tests.patience import until

S = 1_000_000_000


# ------------------------------------------------------------------ turns


async def test_work_beyond_the_budget_waits_for_the_next_window(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each piece costs a third of the budget on a clock of the test's own: three a window."""
    now_ns = 0
    monkeypatch.setattr(door.time, "perf_counter_ns", lambda: now_ns)
    guests, done = Guests(), 0
    queue = ServerQueue(guests)

    def work() -> None:
        nonlocal now_ns, done
        now_ns += BUDGET_NS // 3 + 1
        done += 1

    one, other = socket.socketpair()
    with one, other:
        queue.watch(one.fileno(), 1, lambda _: None)
        for _ in range(100):
            queue.do(work)
        for count in range(3, 33, 3):
            await until(lambda count=count: done >= count)  # type: ignore[misc]
            await asyncio.sleep(2e-9 * WINDOW_NS)
            assert done == count, "in the same window nothing more is done"
            now_ns += WINDOW_NS
        assert guests.postponed >= 10
        queue.forget(one.fileno())


async def test_a_server_waits_for_no_guest_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand pieces at one server, and one at another, which is done as the second of all."""
    now_ns = 0
    monkeypatch.setattr(door.time, "perf_counter_ns", lambda: now_ns)
    guests = Guests()
    crowded, other = ServerQueue(guests), ServerQueue(guests)
    done: list[str] = []

    def work(name: str) -> None:
        nonlocal now_ns
        now_ns += BUDGET_NS // 3 + 1
        done.append(name)

    one, two = socket.socketpair()
    with one, two:
        crowded.watch(one.fileno(), 1, lambda _: None)
        other.watch(two.fileno(), 1, lambda _: None)
        for _ in range(1000):
            crowded.do(lambda: work("crowded"))
        other.do(lambda: work("other"))
        await until(lambda: len(done) >= 3)
        assert done == ["crowded", "other", "crowded"]
        crowded.forget(one.fileno())
        other.forget(two.fileno())


async def test_a_flooding_client_does_not_block_others() -> None:
    """Sixty-three who ask without end, and one who asks once."""
    async with gpsd() as server, connected(server.server.port.address) as patient:
        server.publish(NAV, nav())
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


async def test_a_client_above_the_request_rate_is_dropped() -> None:
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
        server.publish(NAV, nav())
        await client.line()
        client.writer.write(b"?POLL;" * 20)
        answers = [await client.line() for _ in range(20)]
        assert len(set(answers)) == 1
        assert made == 1
        server.publish(NAV, nav(height_m=1.0))
        client.writer.write(b"?POLL;")
        assert json.loads(await client.line())["tpv"][0]["altHAE"] == 1.0
        assert made == 2


async def test_a_client_above_the_byte_rate_is_read_slowly() -> None:
    """Its bytes wait at its own side; nothing of them is kept here."""
    server = NmeaServer(NmeaServed(port=free_port()), Around().surroundings)
    async with at_work(server), connected(server.server.port.address) as talker:
        for _ in range(1000):
            talker.writer.write(b"x" * 4096)
        await until(lambda: server.counters["slowed"] > 0)
        server.publish(NAV, nav())
        assert (await talker.line()).startswith(b"$GNRMC")
        # What goes on after a while is read again.
        await until(lambda: server.counters["slowed"] > 1)
        assert not talker.writer.is_closing()


def test_a_plotter_may_talk_as_it_does() -> None:
    assert BYTES.per_s > 3840  # 38400 baud


# ------------------------------------------------------------------ who does not read


async def test_a_client_that_never_reads_is_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It has no epoch to skip, so that only time tells; and its descriptor goes with it."""
    monkeypatch.setattr(tcp, "STUCK_S", 0.5)
    async with gpsd() as server:
        before = descriptors()
        deaf = socket.socket()
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(server.server.port.address)
        server.publish(HEALTH, EXAMPLES["health"])
        server.publish(NAV, nav())
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
