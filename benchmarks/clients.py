"""Clients by the hundred, in a process of their own: MQTT, gpsd and NMEA, each of which listens.

    python benchmarks/clients.py COUNT MQTT_PORT GPSD_PORT NMEA_PORT

Connects `COUNT` of each, says `connected`, and at the end of its input prints as JSON how many
messages (MQTT), lines (gpsd, NMEA) the slowest and the fastest client of each kind had since then.
"""

from __future__ import annotations

import asyncio
import json
import sys

import aiomqtt

WATCH = b'?WATCH={"enable":true,"json":true}\n'


class Counts:
    """What each client of a kind has received."""

    def __init__(self, clients: int) -> None:
        self.received = [0] * clients
        self.connected = asyncio.Semaphore(0)

    def begin(self) -> None:
        self.received = [0] * len(self.received)

    def range(self) -> list[int]:
        return [min(self.received), max(self.received)]


async def _mqtt(port: int, counts: Counts, number: int) -> None:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe("fusiond/#")
        counts.connected.release()
        async for _ in client.messages:
            counts.received[number] += 1


async def _lines(port: int, greeting: bytes, counts: Counts, number: int) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(greeting)
    counts.connected.release()
    while await reader.readline():
        counts.received[number] += 1


async def main(clients: int, mqtt: int, gpsd: int, nmea: int) -> None:
    counts = {name: Counts(clients) for name in ("mqtt", "gpsd", "nmea")}
    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(work)
            for k in range(clients)
            for work in (
                _mqtt(mqtt, counts["mqtt"], k),
                _lines(gpsd, WATCH, counts["gpsd"], k),
                _lines(nmea, b"", counts["nmea"], k),
            )
        ]
        for each in counts.values():
            for _ in range(clients):
                await each.connected.acquire()
            each.begin()
        print("connected", flush=True)
        await asyncio.to_thread(sys.stdin.read)
        print(json.dumps({name: each.range() for name, each in counts.items()}), flush=True)
        for task in tasks:
            task.cancel()


if __name__ == "__main__":
    asyncio.run(main(*map(int, sys.argv[1:5])))
