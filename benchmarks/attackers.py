"""What guests do to the daemon's servers, each in a process of its own:

    python benchmarks/attackers.py NAME SECONDS GPSD NMEA PROMETHEUS FOXGLOVE MQTT    (ports)

Says `attacking` once it has begun, and at the end as JSON how many connections it made and how many
bytes it sent. It yields the processor to everyone else (nice 19): an attacker has its own, and what
it takes of the daemon's computer is no answer to its attack. It comes from 127.0.0.2, so that it is
another host than who comes from 127.0.0.1.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import resource
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count, cycle, repeat
from typing import NamedTuple


class Ports(NamedTuple):
    gpsd: int
    nmea: int
    prometheus: int
    foxglove: int
    mqtt: int
    """Of the broker that the daemon listens at."""


FROM = ("127.0.0.2", 0)
WATCH = b'?WATCH={"enable":true,"json":true};'
DEVICE = b'?DEVICE={"path":"fusiond://load","bps":115200,"parity":"N","native":1};'
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.websocket.v1\r\n"
    b"Sec-WebSocket-Key: " + base64.b64encode(bytes(16)) + b"\r\n\r\n"
)


def frame(payload: bytes, opcode: int = 1) -> bytes:
    """A client's frame, masked with zeros (RFC 6455, 5.2)."""
    size = len(payload)
    if size < 126:
        head = struct.pack(">BB", 0x80 | opcode, 0x80 | size)
    elif size < 65536:
        head = struct.pack(">BBH", 0x80 | opcode, 0x80 | 126, size)
    else:
        head = struct.pack(">BBQ", 0x80 | opcode, 0x80 | 127, size)
    return head + bytes(4) + payload


def subscribe(first: int, count: int) -> bytes:
    wanted = [{"id": first + k, "channelId": 1 + (first + k) % 11} for k in range(count)]
    return frame(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())


@dataclass
class Sender:
    """A connection that is made anew when it is lost: `parts()` is what it says, of which nothing
    is read where `deaf`."""

    port: int
    parts: Callable[[], Iterator[bytes]]
    deaf: bool = False
    sock: socket.socket | None = None
    rest: bytes = b""
    saying: Iterator[bytes] = field(default_factory=lambda: iter(()))
    made: int = 0
    sent: int = 0

    def step(self) -> None:
        """Send what the other side takes; waits for nothing."""
        try:
            self._step()
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def _step(self) -> None:
        if self.sock is None:
            self.sock = socket.create_connection(("127.0.0.1", self.port), 1.0, FROM)
            if self.deaf:
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            self.sock.setblocking(False)
            self.made += 1
            self.saying, self.rest = self.parts(), b""
        if not self.rest:
            self.rest = next(self.saying, b"")
        if self.rest:
            taken = self.sock.send(self.rest)
            self.sent += taken
            self.rest = self.rest[taken:]
        else:
            self.sock.send(b"")
            if self.deaf:
                self._noticed()
        if not self.deaf and not self.sock.recv(65536):
            self.close()

    def _noticed(self) -> None:
        """Whether the other side has hung up, without reading anything."""
        assert self.sock is not None
        error = self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        state = self.sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
        if error or state != 1:  # TCP_ESTABLISHED
            self.close()

    def close(self) -> None:
        if self.sock is not None:
            self.sock.close()
        self.sock = None


def _always(data: bytes) -> Callable[[], Iterator[bytes]]:
    return lambda: repeat(data)


def _once(*data: bytes) -> Callable[[], Iterator[bytes]]:
    return lambda: iter(data)


def _subscriptions() -> Iterator[bytes]:
    yield UPGRADE
    for first in range(0, 138_000, 300):
        yield subscribe(first, 300)


