"""A receiver over TCP, UDP and gpsd, on real sockets: what a driver makes of it and says of it."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.base import Backoff
from drivers.measurements import DeviceEvent, PositionFix
from drivers.network_port import open_port
from drivers.nmea.driver import NmeaDriver, NmeaOptions
from drivers.port import READ_BYTES
from drivers.reconnecting_line import SerialLine
from fusiond.doctor.devices import open_findings
from tests.broker import free_port
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import gga, rmc
from tests.patience import PATIENCE_S, until
from tests.pty_device import Device


class Receiver:
    """A driver on an address, and all that it handed over."""

    def __init__(self, port: str, **options: Any) -> None:
        self.emitted: list[Any] = []
        self.options = NmeaOptions(port=port, **options)
        self.driver = NmeaDriver("gnss", self.options, self.emitted.append)

    @property
    def fixes(self) -> int:
        return sum(isinstance(m, PositionFix) for m in self.emitted)

    @property
    def events(self) -> list[str]:
        return [m.code for m in self.emitted if isinstance(m, DeviceEvent)]

    @property
    def state(self) -> str:
        return self.driver.status.state

    @property
    def detail(self) -> str:
        return self.driver.status.detail


@asynccontextmanager
async def running(port: str, **options: Any) -> AsyncIterator[Receiver]:
    receiver = Receiver(port, **options)
    async with at_work(receiver.driver.run()):
        yield receiver


class SerialServer:
    """A receiver's serial server: whoever connects gets what is `sent`."""

    def __init__(self) -> None:
        self.port = free_port()
        self.address = f"tcp://localhost:{self.port}"
        self.clients: list[asyncio.StreamWriter] = []
        self.heard = bytearray()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.clients.append(writer)
        while data := await reader.read(1000):
            self.heard += data

    @asynccontextmanager
    async def up(self) -> AsyncIterator[SerialServer]:
        server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        try:
            yield self
        finally:
            server.close()
            while self.clients:
                self.clients.pop().close()
            await server.wait_closed()

    def send(self, data: bytes) -> None:
        self.clients[-1].write(data)


# ------------------------------------------------------------------ TCP


async def test_a_refused_connection_is_an_absent_device_until_the_server_is_there() -> None:
    server = SerialServer()
    async with running(server.address) as receiver:
        await until(lambda: receiver.state == "absent")
        assert receiver.detail == f"{server.address}: Connection refused; retrying"
        (advice,) = open_findings("gnss", receiver.driver, receiver.options, 5.0)
        assert "start its server" in advice
        async with server.up():
            await until(lambda: bool(server.clients))
            server.send(gga(29) + rmc(29))
            await until(lambda: receiver.fixes == 1)
            assert receiver.state == "running"
        await until(lambda: receiver.state == "absent")
        async with server.up():
            await until(lambda: bool(server.clients))
            server.send(gga(30) + rmc(30))
            await until(lambda: receiver.fixes == 2)
    assert receiver.events == ["device_absent", "device_running", "device_absent", "device_running"]


async def test_a_close_and_a_reset_end_the_line_and_say_so() -> None:
    server = SerialServer()
    reasons: list[str] = []
    line = SerialLine(server.address, 9600, backoff=Backoff(0.01, 0.02), open_port=open_port)
    async with server.up():
        task = asyncio.create_task(line.run(lambda data, t_ns: None, None, reasons.append))
        await until(lambda: len(server.clients) == 1)
        server.clients[0].close()
        await until(lambda: len(server.clients) == 2 and line.counters["opened"] == 2)
        server.clients[1].transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0"
        )
        server.clients[1].transport.abort()
        await until(lambda: len(server.clients) == 3 and line.is_open)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert reasons[0] == f"{server.address}: the other side closed the connection"
    assert reasons[1] == f"{server.address}: Connection reset by peer"
    assert line.counters["closed"] == line.counters["opened"] == 3


async def test_a_server_that_goes_silent_is_a_silent_device() -> None:
    server = SerialServer()
    async with server.up(), running(server.address, timeout_s=0.3) as receiver:
        await until(lambda: receiver.state == "silent")
        assert receiver.detail == "no bytes for 0.3 s"
        server.send(b"HTTP/1.1 400 Bad Request\r\n" * 3)
        await until(lambda: "arrive" in receiver.detail)
        assert "text arrives that is no NMEA, such as 'HTTP/1.1 400 Bad Request'" in receiver.detail
        (advice,) = open_findings("gnss", receiver.driver, receiver.options, 5.0)
        assert "baud" not in advice
        server.send(gga(29) + rmc(29))
        await until(lambda: receiver.state == "running")
    assert receiver.events == ["device_silent", "device_running"]


async def test_every_byte_value_passes_both_ways() -> None:
    server, received = SerialServer(), bytearray()
    everything = bytes(range(256)) * 8
    line = SerialLine(server.address, 9600, open_port=open_port)
    async with server.up():
        task = asyncio.create_task(line.run(lambda data, t_ns: received.extend(data)))
        await until(lambda: bool(server.clients) and line.is_open)
        line.set_baud(115200)  # the far end has the rate: nothing happens
        server.send(everything)
        assert line.write(everything)
        await until(lambda: received == server.heard == everything)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert line.counters["closed"] == 1


