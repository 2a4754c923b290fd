"""What is seen of a daemon's `nav`, stage by stage, each in a process that does nothing else:

    python benchmarks/probes.py heard PORT TOPIC     a client of the broker: arrival, and t_ms
    python benchmarks/probes.py wire PORT TOPIC      what reaches the broker, stamped by the kernel
    python benchmarks/probes.py bare                 a loop that wakes every 10 ms, and nothing else

Says `ready`, and at the end of its input prints as JSON the instants, s: of `heard` and `wire` with
the `t_ms` of each message, which says of which tick it is. `bare` is the computer's own share: no
program that wakes as a tick does has smaller gaps than it. `wire` looks at the loopback's packets
(AF_PACKET: root, or a network namespace of one's own).
"""

from __future__ import annotations

import asyncio
import json
import re
import select
import socket
import struct
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

PERIOD_S = 0.01
"""A tick at 100 Hz."""
CONNECT_CLEAN = b"\x00\x04MQTT\x04\x02\x00\x00"
"""MQTT 3.1.1, clean session, no keep-alive (section 3.1 of the standard); the name follows."""
_SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; the socket module has no name for it."""
_TO_US = 0
"""PACKET_HOST of packet(7): a packet of the loopback is seen twice, once as it leaves."""
_ANY_PROTOCOL, _IPV4, _TCP, _ETHERNET = 3, b"\x08\x00", 6, 14
_LONGEST = 1 << 17
_HELD_BYTES = 1 << 26

Seen = list[tuple[float, int]]


def gap_ms(times_s: list[float]) -> float:
    """The largest between neighbours; infinite where there are none."""
    gaps = [b - a for a, b in pairwise(times_s)]
    return round(1000.0 * max(gaps, default=float("inf")), 1)


def _told(topic: str) -> re.Pattern[bytes]:
    """A publication's instant; between topic and payload MQTT 5 has its properties (QoS 0)."""
    payload = rb'[^{]{0,16}\{.{0,60}?"t_ms":(\d+)'
    return re.compile(re.escape(topic.encode()) + payload, re.DOTALL)


def _text(data: bytes) -> bytes:
    return len(data).to_bytes(2) + data


def _subscribed(port: int, topic: str) -> socket.socket:
    sock = socket.create_connection(("127.0.0.1", port))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connect = CONNECT_CLEAN + _text(b"probe-%d" % time.time_ns())
    subscribe = b"\x00\x01" + _text(topic.encode()) + b"\x00"
    sock.sendall(bytes([0x10, len(connect)]) + connect)
    sock.sendall(bytes([0x82, len(subscribe)]) + subscribe)
    return sock


def _until_told(*watched: socket.socket) -> bool:
    """Wait for something to read; False at the end of our input."""
    ready, _, _ = select.select([sys.stdin, *watched], [], [])
    return sys.stdin not in ready


def heard(port: int, topic: str) -> Seen:
    """Arrivals at a client that does nothing but read."""
    seen: Seen = []
    pattern = _told(topic)
    rest = b""
    with _subscribed(port, topic) as sock:
        print("ready", flush=True)
        while _until_told(sock):
            data = sock.recv(_LONGEST)
            now_s = time.monotonic()
            if not data:
                break
            rest += data
            end = 0
            for found in pattern.finditer(rest):
                seen.append((now_s, int(found[1])))
                end = found.end()
            rest = rest[end:][-_LONGEST:]
    return seen


def wire(port: int, topic: str) -> Seen:
    """Packets to the broker, by the kernel's stamp of each (CLOCK_REALTIME)."""
    seen: Seen = []
    pattern = _told(topic)
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ANY_PROTOCOL)) as sock:
        sock.bind(("lo", 0))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _HELD_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        print("ready", flush=True)
        while _until_told(sock):
            data, ancillary, _, address = sock.recvmsg(_LONGEST, 64)
            if address[2] != _TO_US or data[12:14] != _IPV4 or data[23] != _TCP:
                continue
            ports = _ETHERNET + 4 * (data[_ETHERNET] & 0xF)
            if struct.unpack_from(">H", data, ports + 2) != (port,):
                continue
            for found in pattern.finditer(data):
                seconds, nanoseconds = struct.unpack("qq", ancillary[0][2])
                seen.append((seconds + 1e-9 * nanoseconds, int(found[1])))
    return seen


def bare() -> Seen:
    """A loop that wakes at absolute deadlines and does nothing."""
    seen: Seen = []
    print("ready", flush=True)
    deadline_s = time.monotonic()
    while True:
        deadline_s += PERIOD_S
        ready, _, _ = select.select([sys.stdin], [], [], max(0.0, deadline_s - time.monotonic()))
        seen.append((time.monotonic(), 0))
        if ready:
            return seen


@dataclass
class Probed:
    """What the probes saw, once it is over."""

    heard: Seen = field(default_factory=list)
    wire: Seen = field(default_factory=list)
    bare: Seen = field(default_factory=list)

    def row(self) -> dict[str, Any]:
        """The largest gap at each stage, ms, and the oldest `nav` when it was sent and heard."""
        return {
            "nav_ms": gap_ms([at_s for at_s, _ in self.heard]),
            "sent_ms": gap_ms([at_s for at_s, _ in self.wire]),
            "tick_ms": gap_ms([t_ms * 1e-3 for _, t_ms in self.heard]),
            "bare_ms": gap_ms([at_s for at_s, _ in self.bare]),
        }


@asynccontextmanager
async def probing(port: int, topic: str) -> AsyncIterator[Probed]:
    """All three while the context lasts; what they saw is there after it."""
    probed = Probed()
    words = {"heard": (str(port), topic), "wire": (str(port), topic), "bare": ()}
    started = {
        name: await asyncio.create_subprocess_exec(
            *(sys.executable, str(Path(__file__)), name, *more),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=1 << 26,
        )
        for name, more in words.items()
    }
    try:
        for process in started.values():
            assert process.stdout is not None
            await process.stdout.readline()
        yield probed
        for name, process in started.items():
            told, _ = await process.communicate(b"\n")  # and the end of its input
            setattr(probed, name, json.loads(told))
    finally:
        for process in started.values():
            if process.returncode is None:
                process.kill()
                await process.wait()


def main() -> None:
    name, *more = sys.argv[1:]
    if name == "bare":
        print(json.dumps(bare()))
        return
    port, topic = int(more[0]), more[1]
    print(json.dumps({"heard": heard, "wire": wire}[name](port, topic)))


if __name__ == "__main__":
    main()
