"""Faults of wires, clocks and the host, each as what it does to a `Rig`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import resource
import signal
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import aiomqtt
import can

from fusiond.simulation.can.imu import CanImu
from tests.live.rig import Rig
from tests.live.told import ToldDaemon

ALL = ("aligning", "navigating", "coasting")
MOVING = ("navigating", "coasting")
YEAR_2100_NS = 74 * 31_556_952 * 1_000_000_000
Action = Callable[[Rig], Awaitable[None]]


@dataclass(frozen=True)
class Fault:
    """`begin` and `end` are done to the rig. `of_fixes`: of what the outage of `coasting` takes
    away. `needs`: `vcan`, `guest` (a machine of its own), or nothing. `first_byte`: there from the
    first byte on. `settings` are added to the configuration."""

    begin: Action
    end: Action
    length_s: float = 10.0
    phases: tuple[str, ...] = ALL
    of_fixes: bool = False
    first_byte: bool = False
    needs: str = ""
    settings: str = ""


async def _nothing(_: Rig) -> None:
    pass


async def _command(*words: str) -> None:
    process = await asyncio.create_subprocess_exec(*words)
    assert await process.wait() == 0, words


# --------------------------------------------------------------------------- serial lines


def plugged(device: Any, on: bool) -> Action:
    async def do(r: Rig) -> None:
        r.vehicle.plug(device) if on else r.vehicle.unplug(device)

    return do


def _gnss(alter: Callable[[bytes], bytes]) -> Action:
    async def do(r: Rig) -> None:
        r.gnss.alter = alter

    return do


def _late(seconds: float) -> Action:
    async def do(r: Rig) -> None:
        r.gnss.late_s = seconds

    return do


def _same(data: bytes) -> bytes:
    return data


DICE = random.Random(5)


def _noise(data: bytes) -> bytes:
    return DICE.randbytes(len(data))


def _torn(data: bytes) -> bytes:
    """Every fifth burst of the line is lost in the middle."""
    return data[:40] + data[60:] if DICE.random() < 0.2 else data


def _flipped(data: bytes) -> bytes:
    """A bit in a thousand is wrong."""
    flipped = bytearray(data)
    for k in range(len(flipped)):
        if DICE.random() < 8e-3:
            flipped[k] ^= 1 << DICE.randrange(8)
    return bytes(flipped)


async def _steal(r: Rig) -> None:
    """Another process reads the line, too."""
    descriptor = os.open(r.gnss.link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    end_s = time.monotonic() + 9.0
    try:
        while time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):
                os.read(descriptor, 200)
            await asyncio.sleep(0.005)
    finally:
        os.close(descriptor)


# --------------------------------------------------------------------------- CAN


def _link(state: str) -> Action:
    async def do(_: Rig) -> None:
        await _command("ip", "link", "set", "vcan0", state)

    return do


def _frames(make: Callable[[], list[can.Message]], every_s: float, seconds: float) -> Action:
    """Another node of the bus sends these, again and again."""

    async def do(r: Rig) -> None:
        with can.Bus(**r.can_bus, ignore_config=True) as bus:
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                for frame in make():
                    bus.send(frame)
                await asyncio.sleep(every_s)

    return do


def _error_frames() -> list[can.Message]:
    """Bus-off, restart, and errors on the way there (linux/can/error.h)."""
    classes = (0x004, 0x008 | 0x020 | 0x080, 0x040, 0x100)
    data = bytes([0, 0x20, 0, 0, 0, 0, 0, 0])
    return [can.Message(arbitration_id=c, is_error_frame=True, data=data, dlc=8) for c in classes]


def _foreign_frames() -> list[can.Message]:
    """Ten times the bus's usual load of identifiers that are nobody's, and frames cut short."""
    foreign = [can.Message(arbitration_id=0x500 + k, data=bytes(8)) for k in range(30)]
    ids = {frame.arbitration_id for frame in _shape()}
    short = [can.Message(arbitration_id=i, data=b"\1", is_extended_id=False) for i in ids]
    return [*foreign, *short]


def _shape() -> list[can.Message]:
    return CanImu().frames(0, 0, [0.0] * 3, [0.0] * 3)


async def _counter_jumps(r: Rig) -> None:
    """The IMU's counter skips seven, every half second."""
    first: list[int] = []

    def number(n: int) -> int:
        first.append(n) if not first else None
        return n + 7 * (1 + (n - first[0]) // 50)

    r.imu.number = number


async def _frames_lost(r: Rig) -> None:
    """One sample in ten never reaches the bus."""
    r.imu.number = lambda n: None if DICE.random() < 0.1 else n


def _stamps(offset_s: float, every: int) -> Action:
    """One sample of `every` has a device time that is off; the first of them, if that is 0."""

    async def do(r: Rig) -> None:
        count = 0

        def altered(t_ns: int) -> int:
            nonlocal count
            count += 1
            hit = count == 1 if every == 0 else count % every == 1
            return t_ns + round(offset_s * 1e9) if hit else t_ns

        r.imu.time = altered

    return do


def _device_set(offset_s: float) -> Action:
    async def do(r: Rig) -> None:
        r.imu.time = lambda t_ns: t_ns + round(offset_s * 1e9)

    return do


async def _imu_well(r: Rig) -> None:
    r.imu.number, r.imu.time = (lambda n: n), (lambda t_ns: t_ns)


# --------------------------------------------------------------------------- broker and operator


async def _broker_killed(r: Rig) -> None:
    r.broker.kill()


async def _broker_back(r: Rig) -> None:
    r.broker.start()


async def _broker_frozen(r: Rig) -> None:
    r.broker.freeze()


async def _broker_thawed(r: Rig) -> None:
    r.broker.thaw()


async def _commands(r: Rig) -> None:
    """A thousand commands a second, all of them for a position at the other end of the world."""
    command = {"lat_deg": -30.0, "lon_deg": -60.0, "height_m": 0.0, "sd_m": 1.0}
    end_s = time.monotonic() + 9.0
    async with aiomqtt.Client("127.0.0.1", r.broker.port) as client:
        while time.monotonic() < end_s:
            for k in range(50):
                text = json.dumps({"id": f"{k}", **command})
                await client.publish("fusiond/rig/cmd/set_position", text, qos=0)
            await asyncio.sleep(0.05)


async def _rival(r: Rig) -> None:
    """A second daemon of the same name at the same broker, without the devices."""
    config = r.folder / "rival.toml"
    text = (r.folder / "rig.toml").read_text().replace(f"{r.folder}/", f"{r.folder}/no-")
    bus = r.can_bus["channel"]
    config.write_text(text.replace(f'"{bus}"', '"239.74.1.1"' if "." in bus else '"vcan9"'))
    second = ToldDaemon(config, 50, {"RUNTIME_DIRECTORY": str(r.folder / "no-such")})
    try:
        await second.load()
        await second.begin()
        async with asyncio.timeout(20.0):
            while True:
                await second.said()
    except TimeoutError:
        pass
    finally:
        await second.kill()


# --------------------------------------------------------------------------- the host


async def _stopped(r: Rig) -> None:
    os.kill(r.daemon.pid, signal.SIGSTOP)


async def _continued(r: Rig) -> None:
    os.kill(r.daemon.pid, signal.SIGCONT)


async def _starved(r: Rig) -> None:
    """It gets the processor for 0.2 s of each 0.5 s."""
    for _ in range(20):
        os.kill(r.daemon.pid, signal.SIGSTOP)
        await asyncio.sleep(0.3)
        os.kill(r.daemon.pid, signal.SIGCONT)
        await asyncio.sleep(0.2)


async def _no_descriptors(r: Rig) -> None:
    """It may open nothing more, and the receiver is plugged in again."""
    used = len(os.listdir(f"/proc/{r.daemon.pid}/fd"))
    _, most = resource.prlimit(r.daemon.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(r.daemon.pid, resource.RLIMIT_NOFILE, (used - 2, most))
    r.vehicle.unplug("gnss")
    r.vehicle.plug("gnss")


async def _descriptors(r: Rig) -> None:
    _, most = resource.prlimit(r.daemon.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(r.daemon.pid, resource.RLIMIT_NOFILE, (most, most))


def _receivers_clock(offset_ns: int) -> Action:
    """UTC as the receiver tells it."""

    async def do(r: Rig) -> None:
        r.vehicle.utc_start_ns += offset_ns

    return do


def _system_clock(offset_s: float) -> Action:
    async def do(_: Rig) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + offset_s)

    return do


def _statm(hidden: bool) -> Action:
    async def do(r: Rig) -> None:
        path = f"/proc/{r.daemon.pid}/statm"
        await _command(*(("mount", "--bind", "/dev/null") if hidden else ("umount", "-l")), path)

    return do


def _bytes(alter: Callable[[bytes], bytes], phases: tuple[str, ...] = ALL) -> Fault:
    return Fault(_gnss(alter), _gnss(_same), phases=phases, of_fixes=True)


def _stamp(offset_s: float, every: int) -> Fault:
    return Fault(_stamps(offset_s, every), _imu_well)


FAULTS: dict[str, Fault] = {
    "nothing": Fault(_nothing, _nothing),
    # serial lines
    "rdss_unplugged": Fault(plugged("rdss", False), plugged("rdss", True), phases=("navigating",)),
    "gnss_unplugged": Fault(plugged("gnss", False), plugged("gnss", True), phases=ALL[:2]),
    "gnss_garbage": _bytes(lambda data: data + DICE.randbytes(300)),
    "gnss_garbage_only": _bytes(lambda data: DICE.randbytes(5000)),
    "gnss_wrong_baud": _bytes(_noise),
    "gnss_bits_flipped": _bytes(_flipped),
    "gnss_half_frames": _bytes(lambda data: data[: len(data) // 2]),
    "gnss_torn": _bytes(_torn),
    "gnss_glued": _bytes(lambda data: data + data),
    "gnss_half_open": _bytes(lambda data: b"", phases=ALL[:2]),
    "gnss_no_line_end": _bytes(lambda data: b"$GNGGA," + b"7" * 2000),
    "gnss_bytes_stolen": Fault(_steal, _nothing, phases=("navigating",), of_fixes=True),
    "gnss_late_0.8s": Fault(_late(0.8), _late(0.0), 30.0, of_fixes=True),
    "gnss_late_3s": Fault(_late(3.0), _late(0.0), 30.0, of_fixes=True),
    "gnss_late_20s": Fault(_late(20.0), _late(0.0), 30.0, of_fixes=True),
    "gnss_late_0.8s_from_first_byte": Fault(
        _late(0.8), _late(0.0), 40.0, ("aligning",), of_fixes=True, first_byte=True
    ),
    "gnss_late_3s_from_first_byte": Fault(
        _late(3.0), _late(0.0), 40.0, ("aligning",), of_fixes=True, first_byte=True
    ),
    # CAN
    "imu_unplugged_1s": Fault(plugged("imu", False), plugged("imu", True), 1.0),
    "imu_unplugged_10s": Fault(plugged("imu", False), plugged("imu", True)),
    "can_down": Fault(_link("down"), _link("up"), needs="vcan"),
    "can_error_frames": Fault(_frames(_error_frames, 0.1, 9.0), _nothing),
    "can_foreign_frames": Fault(_frames(_foreign_frames, 0.01, 9.0), _nothing),
    "imu_counter_jumps": Fault(_counter_jumps, _imu_well),
    "imu_frames_lost": Fault(_frames_lost, _imu_well),
    "imu_stamp_0.7s_ahead": _stamp(0.7, 0),
    "imu_ticks_0.3s_ahead": _stamp(0.3, 100),
    "imu_ticks_0.3s_behind": _stamp(-0.3, 100),
    "imu_clock_set_0.5s_back": Fault(_device_set(-0.5), _imu_well),
    "imu_clock_set_0.5s_ahead": Fault(_device_set(0.5), _imu_well),
    # broker and operator
    "broker_killed": Fault(_broker_killed, _broker_back, phases=ALL[:2]),
    "broker_frozen": Fault(_broker_frozen, _broker_thawed, 25.0, ALL[:2]),
    "two_of_one_name": Fault(_rival, _nothing, 21.0, ("navigating",)),
    "commands_1000_hz": Fault(_commands, _nothing, phases=ALL[:2]),
    # the host
    "stopped_20s": Fault(_stopped, _continued, 20.0),
    "starved": Fault(_starved, _nothing),
    "no_descriptors": Fault(_no_descriptors, _descriptors, phases=ALL[:2]),
    "statm_hidden": Fault(_statm(True), _statm(False), phases=ALL[:2], needs="guest"),
    "gnss_utc_one_hour": Fault(
        _receivers_clock(3_600_000_000_000), _receivers_clock(-3_600_000_000_000), 15.0
    ),
    "gnss_utc_2100": Fault(
        _receivers_clock(YEAR_2100_NS), _receivers_clock(-YEAR_2100_NS), 15.0, of_fixes=True
    ),
    "gnss_utc_2100_from_first_byte": Fault(
        _receivers_clock(YEAR_2100_NS), _nothing, 40.0, ("aligning",), first_byte=True
    ),
    "system_clock_one_hour": Fault(_system_clock(3600.0), _system_clock(-3600.0), needs="guest"),
    "system_clock_ten_years_back": Fault(
        _system_clock(-3.15e8), _system_clock(3.15e8), needs="guest"
    ),
    "system_clock_of_2100": Fault(
        _system_clock(YEAR_2100_NS * 1e-9), _system_clock(-YEAR_2100_NS * 1e-9), needs="guest"
    ),
}
