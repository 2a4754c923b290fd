"""The real driver on real python-can buses, and the examples of the manual."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import re
import socket
import struct
import subprocess
import threading
import time
import tomllib
from collections.abc import Callable, Iterator

import can
import pytest

from drivers.can import bus as can_bus
from drivers.can.bus import CanBus, CanFrame
from drivers.can.imu import CanImuDriver, CanImuOptions
from drivers.can.socket_frames import Content
from drivers.measurements import DeviceEvent, DeviceStamp, KernelStamp, Measurement
from fusiond.simulation.can.imu import SIM_IMU, CanImu
from tests.drivers.can.imu_at_work import SBG, SECOND, Running, sample_frames
from tests.patience import PATIENCE_S, until
from tests.places import REPOSITORY

GROUP = f"239.74.{os.getpid() >> 8 & 0xFF}.{os.getpid() & 0xFF}"
"""A multicast group of this process: tests run side by side."""


@pytest.fixture(scope="module", autouse=True)
def multicast_route() -> Iterator[None]:
    """A host without any network has no route for multicast: give the group one over loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            join = socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0")
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, join)
            probe.sendto(b"", (GROUP, 9))
            added = False
        except OSError:
            subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
            subprocess.run(["ip", "route", "add", GROUP, "dev", "lo"], check=True)
            added = True
    yield
    if added:
        subprocess.run(["ip", "route", "del", GROUP, "dev", "lo"], check=True)


@pytest.mark.parametrize(
    ("interface", "channel"),
    [("virtual", "t-e2e"), ("udp_multicast", GROUP)],
    ids=["virtual", "udp_multicast"],  # the group is each process's own, the test's name is not
)
async def test_samples_silence_and_recovery(interface: str, channel: str) -> None:
    """An IMU that counts its samples: when frames arrive, on a busy host, pairs nothing wrongly."""
    counted = {**SIM_IMU.model_dump(), "interface": interface, "channel": channel, "timeout_s": 0.2}
    encoder = CanImu()

    def send(bus: can.BusABC, k: int) -> None:
        for message in encoder.frames(k, 5_000_000 * k, (0.001 * k, 0.02, 0.35), (0.0, 0.0, -9.8)):
            bus.send(message)

    async with Running(**counted).run() as imu:
        with can.Bus(interface=interface, channel=channel, ignore_config=True) as sender:
            for k in range(20):
                send(sender, k)
                imu.now_ns += 5_000_000
            await until(lambda: len(imu.samples) == 20)
            assert imu.driver.status.state == "running"
            assert [s.stamp for s in imu.samples] == [
                DeviceStamp("imu", 5_000_000 * k) for k in range(20)
            ]
            assert imu.samples[7].gyro_rad_s == pytest.approx((0.007, 0.02, 0.35))
            imu.now_ns += SECOND
            await until(lambda: imu.driver.status.state == "silent")
            await until(lambda: "SIM_GYRO" in imu.driver.status.detail)
            send(sender, 100)
            await until(lambda: imu.driver.status.state == "running")
    assert imu.codes == []


async def test_a_polled_bus_is_read_when_its_owner_asks() -> None:
    """Each frame has the instant of its arrival, not that of the poll."""
    imu = Running(**{**SIM_IMU.model_dump(), "interface": "udp_multicast", "channel": GROUP})
    imu.follow_the_host()
    poll = imu.driver.poll_from_now_on()
    encoder = CanImu()
    async with imu.run():
        with can.Bus(interface="udp_multicast", channel=GROUP, ignore_config=True) as sender:
            sent_ns = []
            for k in range(3):
                sent_ns.append(time.monotonic_ns())
                for message in encoder.frames(k, 5_000_000 * k, (0.0, 0.0, 0.3), (0.0, 0.0, -9.8)):
                    sender.send(message)
                await asyncio.sleep(0.02)
            assert imu.samples == []
            polled_ns = time.monotonic_ns()
            poll()
            assert len(imu.samples) == 3
            ends_ns = [*sent_ns[1:], polled_ns]
            for sample, after_ns, before_ns in zip(imu.samples, sent_ns, ends_ns, strict=True):
                # CLOCK_REALTIME and CLOCK_MONOTONIC are read one after the other.
                assert after_ns - 1_000_000 < sample.t_seen_ns < before_ns
            poll()
            assert len(imu.samples) == 3


