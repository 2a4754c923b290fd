"""Clients by the hundred, in a process of their own, each of which listens, or scrapes.

    python benchmarks/clients.py COUNT MQTT_PORT GPSD_PORT NMEA_PORT [FOXGLOVE_PORT PROMETHEUS_PORT]

Connects `COUNT` of each (of Foxglove and Prometheus 32 at most, the places there are), says
`connected`, and at the end of its input prints as JSON how many messages (MQTT), lines (gpsd,
NMEA), messages of all channels (Foxglove) and answers (Prometheus, asked once a second) the slowest
and the fastest client of each kind had since then, and how much of a core this process took. A
client counts what comes and reads no more of it: they run on the daemon's computer, and what they
take is not there for the daemon.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.attackers import SCRAPE, UPGRADE, subscribe

CHANNELS = 11
"""Of the daemon's Foxglove server."""
MOST_FEW = 32
WATCH = b'?WATCH={"enable":true,"json":true}\n'
PUBLISH = 3
CONNECT_CLEAN = b"\x00\x04MQTT\x04\x02\x00\x00"
"""MQTT 3.1.1, clean session, no keep-alive (section 3.1 of the standard); the name follows."""
TOPIC = b"fusiond/#"


def _text(data: bytes) -> bytes:
    return len(data).to_bytes(2) + data


def _packet(kind: int, body: bytes) -> bytes:
    assert len(body) < 128
    return bytes([kind, len(body)]) + body


class Lines(asyncio.Protocol):
    """Says something once it is connected, then counts lines."""

    def __init__(self, greeting: bytes, ready: asyncio.Semaphore) -> None:
        self._greeting = greeting
        self._ready = ready
        self.received = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(self._greeting)
        self._ready.release()

    def data_received(self, data: bytes) -> None:
        self.received += data.count(b"\n")


class Messages(asyncio.Protocol):
    """Subscribes to all of fusiond with quality 0, then counts what is published."""

    def __init__(self, number: int, ready: asyncio.Semaphore) -> None:
        self._name = f"listener-{number}".encode()
        self._ready = ready
        self._rest = b""
        self.received = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(_packet(0x10, CONNECT_CLEAN + _text(self._name)))
        transport.write(_packet(0x82, b"\x00\x01" + _text(TOPIC) + b"\x00"))
        self._ready.release()

    def data_received(self, data: bytes) -> None:
        data = self._rest + data
        begin = 0
        while (after := _end(data, begin)) is not None:
            self.received += data[begin] >> 4 == PUBLISH
            begin = after
        self._rest = data[begin:]


class Viewing(asyncio.Protocol):
    """Subscribes to every channel of Foxglove, then counts frames."""

    def __init__(self, ready: asyncio.Semaphore) -> None:
        self._ready = ready
        self._rest = b""
        self._upgraded = False
        self.received = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(UPGRADE + subscribe(0, CHANNELS))
        self._ready.release()

    def data_received(self, data: bytes) -> None:
        data = self._rest + data
        begin = 0
        if not self._upgraded:
            head = data.find(b"\r\n\r\n")
            if head < 0:
                self._rest = data
                return
            self._upgraded, begin = True, head + 4
        while (after := _frame_end(data, begin)) is not None:
            self.received += 1
            begin = after
        self._rest = data[begin:]


def _frame_end(data: bytes, begin: int) -> int | None:
    """Where a server's frame ends (RFC 6455, 5.2); None while it is not all there."""
    size, at = (data[begin + 1] & 0x7F, begin + 2) if len(data) >= begin + 2 else (126, len(data))
    if size >= 126:
        more = 2 if size == 126 else 8
        size, at = int.from_bytes(data[at : at + more]), at + more
    return at + size if at + size <= len(data) else None


class Scraping:
    """Asks once a second, and counts whole answers."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.received = 0

    async def run(self) -> None:
        while True:
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
                writer.write(SCRAPE)
                answer = await reader.read()
                self.received += answer.startswith(b"HTTP/1.1 200") and b"fusiond_mode" in answer
                writer.close()
            await asyncio.sleep(1.0)


def _end(data: bytes, begin: int) -> int | None:
    """Where the packet at `begin` ends (section 2.2.3); None while it is not all there."""
    length, shift, at = 0, 0, begin + 1
    while at < len(data):
        length |= (data[at] & 0x7F) << shift
        shift += 7
        at += 1
        if not data[at - 1] & 0x80:
            return at + length if at + length <= len(data) else None
    return None


async def main(
    count: int, mqtt: int, gpsd: int, nmea: int, foxglove: int = 0, prometheus: int = 0
) -> None:
    ready = asyncio.Semaphore(0)
    loop = asyncio.get_running_loop()
    clients: dict[str, list[Messages | Lines | Viewing | Scraping]] = {
        "mqtt": [],
        "gpsd": [],
        "nmea": [],
    }
    for number in range(count):
        for name, port, make in (
            ("mqtt", mqtt, partial(Messages, number, ready)),
            ("gpsd", gpsd, partial(Lines, WATCH, ready)),
            ("nmea", nmea, partial(Lines, b"", ready)),
        ):
            _, client = await loop.create_connection(make, "127.0.0.1", port)
            clients[name].append(client)
    few = min(count, MOST_FEW) if foxglove else 0
    for _ in range(few):
        _, viewer = await loop.create_connection(partial(Viewing, ready), "127.0.0.1", foxglove)
        clients.setdefault("foxglove", []).append(viewer)
    for _ in range(3 * count + few):
        await ready.acquire()
    scrapers = [Scraping(prometheus) for _ in range(few)]
    tasks = [asyncio.create_task(scraper.run()) for scraper in scrapers]
    if scrapers:
        clients["prometheus"] = [*scrapers]
    before = {name: [client.received for client in each] for name, each in clients.items()}
    began_s, used_s = time.monotonic(), time.process_time()
    print("connected", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    for task in tasks:
        task.cancel()
    core = (time.process_time() - used_s) / (time.monotonic() - began_s)
    found = {
        name: [client.received - n for client, n in zip(each, before[name], strict=True)]
        for name, each in clients.items()
    }
    told = {name: [min(counts), max(counts)] for name, counts in found.items()}
    print(json.dumps({**told, "cpu_percent": round(100.0 * core, 1)}), flush=True)


if __name__ == "__main__":
    asyncio.run(main(*map(int, sys.argv[1:])))