def _deep() -> Iterator[bytes]:
    yield from cycle(
        (
            b"?WATCH=" + b"[" * 4000 + b";",
            b'?WATCH={"device":' + b"[" * 4000 + b"]" * 4000 + b"};",
            b'?WATCH={"device":"\\ud800"};',
            b'?WATCH={"device":' + b"[" * 12 + b"NaN" + b"]" * 12 + b"};",
        )
    )


def _deep_viewer() -> Iterator[bytes]:
    yield UPGRADE
    yield from cycle((frame(b"[" * 4000), frame(b'{"op":"\\udfff"}'), frame(b'{"op":["a"]}')))


def _frames() -> Iterator[bytes]:
    yield UPGRADE
    yield from repeat(frame(b"", 9) * 600)


def _fragments() -> Iterator[bytes]:
    """A message in pieces of a byte, without end."""
    yield UPGRADE
    yield b"\x01\x81" + bytes(4) + b"["
    yield from repeat((b"\x00\x81" + bytes(4) + b"[") * 600)


OPERATIONS = (
    {"op": "getParameters", "parameterNames": ["a"] * 100, "id": "x"},
    {"op": "setParameters", "parameters": [{"name": "a", "value": [1] * 100}]},
    {"op": "subscribeParameterUpdates", "parameterNames": ["a"] * 100},
    {"op": "advertise", "channels": [{"id": 1, "topic": "/nav", "encoding": "json"}]},
    {"op": "fetchAsset", "uri": "package://../../etc/shadow", "requestId": 1},
    {"op": "subscribeConnectionGraph"},
)


def _operations() -> Iterator[bytes]:
    """Of the protocol's that are not served, a call of a service among them; as often as may be."""
    yield UPGRADE
    calls = [frame(json.dumps(one).encode()) for one in OPERATIONS]
    yield from cycle([*calls, frame(struct.pack("<BIII", 2, 1, 1, 4) + b"jsonx", 2)])


def _head() -> Iterator[bytes]:
    """Lines as long as a parser may take them, and as many."""
    yield UPGRADE[:-2]
    yield from repeat(b"X: " + b"y" * 8000 + b"\r\n")


def _unended() -> Iterator[bytes]:
    yield b"?WATCH={"
    yield from repeat(b'"')


def _text(data: bytes) -> bytes:
    return len(data).to_bytes(2) + data


def _packet(kind: int, body: bytes) -> bytes:
    """Of MQTT 3.1.1 (section 2.2)."""
    size, rest = b"", len(body)
    while not size or rest:
        rest, low = rest >> 7, rest & 0x7F
        size += bytes([low | (0x80 if rest else 0)])
    return bytes([kind]) + size + body


def publication(topic: str, payload: bytes, retained: bool = False) -> bytes:
    """With QoS 0, which a broker hands on as fast as it comes."""
    return _packet(0x30 | retained, _text(topic.encode()) + payload)


def joined() -> bytes:
    """Connects to a broker under a name of its own."""
    return _packet(0x10, b"\x00\x04MQTT\x04\x02\x00\x00" + _text(os.urandom(8).hex().encode()))


def _commands() -> Iterator[bytes]:
    """As they should be, each with an id of its own."""
    yield joined()
    for first in count(0, 100):
        yield b"".join(
            publication("fusiond/load/cmd/request_fix", b'{"id":"%d"}' % (first + k))
            for k in range(100)
        )


def _births() -> Iterator[bytes]:
    yield joined()
    yield from repeat(publication("homeassistant/status", b"online") * 100)


LISTENED = ("homeassistant/status", *(f"fusiond/load/cmd/{name}" for name in ("inject", "x")))


def _garbage() -> Iterator[bytes]:
    """Large, and kept by the broker, on every topic that the daemon listens to."""
    yield joined()
    for number in count():
        for topic in LISTENED:
            yield publication(topic, bytes([number % 256]) * 60_000, retained=True)


SCRAPE = b"GET /metrics HTTP/1.1\r\n\r\n"