async def test_a_polled_bus_that_breaks_down_is_left_and_opened_again() -> None:
    imu = Running(**{**SIM_IMU.model_dump(), "interface": "udp_multicast", "channel": GROUP})
    poll = imu.driver.poll_from_now_on()
    async with imu.run():
        bus = imu.driver._bus._bus
        assert bus is not None
        reader, writer = os.pipe()
        os.dup2(reader, bus.fileno())
        os.close(reader)
        os.close(writer)  # it can be read now, but is no socket
        poll()
        await until(lambda: imu.driver.counters["bus_opened"] == 2)
        assert "interface_up" in imu.codes


async def test_bus_stamps_are_reported() -> None:
    imu = Running(interface="virtual", channel="t-stamp", timestamp="kernel", latency_s=0.003)
    async with imu.run():
        with can.Bus(interface="virtual", channel="t-stamp", ignore_config=True) as sender:
            for message in sample_frames(1):
                sender.send(message)
            await until(lambda: bool(imu.samples))
    (sample,) = imu.samples
    assert isinstance(sample.stamp, KernelStamp)
    assert sample.stamp.latency_s == 0.003


async def test_garbage_on_the_wire_is_counted() -> None:
    async with Running(interface="udp_multicast", channel=GROUP).run() as imu:
        with (
            can.Bus(interface="udp_multicast", channel=GROUP, ignore_config=True) as sender,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rough,
        ):
            for junk in (b"", b"\xff" * 40, b"\x81", b"not a frame"):
                rough.sendto(junk, (GROUP, 43113))
            for message in sample_frames(1):
                sender.send(message)
            await until(lambda: len(imu.samples) == 1)
    assert imu.driver.counters["bad_datagrams"] == 4


async def test_absent_interface_is_reported_once_and_tried_again() -> None:
    async with Running(interface="socketcan", channel="fusiond-none").run() as imu:
        await until(lambda: imu.driver.counters["bus_open_failed"] >= 2)
        assert imu.driver.status.state == "absent"
        assert "fusiond-none" in imu.driver.status.detail
    assert imu.codes == ["interface_down"]


