"""gpsd's protocol as gpsd's clients speak it; a real gpsd reads ours."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fusiond.configuration.outputs import Gpsd, NmeaServed
from fusiond.outputs import tcp
from fusiond.outputs.gpsd.server import GpsdServer
from fusiond.outputs.nmea import NmeaServer
from fusiond.outputs.tcp import MOST_CLIENTS, MOST_SKIPPED
from fusiond.outputs.topics import HEALTH, NAV
from tests.broker import free_port
from tests.outputs.messages_examples import EXAMPLES
from tests.outputs.serving import Around, TcpClient, at_work, connected, feed, nav
from tests.patience import until
from tests.places import REPOSITORY

WATCH = b'?WATCH={"enable":true,"json":true}'


@asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[GpsdServer]:
    server = GpsdServer(Gpsd(port=free_port(), **options), Around().surroundings)
    async with at_work(server):
        yield server


async def watching(server: GpsdServer, client: TcpClient, request: bytes) -> list[bytes]:
    """Greeting and answer to a request to watch, which has been taken when this returns."""
    client.writer.write(request)
    lines = [await client.line() for _ in range(3)]
    await until(lambda: any(server.wanted(c).enable for c in server.server.clients))
    return lines


# ------------------------------------------------------------------ the server


async def test_a_client_watches_and_polls() -> None:
    async with serving() as server, connected(server.server.port.address) as client:
        server.publish(HEALTH, EXAMPLES["health"])
        lines = [json.loads(x) for x in await watching(server, client, WATCH)]
        assert [x["class"] for x in lines] == ["VERSION", "DEVICES", "WATCH"]
        assert lines[0]["proto_major"] == 3
        assert lines[2]["enable"] is lines[2]["json"] is True
        server.publish(NAV, nav())
        epoch = [json.loads(await client.line()) for _ in range(4)]
        assert [x["class"] for x in epoch] == ["TPV", "ATT", "GST", "SKY"]
        assert {x["device"] for x in epoch} == {"fusiond://truck"}
        client.writer.write(b"?POLL;")
        polled = json.loads(await client.line())
        assert polled["tpv"] == [epoch[0]]
        assert (polled["att"], polled["gst"]) == ([epoch[1]], [epoch[2]])
        assert polled["sky"][0]["satellites"] == []  # gpsd-py3 takes the last of them
        client.writer.write(b'?WATCH={"enable":false};?NONSENSE;')
        answers = [json.loads(await client.line()) for _ in range(3)]
        assert [x["class"] for x in answers] == ["DEVICES", "WATCH", "ERROR"]
        server.publish(NAV, nav())
        client.writer.write(b"?VERSION;")
        assert json.loads(await client.line())["class"] == "VERSION"
        assert server.counters["malformed"] == 1
        assert server.counters["requests"] == 5


async def test_a_client_without_semicolon_and_one_that_wants_nmea() -> None:
    async with serving() as server:
        async with connected(server.server.port.address) as gps3:
            await watching(server, gps3, b'?WATCH={"enable":true,"json":true}')
            server.publish(NAV, nav())
            assert json.loads(await gps3.line())["class"] == "TPV"
        async with connected(server.server.port.address) as gpspipe:
            await watching(server, gpspipe, b'?WATCH={"enable":true,"nmea":true};\n')
            server.publish(NAV, nav())
            assert (await gpspipe.line()).startswith(b"$GNRMC,233307.12,A,3101.5263323,N,")
        async with connected(server.server.port.address) as kismet:
            await watching(server, kismet, b'?WATCH={"json":true};\n')
            server.publish(NAV, nav())
            assert json.loads(await kismet.line())["class"] == "TPV"


async def test_a_client_that_names_no_format_gets_answers_alone() -> None:
    """As gpsd 3.22 has it: gpsd-py3 enables, then takes the next line for the answer to a POLL."""
    async with serving() as server, connected(server.server.port.address) as client:
        lines = await watching(server, client, b'?WATCH={"enable":true}\n')
        assert json.loads(lines[2]) == {
            "class": "WATCH",
            "enable": True,
            "json": False,
            "nmea": False,
            "raw": 0,
            "scaled": False,
            "timing": False,
            "split24": False,
            "pps": False,
        }
        for _ in range(2):
            server.publish(NAV, nav())
            await asyncio.sleep(0)
            client.writer.write(b"?POLL;\n")
            polled = json.loads(await client.line())
            assert polled["class"] == "POLL"
            assert polled["tpv"][0]["lat"] == nav().lat_deg
        client.writer.write(b'?WATCH={"enable":true,"json":true};?WATCH={"enable":true};')
        answers = [json.loads(await client.line()) for _ in range(4)]
        assert answers[3]["json"] is True, "what was asked for once stays"


async def test_clients_that_leave_at_once_or_ask_nonsense_harm_nobody() -> None:
    async with serving() as server, connected(server.server.port.address) as patient:
        await watching(server, patient, WATCH)
        for _ in range(20):
            async with connected(server.server.port.address) as hasty:
                hasty.writer.write(b"?WATCH=" + b"{" * 100)
        async with connected(server.server.port.address) as rude:
            rude.writer.write(b"\x00\xff" * 20_000 + b'?WATCH={"enable":7};')
            await rude.line()
            assert json.loads(await rude.line())["class"] == "ERROR"
        await until(lambda: len(server.server.clients) == 1)
        server.publish(NAV, nav())
        assert json.loads(await patient.line())["class"] == "TPV"


async def test_a_client_that_does_not_read_is_skipped_then_dropped_alone() -> None:
    async with serving() as server, connected(server.server.port.address) as quick:
        await watching(server, quick, WATCH)
        with socket.socket() as stuck:
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.setblocking(False)
            await asyncio.get_running_loop().sock_connect(stuck, server.server.port.address)
            await asyncio.get_running_loop().sock_sendall(stuck, WATCH)
            reading = asyncio.create_task(quick.ended())
            await feed(server, lambda: server.counters["clients_dropped"] > 0)
        assert server.counters["skipped"] >= MOST_SKIPPED
        assert server.counters["clients_dropped"] == 1
        assert len(server.server.clients) == 1
        reading.cancel()


async def test_more_clients_than_there_may_be_are_sent_away() -> None:
    async with serving() as server:
        socks = [
            await asyncio.open_connection(*server.server.port.address) for _ in range(MOST_CLIENTS)
        ]
        await until(lambda: len(server.server.clients) == MOST_CLIENTS)
        async with connected(server.server.port.address) as surplus:
            await surplus.ended()
        assert server.counters["clients_refused"] == 1
        assert server.status.detail.endswith(f"{MOST_CLIENTS} connected")
        for _, writer in socks:
            writer.transport.abort()


async def test_a_port_that_is_taken_is_said_and_tried_again() -> None:
    around = Around()
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        server = GpsdServer(Gpsd(port=port), around.surroundings)
        task = asyncio.create_task(server.run())
        await until(lambda: server.status.state == "absent")
        assert [code for code, _ in around.events] == ["gpsd_absent"]
    await until(lambda: server.status.state == "running")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert len(around.events) == 1


# Descriptors 3 and 4, of which the second is ours.
ACTIVATED = """
import os, sys
from fusiond.outputs.activation import activated
os.dup2(int(sys.argv[1]), 4)
environ = {"LISTEN_FDS": "2", "LISTEN_FDNAMES": "other:gpsd:more"}
assert activated("gpsd", environ) is None
assert activated("gpsd", environ | {"LISTEN_PID": str(os.getpid() + 1)}) is None
environ["LISTEN_PID"] = str(os.getpid())
assert activated("more", environ) is activated("nmea", environ) is None
activated("gpsd", environ).close()
activated("gpsd", environ).accept()[0].sendall(b"ours\\r\\n")
"""


async def test_the_service_managers_socket_is_ours() -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        number = held.fileno()
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", ACTIVATED, str(number), pass_fds=[number]
        )
        async with connected(held.getsockname()) as client:
            assert await client.line() == b"ours"
        assert await process.wait() == 0


def test_the_shipped_socket_has_our_name_and_port() -> None:
    unit = (REPOSITORY / "systemd" / "fusiond-gpsd.socket").read_text()
    options = Gpsd()
    assert f"\nListenStream={options.host}:{options.port}\n" in unit
    assert f"\nFileDescriptorName={GpsdServer.name}\n" in unit


async def test_the_service_managers_socket_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        monkeypatch.setattr(tcp, "activated", lambda name: held.dup() if name == "gpsd" else None)
        async with serving() as server:
            assert server.server.port.address == held.getsockname()
            async with connected(held.getsockname()) as client:
                assert json.loads(await client.line())["class"] == "VERSION"


# ------------------------------------------------------------------ a real gpsd


@asynccontextmanager
async def real_gpsd(source: str, folder: Path) -> AsyncIterator[TcpClient]:
    """Debian's gpsd on a source of ours, and a client that watches it."""
    binary = shutil.which("gpsd", path=f"{os.environ['PATH']}:/usr/sbin")
    assert binary is not None, "gpsd is missing: apt-get install gpsd"
    port = free_port()
    with (folder / "gpsd.log").open("wb") as log:
        process = await asyncio.create_subprocess_exec(
            binary, "-N", "-n", "-S", str(port), source, stdout=log, stderr=log
        )
    try:

        def listens() -> bool:
            assert process.returncode is None, (folder / "gpsd.log").read_text()
            with socket.socket() as s:
                return s.connect_ex(("127.0.0.1", port)) == 0

        await until(listens)
        async with connected(("127.0.0.1", port)) as client:
            client.writer.write(b'?WATCH={"enable":true,"json":true};\n')
            yield client
    finally:
        process.terminate()
        await process.wait()