# ------------------------------------------------------------------ UDP


def sender(address: str = "127.0.0.1") -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.bind((address, 0))
    return out


async def test_datagrams_of_the_first_sender_alone() -> None:
    port = free_port()
    async with running(f"udp://:{port}") as receiver:
        await until(lambda: receiver.driver.counters["opened"] == 1)
        with sender() as ours, sender() as fresh, sender("127.0.0.2") as other:
            ours.sendto(gga(29) + rmc(29), ("127.0.0.1", port))
            await until(lambda: receiver.fixes == 1)
            other.sendto(gga(40) + rmc(40), ("127.0.0.1", port))
            ours.sendto(b"", ("127.0.0.1", port))
            await until(lambda: receiver.driver.counters["other_sender"] == 1)
            fresh.sendto(gga(30) + rmc(30), ("127.0.0.1", port))  # our host, another socket
            await until(lambda: receiver.fixes == 2)
        assert receiver.state == "running"
        assert receiver.driver.counters["closed"] == 0


async def test_a_datagram_is_read_whole_and_answered_to_who_sent_it() -> None:
    port, received, turns, stamps = free_port(), list[bytes](), set[int](), set[int]()
    turn = 0

    def take(data: bytes, t_ns: int) -> None:
        received.append(data)
        turns.add(turn)
        stamps.add(t_ns)

    async def others() -> None:
        nonlocal turn
        while True:
            turn += 1
            await asyncio.sleep(0)

    line = SerialLine(f"udp://127.0.0.1:{port}", 9600, open_port=open_port)
    task = asyncio.create_task(line.run(take))
    beside = asyncio.create_task(others())
    await until(lambda: line.is_open)
    assert not line.write(b"to whom?")
    with sender() as out:
        out.setblocking(False)
        datagram = os.urandom(3 * READ_BYTES + 1)
        out.sendto(datagram, ("127.0.0.1", port))
        await until(lambda: sum(map(len, received)) == len(datagram))
        assert b"".join(received) == datagram
        assert max(map(len, received)) == READ_BYTES
        assert len(turns) == len(received) == 4  # others had a turn between any two pieces
        assert len(stamps) == 1
        beside.cancel()
        assert line.write(b"corrections")
        assert await asyncio.get_running_loop().sock_recv(out, 100) == b"corrections"
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert line.counters["write_refused"] == 1


async def test_a_port_that_is_taken_is_waited_for() -> None:
    with sender() as taken:
        address = f"udp://127.0.0.1:{taken.getsockname()[1]}"
        async with running(address) as receiver:
            await until(lambda: receiver.state == "absent")
            assert receiver.detail == f"{address}: Address already in use; retrying"
            taken.close()
            await until(lambda: receiver.driver.counters["opened"] == 1)


# ------------------------------------------------------------------ gpsd


async def test_the_bytes_of_a_real_gpsd(tmp_path: Path) -> None:
    binary = shutil.which("gpsd", path=f"{os.environ['PATH']}:/usr/sbin")
    assert binary is not None, "gpsd is missing: apt-get install gpsd"
    device, port = Device(tmp_path / "gnss"), free_port()
    device.plug()
    terminal = str(device.link.resolve())
    process = await asyncio.create_subprocess_exec(
        binary, "-N", "-n", "-b", "-S", str(port), terminal, stderr=asyncio.subprocess.DEVNULL
    )
    second = 0
    try:
        async with running(f"gpsd://127.0.0.1:{port}{terminal}") as receiver:
            async with asyncio.timeout(PATIENCE_S):
                while receiver.fixes < 3:
                    second += 1
                    device.send(gga(second % 60) + rmc(second % 60))
                    await asyncio.sleep(0.02)  # a receiver's pace: gpsd drops what came before
            assert receiver.state == "running"
            assert not receiver.driver._line.write(b"?POLL;\n")  # it would be a command
            process.terminate()
            await until(lambda: receiver.state == "absent")
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()
        device.unplug()
    assert receiver.driver.counters["checksum_bad"] == 0


# ------------------------------------------------------------------ addresses


@pytest.mark.parametrize(
    ("port", "why"),
    [
        ("http://receiver:80", "no such kind of address"),
        ("tcp://receiver", "needs its port"),
        ("tcp://:5000", "needs its host"),
        ("tcp://receiver:99999", "out of range"),
        ("tcp://receiver:5000/dev/ttyS0", "nothing may follow"),
        ("udp://", "needs its port"),
    ],
)
def test_an_address_that_cannot_be_is_refused(port: str, why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        NmeaOptions(port=port)


def test_a_name_that_nobody_knows_is_said() -> None:
    with pytest.raises(OSError, match=r"tcp://receiver\.invalid:5000: .*[Nn]ame"):
        open_port("tcp://receiver.invalid:5000", 9600, Counter())