async def test_a_bus_that_dies_is_closed_and_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault of the bus itself, as a vanished interface raises it, on a descriptor that stays
    readable: the reader must be taken off the loop, not called for ever."""
    dead = threading.Event()
    calls = 0
    whole = can_bus.CanBus.read_socket

    def failing(
        self: CanBus, sock: socket.socket, size: int, decode: Callable[[bytes], Content]
    ) -> CanFrame | None:
        nonlocal calls
        if dead.is_set():
            calls += 1
            raise can_bus._BusFaultError(self._explain(OSError(errno.ENETDOWN, "down")))
        return whole(self, sock, size, decode)

    monkeypatch.setattr(can_bus.CanBus, "read_socket", failing)
    async with Running(interface="udp_multicast", channel=GROUP).run() as imu:
        with can.Bus(interface="udp_multicast", channel=GROUP, ignore_config=True) as sender:
            for message in sample_frames(1):
                sender.send(message)
            await until(lambda: len(imu.samples) == 1)
            dead.set()
            sender.send(sample_frames(2)[0])
            await until(lambda: "interface_down" in imu.codes)
            assert calls == 1
            dead.clear()
            await until(lambda: "interface_up" in imu.codes)
            for message in sample_frames(3):
                sender.send(message)
            await until(lambda: len(imu.samples) == 2)
    assert imu.codes == ["interface_down", "interface_up"]


async def test_frames_of_the_kernel_layout_are_read_in_bounded_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """struct can_frame and canfd_frame off a descriptor, more of them than one turn takes."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)

    class OneSocket(can.BusABC):
        def __init__(self) -> None:
            super().__init__(channel="pair")
            self.socket = near

        def fileno(self) -> int:
            return near.fileno()

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise NotImplementedError

    monkeypatch.setattr(can_bus.CanBus, "_open", lambda self: OneSocket())
    frames: list[CanFrame] = []
    links: list[bool] = []
    bus = CanBus("socketcan", "pair")
    task = asyncio.create_task(
        bus.run(frames.append, lambda up, why: links.append(up), lambda state: None)
    )
    far.send(struct.pack("=IB3x8s", 0x80000000 | 0x18F02A80, 3, b"abcdefgh"))
    far.send(struct.pack("=IBB2x64s", 0x7FF, 64, 0x04, bytes(range(64))))
    far.send(struct.pack("=IB3x8s", 0x40000123, 8, bytes(8)))
    far.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
    for i in range(2 * can_bus.FRAMES_PER_WAKEUP):
        far.send(struct.pack("=IB3x8s", i, 0, bytes(8)))
        if i % 50 == 49:
            await asyncio.sleep(0)
    await until(lambda: len(frames) == 2 + 2 * can_bus.FRAMES_PER_WAKEUP)
    assert frames[0][:3] == (0x18F02A80, True, b"abc")
    assert frames[1][:3] == (0x7FF, False, bytes(range(64)))
    assert bus.counters["remote_frames"] == 1
    assert bus.counters["error_bus_off"] == 1
    assert links == [True]
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    near.close()
    far.close()


async def test_a_slow_loop_costs_frames_that_are_counted() -> None:
    frames: list[CanFrame] = []
    bus = CanBus("virtual", "t-ring")
    opened = asyncio.Event()
    task = asyncio.create_task(
        bus.run(frames.append, lambda up, why: opened.set(), lambda state: None)
    )
    await opened.wait()
    sent = can_bus.RING_FRAMES + 500
    with can.Bus(interface="virtual", channel="t-ring", ignore_config=True) as sender:
        for i in range(sent):
            sender.send(can.Message(arbitration_id=i % 2048, is_extended_id=False))
        end_s = time.monotonic() + PATIENCE_S
        while bus.counters["ring_overflow"] < 500 and time.monotonic() < end_s:
            time.sleep(0.001)  # noqa: ASYNC251 (the loop stands still here, on purpose)
        await until(lambda: len(frames) == can_bus.RING_FRAMES)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert bus.counters["ring_overflow"] == 500
    assert [f.can_id for f in frames] == [i % 2048 for i in range(500, sent)]


async def test_a_defect_of_the_consumer_leaves_the_driver() -> None:
    """The supervisor must see it; it must not vanish in a callback of the loop."""
    options = CanImuOptions.model_validate({**SBG, "interface": "virtual", "channel": "t-defect"})

    def broken(item: Measurement | DeviceEvent) -> None:
        raise ZeroDivisionError

    driver = CanImuDriver("imu", options, broken)
    task = asyncio.create_task(driver.run())
    await until(lambda: driver.status.state == "silent")
    with can.Bus(interface="virtual", channel="t-defect", ignore_config=True) as sender:
        for message in sample_frames(1):
            sender.send(message)
        with pytest.raises(ZeroDivisionError):
            await asyncio.wait_for(task, PATIENCE_S)


PAGE = REPOSITORY / "docs" / "can-imu.md"
BLOCKS = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def test_every_example_of_the_manual_builds_a_driver() -> None:
    built = set()
    for block in BLOCKS:
        for name, source in tomllib.loads(block)["sources"].items():
            assert source.pop("driver") == "can_imu"
            driver = CanImuDriver(name, CanImuOptions.model_validate(source), lambda item: None)
            built.add(driver.options.dbc)
    shipped = {"sbg_ellipse", "xsens_mti600", "bosch_mm5_10", "bosch_mm7_10"}
    assert shipped | {"racelogic_imu04", "aceinna_openimu300ri"} <= built