async def first(client: TcpClient, name: str, fix: int) -> dict[str, Any]:
    """The first report of that class that has the fix, or any for a class without one."""
    while True:
        report: dict[str, Any] = json.loads(await client.line())
        if report["class"] == name and report.get("mode", fix) == fix:
            return report


@pytest.mark.parametrize("output", ["gpsd", "nmea"])
async def test_a_real_gpsd_takes_our_fixes(output: str, tmp_path: Path) -> None:
    port = free_port()
    around = Around().surroundings
    if output == "gpsd":
        source, server = f"gpsd://127.0.0.1:{port}", GpsdServer(Gpsd(port=port), around)
    else:
        source, server = f"tcp://127.0.0.1:{port}", NmeaServer(NmeaServed(port=port), around)
    async with at_work(server), real_gpsd(source, tmp_path) as client:
        feeding = asyncio.create_task(feed_seconds(server))
        try:
            said = await first(client, "TPV", 3)
        finally:
            feeding.cancel()
    assert said["lat"] == pytest.approx(31.025438871, abs=1e-8)
    assert said["lon"] == pytest.approx(121.441209483, abs=1e-8)
    assert said["altHAE"] == pytest.approx(17.42, abs=0.01)
    assert said["altMSL"] == pytest.approx(6.12, abs=0.01)
    assert said["speed"] == pytest.approx(8.461, abs=0.01)
    assert said["time"].startswith("2026-11-20T23:33:")


async def feed_seconds(server: GpsdServer | NmeaServer) -> None:
    """Epochs of their own second each: gpsd tells epochs apart by it."""
    t_ms = EXAMPLES["nav"].t_ms
    assert t_ms is not None
    for second in range(10_000):
        at = t_ms % 60_000 // 1000 + second
        server.publish(
            NAV, nav(t_ms=t_ms + 1000 * second, t_utc=f"2026-11-20T23:33:{at % 60:02d}.123Z")
        )
        await asyncio.sleep(0.05)
