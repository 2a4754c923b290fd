"""Connections to the web server that ask nothing, or take nothing: nobody else waits for them."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from fusiond.dashboard import connection_limits
from fusiond.dashboard.connection_limits import MOST_CONNECTIONS
from fusiond.dashboard.serve import PMTILES
from tests.dashboard.serving import at_work, browsing
from tests.dashboard.test_page import make_hub
from tests.patience import PATIENCE_S, until

ESTABLISHED = 1
"""TCP_ESTABLISHED of the kernel's include/net/tcp_states.h."""


async def opened(address: str, said: bytes = b"") -> socket.socket:
    """A connection of one who is in no hurry."""
    host, port = address.split(":")
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, (host, int(port)))
    sock.send(said)
    return sock


async def page(address: str) -> bytes:
    """What one gets who asks for the page."""
    host, port = address.split(":")
    async with asyncio.timeout(PATIENCE_S):
        reader, writer = await asyncio.open_connection(host, int(port))
        asked = f"GET / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
        writer.write(asked.encode())
        answer = await reader.read()
        writer.close()
    return answer


async def ended(sock: socket.socket) -> None:
    """Wait for the end that the server makes, whatever it has sent until then."""
    async with asyncio.timeout(PATIENCE_S):
        try:
            while await asyncio.get_running_loop().sock_recv(sock, 65536):
                pass
        except ConnectionError:
            pass
    sock.close()


@asynccontextmanager
async def crowd(address: str, count: int, said: bytes) -> AsyncIterator[list[socket.socket]]:
    socks = [await opened(address, said) for _ in range(count)]
    try:
        yield socks
    finally:
        for sock in socks:
            sock.close()


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: x\r\n"])
async def test_a_thousand_slow_ones_keep_nobody_from_the_page(said: bytes) -> None:
    async with at_work(make_hub()) as address, browsing(address) as browser:
        await browser.until(lambda b: b.frames)
        async with crowd(address, 1000, said) as slow:
            for _ in range(3):
                assert (await page(address)).startswith(b"HTTP/1.1 200")
            frames = browser.frames
            await browser.until(lambda b: b.frames > frames + 2)
            for sock in slow[: 1000 - MOST_CONNECTIONS]:
                await ended(sock)


async def test_a_request_that_does_not_come_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connection_limits, "REQUEST_S", 0.2)
    monkeypatch.setattr(connection_limits, "LOOK_S", 0.05)
    async with at_work(make_hub()) as address, browsing(address) as browser:
        await ended(await opened(address))
        await ended(await opened(address, b"GET / HT"))
        # ... nor a second one, of which a byte came; uvicorn's own limit has ended with that byte.
        whole = f"GET / HTTP/1.1\r\nHost: {address}\r\n\r\nG".encode()
        await ended(await opened(address, whole))
        frames = browser.frames
        await browser.until(lambda b: b.frames > frames + 5)


async def test_a_client_that_reads_no_answer_is_disconnected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_limits, "STUCK_S", 0.3)
    monkeypatch.setattr(connection_limits, "LOOK_S", 0.05)
    land = tmp_path / "land.pmtiles"
    land.write_bytes(PMTILES + bytes(8_000_000))
    async with at_work(make_hub(), base_map=land) as address:
        asked = f"GET /map.pmtiles HTTP/1.1\r\nHost: {address}\r\n\r\n"
        sock = await opened(address, asked.encode())
        await until(
            lambda: sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != ESTABLISHED
        )
        sock.close()