def _hasty(ports: Ports) -> list[Sender]:
    """Who comes and is gone again."""
    return [Sender(port, _once()) for port in ports[:-1]]


ATTACKS: dict[str, Callable[[Ports], list[Sender]]] = {
    "poll_1": lambda p: [Sender(p.gpsd, _always(b"?POLL;" * 10_900))],
    "poll_8_unread": lambda p: [
        Sender(p.gpsd, _always(b"?POLL;" * 10_900), deaf=True) for _ in range(8)
    ],
    "deaf_1100": lambda p: [
        Sender(port, _once(WATCH + b"?POLL;" * 30), deaf=True)
        for port in [p.gpsd] * 800 + [p.nmea] * 300
    ],
    "come_and_go": _hasty,
    "talk_256": lambda p: [Sender(p.nmea, _always(b"x" * 4096)) for _ in range(256)],
    "unended_64": lambda p: [Sender(p.gpsd, _unended) for _ in range(64)],
    "deep_8": lambda p: (
        [Sender(p.gpsd, _deep) for _ in range(4)]
        + [Sender(p.foxglove, _deep_viewer) for _ in range(4)]
    ),
    "subscribe_138000": lambda p: [Sender(p.foxglove, _subscriptions)],
    "viewers_100_deaf": lambda p: [
        Sender(p.foxglove, _once(UPGRADE, subscribe(0, 40)), deaf=True) for _ in range(100)
    ],
    "frames_8": lambda p: [Sender(p.foxglove, _frames) for _ in range(8)],
    "scrape_32": lambda p: [Sender(p.prometheus, _once(SCRAPE)) for _ in range(32)],
    "headers_300_slow": lambda p: [
        Sender(p.prometheus, lambda: repeat(b"G"), deaf=True) for _ in range(300)
    ],
    "scrape_deaf_64": lambda p: [Sender(p.prometheus, _once(SCRAPE), deaf=True) for _ in range(64)],
    "idle_1100": lambda p: [
        Sender(port, _once(), deaf=True) for port in p[:-1] for _ in range(275)
    ],
    "heads_32": lambda p: [Sender(p.foxglove, _head, deaf=True) for _ in range(32)],
    "fragments_8": lambda p: [Sender(p.foxglove, _fragments) for _ in range(8)],
    "operations_24": lambda p: [Sender(p.foxglove, _operations) for _ in range(24)],
    "devices_200": lambda p: [
        Sender(p.gpsd, lambda: cycle((b"?DEVICES;", DEVICE, b"?VERSION;", WATCH)))
        for _ in range(200)
    ],
    "commands_4": lambda p: [Sender(p.mqtt, _commands) for _ in range(4)],
    "births_4": lambda p: [Sender(p.mqtt, _births) for _ in range(4)],
    "garbage_4": lambda p: [Sender(p.mqtt, _garbage) for _ in range(4)],
}
"""By name: what the connections of an attack do, all at once."""
OVER_THE_BROKER = ("commands_4", "births_4", "garbage_4")
SLOW_S = {
    "headers_300_slow": 0.5,
    "unended_64": 0.002,
    "idle_1100": 0.1,
    "operations_24": 0.045,
    "devices_200": 0.045,
}
"""Between two rounds of those that do not send as fast as they can."""


def attack(name: str, seconds: float, ports: Ports) -> dict[str, int]:
    """Carry it out; what it came to."""
    senders = ATTACKS[name](ports)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for sender in senders:
            sender.step()
            if name == "come_and_go":
                sender.close()
        time.sleep(SLOW_S.get(name, 0.0))
    for sender in senders:
        sender.close()
    return {"connections": sum(s.made for s in senders), "bytes": sum(s.sent for s in senders)}


def main() -> None:
    name, seconds, *ports = sys.argv[1:]
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, 0, 19)
    print("attacking", flush=True)
    print(json.dumps(attack(name, float(seconds), Ports(*map(int, ports)))))


if __name__ == "__main__":
    main()
