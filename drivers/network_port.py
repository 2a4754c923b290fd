"""Receiver behind a network, read like a serial line; see `docs/network.md`.

    tcp://HOST:PORT            a serial server, or a receiver's own socket: this side connects
    udp://:PORT                datagrams to this port; udp://ADDRESS:PORT of one interface alone
    gpsd://HOST:PORT[/DEVICE]  the bytes of a gpsd's device, as they come (its WATCH with raw = 2)

A TCP connection ends when the other side closes or resets it, or no longer replies to the kernel's
probes, as after a pulled cable. UDP has no end; it falls silent.
"""

from __future__ import annotations

import json
import socket
from collections import Counter
from time import monotonic
from typing import Annotated, Any
from urllib.parse import SplitResult, urlsplit

from pydantic import AfterValidator

from drivers.port import READ_BYTES, Port, SerialPort

CONNECT_S = 5.0
"""Timeout of name resolution and connection: a few round trips of a mobile network; the first
packet is repeated after 1 s and 3 s (RFC 6298, section 2)."""
KEEPALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
"""Keepalive options: a lost host is noticed after 5 + 3 * 2 = 11 s without a byte.

A receiver that works leaves no such pause; three probes, since mobile links lose one now and
then."""
UNANSWERED_MS = 11_000
"""Timeout for unacknowledged sent bytes (RFC 5482)."""
SENDER_HELD_S = 5.0
"""Time of silence after which a port accepts another sender; sentences of two receivers must not
mix. Five epochs at 1 Hz, the drivers' timeout."""
DATAGRAM_BYTES = 65_535

_DEFAULT_PORTS = {"tcp": None, "udp": None, "gpsd": 2947}
_EXAMPLES = "tcp://HOST:PORT, udp://:PORT or gpsd://HOST:2947"


def on_network(port: str) -> bool:
    """True if a `port` is an address and not a serial device."""
    return "://" in port


def _split(port: str) -> tuple[SplitResult, int]:
    """Address and port number; ValueError with `_EXAMPLES` otherwise."""
    parts = urlsplit(port)
    if parts.scheme not in _DEFAULT_PORTS:
        raise ValueError(f"no such kind of address: {_EXAMPLES}")
    try:
        number = parts.port or _DEFAULT_PORTS[parts.scheme]
    except ValueError as error:
        raise ValueError(f"{error}: {_EXAMPLES}") from None
    if number is None:
        raise ValueError(f"an address needs its port: {_EXAMPLES}")
    if parts.scheme != "udp" and not parts.hostname:
        raise ValueError(f"an address needs its host: {_EXAMPLES}")
    if parts.query or parts.fragment or (parts.path.strip("/") and parts.scheme != "gpsd"):
        raise ValueError(f"nothing may follow the port: {_EXAMPLES}")
    return parts, number


def _checked(port: str) -> str:
    if on_network(port):
        _split(port)
    return port


PortName = Annotated[str, AfterValidator(_checked)]
"""A serial device's path or an address."""


def open_port(name: str, baud: int, counters: Counter[str]) -> Port:
    """Open a serial device, or reach an address. Raises `OPEN_ERRORS`.

    `counters`: `other_sender`, datagrams of a second sender.
    """
    if not on_network(name):
        return SerialPort(name, baud)
    parts, number = _split(name)
    try:
        if parts.scheme == "udp":
            return UdpPort(parts.hostname, number, counters)
        connection = connect(str(parts.hostname), number)
        if parts.scheme == "tcp":
            return TcpPort(connection)
        return GpsdPort(connection, parts.path.rstrip("/"))
    except OSError as error:
        raise OSError(f"{name}: {error.strerror or error}") from error


def connect(host: str, number: int) -> socket.socket:
    """Open a TCP connection with keepalive. Blocks; OSError."""
    connection = socket.create_connection((host, number), CONNECT_S)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEPALIVE.items():
        connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNANSWERED_MS)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


class _SocketPort:
    """Common part of TCP and UDP ports, which have no baud rate."""

    def __init__(self, opened: socket.socket) -> None:
        opened.setblocking(False)
        self._socket = opened

    def fileno(self) -> int:
        return self._socket.fileno()

    def changed(self) -> str:
        return ""

    def set_baud(self, baud: int) -> None:
        """The far end has the rate."""

    def close(self) -> None:
        self._socket.close()


class TcpPort(_SocketPort):
    """A stream over TCP, both ways."""

    at_end = "the other side closed the connection"
    writable = True

    def read(self) -> bytes:
        return self._socket.recv(READ_BYTES)

    def write(self, data: bytes | bytearray) -> int:
        return self._socket.send(data)


class GpsdPort(TcpPort):
    """Bytes of a device read by gpsd. Read-only: gpsd would take written bytes for commands."""

    at_end = "gpsd closed the connection"
    writable = False

    def __init__(self, connection: socket.socket, device: str) -> None:
        watch = {"enable": True, "raw": 2} | ({"device": device} if device else {})
        connection.sendall(f"?WATCH={json.dumps(watch, separators=(',', ':'))};\n".encode())
        super().__init__(connection)


class UdpPort(_SocketPort):
    """Datagrams of one sender; what is written goes back to it."""

    at_end = ""
    """False: a network port has no end."""

    def __init__(self, address: str | None, number: int, counters: Counter[str]) -> None:
        found = socket.getaddrinfo(address, number, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, where = found[0]
        opened = socket.socket(family, kind, protocol)
        try:
            opened.bind(where)
        except OSError:
            opened.close()
            raise
        super().__init__(opened)
        self._counters = counters
        self._sender: tuple[Any, ...] | None = None
        self._received_s = 0.0

    @property
    def writable(self) -> bool:
        return self._sender is not None

    def read(self) -> bytes:
        data, sender = self._socket.recvfrom(DATAGRAM_BYTES)
        now_s = monotonic()
        # By host alone: some devices send each datagram from another port.
        foreign = self._sender is not None and self._sender[0] != sender[0]
        if foreign and now_s - self._received_s < SENDER_HELD_S:
            self._counters["other_sender"] += 1
            raise BlockingIOError
        self._sender, self._received_s = sender, now_s
        if not data:
            raise BlockingIOError  # an empty datagram does not end the stream
        return data

    def write(self, data: bytes | bytearray) -> int:
        if self._sender is None:
            raise BlockingIOError
        return self._socket.sendto(data, self._sender)
