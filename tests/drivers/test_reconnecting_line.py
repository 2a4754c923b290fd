"""SerialLine on real pseudo terminals: open, read, write, hang-up, replug, flood."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from drivers.base import Backoff
from drivers.port import BURST, LINE_BYTES_S
from drivers.reconnecting_line import PENDING_WRITE_BYTES, READ_BYTES, SerialLine
from tests.drivers.at_work import at_work
from tests.patience import until
from tests.pty_device import Device

FLOOD = 200_000


class Host:
    def __init__(self, line: SerialLine) -> None:
        self.line = line
        self.received = bytearray()
        self.reads: list[tuple[int, int]] = []
        self.opened = 0
        self.reasons: list[str] = []

    def on_bytes(self, data: bytes, t_seen_ns: int) -> None:
        self.received += data
        self.reads.append((len(data), t_seen_ns))

    def on_open(self) -> None:
        self.opened += 1


@asynccontextmanager
async def running(host: Host) -> AsyncIterator[Host]:
    async with at_work(host.line.run(host.on_bytes, host.on_open, host.reasons.append)):
        yield host


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "port")
    yield device
    device.unplug()


@pytest.fixture
def host(device: Device) -> Host:
    return Host(SerialLine(str(device.link), 115200, backoff=Backoff(0.01, 0.02)))


async def test_every_byte_value_passes_both_ways(device: Device, host: Host) -> None:
    device.plug()
    everything = bytes(range(256))
    async with running(host):
        await until(lambda: host.opened == 1)
        device.send(everything)
        await until(lambda: len(host.received) >= 256)
        assert host.line.write(everything)
        await until(lambda: host.line.counters["bytes_out"] == 256)
        assert os.read(device.master, 1000) == everything
    assert host.received == everything
    assert host.line.counters["bytes_in"] == 256
    assert not host.line.is_open
    assert host.reasons == ["closed by this side"]


async def test_absent_port_is_waited_for(device: Device, host: Host) -> None:
    async with running(host):
        await until(lambda: host.line.counters["open_failed"] >= 3)
        assert not host.line.is_open
        assert "does not exist; retrying" in host.line.detail
        assert not host.line.write(b"x")
        assert host.line.counters["write_refused"] == 1
        device.plug()
        await until(lambda: host.line.is_open)
        device.send(b"hello")
        await until(lambda: host.received == b"hello")
        assert host.line.detail == ""


async def test_hang_up_is_seen_and_the_port_reopened(device: Device, host: Host) -> None:
    device.plug()
    async with running(host):
        for turn in range(3):
            await until(lambda turn=turn: host.opened == turn + 1 and host.line.is_open)
            device.send(b"%d" % turn)
            await until(lambda turn=turn: len(host.received) == turn + 1)
            device.unplug()
            await until(lambda turn=turn: len(host.reasons) == turn + 1)
            assert not host.line.is_open
            device.plug()
    assert host.received == b"012"
    assert all("end of file" in why or "error" in why for why in host.reasons[:3])


async def test_link_moved_to_another_terminal(device: Device, host: Host) -> None:
    device.plug()
    async with running(host):
        await until(lambda: host.line.is_open)
        first = device.master
        device.plug()  # the old terminal stays alive: its descriptor cannot tell
        try:
            await until(lambda: host.opened == 2)
            device.send(b"second")
            await until(lambda: host.received == b"second")
        finally:
            os.close(first)
    assert "no longer names" in host.reasons[0]


async def test_a_second_daemon_cannot_take_the_port(device: Device, host: Host) -> None:
    device.plug()
    rival = SerialLine(str(device.link), 115200, backoff=Backoff(0.01, 0.02))
    async with running(host):
        await until(lambda: host.line.is_open)
        async with running(Host(rival)):
            await until(lambda: rival.counters["open_failed"] >= 1)
            assert "in use by another program (locked)" in rival.detail


async def test_path_that_is_no_terminal(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"$GPGGA")
    line = SerialLine(str(path), 115200, backoff=Backoff(0.01, 0.02))
    async with running(Host(line)):
        await until(lambda: line.counters["open_failed"] >= 2)
        assert "configure port" in line.detail


async def test_congested_line_refuses_and_never_blocks(device: Device, host: Host) -> None:
    device.plug()  # nobody reads the master: the pty's buffer fills
    async with running(host):
        await until(lambda: host.line.is_open)
        accepted = 0
        while host.line.write(b"U" * 1000):
            accepted += 1000
            assert accepted < 10_000_000
        assert host.line.counters["write_refused"] == 1
        assert accepted - host.line.counters["bytes_out"] <= PENDING_WRITE_BYTES
        drained = bytearray()

        def drain() -> bool:
            with suppress(BlockingIOError):
                drained.extend(os.read(device.master, 65536))
            return len(drained) == accepted

        await until(drain)  # what was accepted arrives, whole
        assert set(drained) == {ord("U")}
        assert host.line.write(b"again")


async def test_flood_leaves_the_loop_its_turns(device: Device, host: Host) -> None:
    device.plug()
    os.set_blocking(device.master, True)
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            try:
                os.write(device.master, b"\xff" * 65536)
            except OSError:
                return

    thread = threading.Thread(target=flood, daemon=True)
    async with running(host):
        await until(lambda: host.line.is_open)
        began_s = asyncio.get_running_loop().time()
        thread.start()
        turns = 0
        while host.line.counters["bytes_in"] < FLOOD:
            await asyncio.sleep(0)
            turns += 1
        read = host.line.counters["bytes_in"]
        took_s = asyncio.get_running_loop().time() - began_s
        stop.set()
        await until(lambda: not thread.is_alive())
    assert max(size for size, _ in host.reads) <= READ_BYTES
    assert turns >= FLOOD // READ_BYTES  # other work had a turn between any two reads
    assert host.line.counters["paused"] > 0
    assert read <= BURST + LINE_BYTES_S * took_s + 2 * READ_BYTES


async def test_stamps_come_from_the_given_clock(device: Device, tmp_path: Path) -> None:
    ticks = iter(range(1000, 2000))
    host = Host(SerialLine(str(device.link), 9600, lambda: next(ticks), Backoff(0.01, 0.02)))
    device.plug()
    async with running(host):
        await until(lambda: host.line.is_open)
        device.send(b"a")
        await until(lambda: host.received == b"a")
        device.send(b"b")
        await until(lambda: host.received == b"ab")
    assert host.reads == [(1, 1000), (1, 1001)]


async def test_baud_rate_changes_in_place(device: Device, host: Host) -> None:
    device.plug()
    async with running(host):
        await until(lambda: host.line.is_open)
        host.line.set_baud(19200)
        device.send(b"still there")
        await until(lambda: host.received == b"still there")
        assert host.opened == 1
        host.line.set_baud(-5)
        await until(lambda: len(host.reasons) == 1)
        assert host.line.counters["baud_refused"] == 1
        host.line.set_baud(9600)
        await until(lambda: host.opened == 2)


async def test_a_failing_reader_is_not_hidden(device: Device) -> None:
    device.plug()
    line = SerialLine(str(device.link), 115200, backoff=Backoff(0.01, 0.02))

    def broken(data: bytes, t_seen_ns: int) -> None:
        raise ZeroDivisionError

    task = asyncio.create_task(line.run(broken))
    await until(lambda: line.is_open)
    device.send(b"x")
    with pytest.raises(ZeroDivisionError):
        await task
    assert not line.is_open
