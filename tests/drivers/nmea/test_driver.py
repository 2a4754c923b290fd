"""NmeaDriver on a real pseudo terminal: from bytes to fixes, and what its status says."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.base import Driver, Now, monotonic_ns
from drivers.measurements import (
    DeviceEvent,
    Measurement,
    PositionFix,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.driver import NmeaDriver, NmeaOptions
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import gga, made, rmc, wire
from tests.patience import PATIENCE_S, until
from tests.pty_device import Device


class Vehicle:
    """A driver and all that it handed over."""

    def __init__(self, device: Device, now_ns: Now = monotonic_ns, **options: Any) -> None:
        self.emitted: list[Measurement | DeviceEvent] = []
        self.driver = NmeaDriver(
            "gnss", NmeaOptions(port=str(device.link), **options), self.emitted.append, now_ns
        )

    @property
    def fixes(self) -> list[PositionFix]:
        return [m for m in self.emitted if isinstance(m, PositionFix)]

    @property
    def events(self) -> list[str]:
        return [m.code for m in self.emitted if isinstance(m, DeviceEvent)]

    def state(self) -> str:
        return self.driver.status.state


@asynccontextmanager
async def running(vehicle: Vehicle) -> AsyncIterator[Vehicle]:
    async with at_work(vehicle.driver.run()):
        yield vehicle


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "gnss")
    yield device
    device.unplug()


def opened(vehicle: Vehicle, times: int = 1) -> bool:
    return vehicle.driver.counters["opened"] == times


async def test_from_bytes_to_fixes(device: Device) -> None:
    device.plug()
    vehicle = Vehicle(device)
    driver: Driver = vehicle.driver  # the protocol every driver keeps
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        device.send(gga(29) + rmc(29))
        await until(lambda: len(vehicle.fixes) == 1)  # 50 ms of silence closes the epoch
        device.send(b"\xb5\x62\x01\x07\x00\x00\x08\x19" + gga(30)[:20])
        await asyncio.sleep(0)
        device.send(gga(30)[20:] + rmc(30) + gga(31))
        await until(lambda: len(vehicle.fixes) == 3)
        assert driver.status.state == "running"
        assert driver.status.detail == ""
    assert [f.stamp for f in vehicle.fixes] == [
        UtcStamp(1796091269_000_000_000 + i * 1_000_000_000) for i in range(3)
    ]
    assert all(f.source == "gnss" and f.quality == 4 for f in vehicle.fixes)
    assert vehicle.fixes[0].t_seen_ns < vehicle.fixes[1].t_seen_ns <= vehicle.fixes[2].t_seen_ns
    assert sum(isinstance(m, TimeReport) for m in vehicle.emitted) == 2
    assert driver.counters["ubx_frames"] == 1
    assert driver.counters["bytes_in"] > 0
    assert vehicle.events == ["device_running"]


async def test_absent_at_start_then_plugged(device: Device) -> None:
    vehicle = Vehicle(device)
    async with running(vehicle):
        await until(lambda: vehicle.state() == "absent")
        assert "does not exist; retrying" in vehicle.driver.status.detail
        device.plug()
        await until(lambda: opened(vehicle))
        device.send(gga(29))
        await until(lambda: len(vehicle.fixes) == 1)
        assert vehicle.state() == "running"
    assert vehicle.events == ["device_absent", "device_running"]
    assert isinstance(vehicle.fixes[0].stamp, TimeOfDayStamp)  # no date was ever seen


async def test_unplugged_in_the_middle_of_a_sentence_and_plugged_again(device: Device) -> None:
    device.plug()
    vehicle = Vehicle(device)
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        device.send(gga(29) + rmc(29)[:25])
        await until(lambda: vehicle.driver.counters["bytes_in"] >= len(gga(29)) + 25)
        device.unplug()
        await until(lambda: vehicle.state() == "absent")
        assert len(vehicle.fixes) == 1  # the open epoch is not lost with the device
        device.plug()
        await until(lambda: opened(vehicle, 2))
        device.send(gga(45) + rmc(45))
        await until(lambda: len(vehicle.fixes) == 2)
        assert vehicle.state() == "running"
    assert vehicle.events == ["device_running", "device_absent", "device_running"]
    assert vehicle.driver.counters["bad_field"] == 0


async def test_wrong_baud_rate_is_named(device: Device) -> None:
    """What 115200 looks like when read at 9600: bytes, mostly with the high bit set."""
    device.plug()
    now_ns = 0  # moves while rubbish comes, and stands still after

    vehicle = Vehicle(device, lambda: now_ns, timeout_s=0.3, baud=9600)
    garbage = bytes((i * 193 + 7) % 256 | 0x80 for i in range(80))
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        async with asyncio.timeout(PATIENCE_S):
            while vehicle.state() != "silent" or "baud" not in vehicle.driver.status.detail:
                device.send(garbage)
                now_ns += 20_000_000
                await asyncio.sleep(0.02)
        assert "9600 baud" in vehicle.driver.status.detail
        assert "device_silent" in vehicle.events
        device.send(garbage + gga(29))
        await until(lambda: len(vehicle.fixes) == 1)
        assert vehicle.state() == "running"


@pytest.mark.parametrize(
    ("sent", "state", "words"),
    [
        (b"", "silent", "no bytes for 0.3 s"),
        (b"\xb5\x62\x01\x07\x00\x00\x08\x19", "silent", "switch on NMEA output"),
        (wire(made("GPGSV,1,1,00,1")), "running", "switch on GGA"),
        (gga(29).partition(b"*")[0] + b"\r\n", "silent", "without a checksum"),
        (wire(made("LCRMC,021429.00,A,3958.12,N,11619.5,E,1,90,011226,,")), "running", "talker LC"),
        (wire(made("GNGGA,,,,,,0,00,99.99,,,,,,")), "running", "no fix"),
        (gga(29, quality=6), "running", "dead reckoning"),
        (gga(29, quality=8), "running", "simulates"),
    ],
    ids=["nothing", "ubx", "gsv", "no_checksum", "talker", "no_fix", "dead_reckoning", "simulator"],
)
async def test_status_says_what_is_wrong(
    device: Device, sent: bytes, state: str, words: str
) -> None:
    device.plug()
    vehicle = Vehicle(device, timeout_s=0.3)
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        async with asyncio.timeout(PATIENCE_S):
            while vehicle.state() != state or words not in vehicle.driver.status.detail:
                device.send(sent)
                await asyncio.sleep(0.02)
    assert vehicle.fixes == []


async def test_an_epoch_with_a_pause_in_it_is_one_fix(device: Device) -> None:
    """GGA, more than 50 ms, RMC of the same hhmmss.ss (zephyrproject-rtos/zephyr#67669)."""
    device.plug()
    vehicle = Vehicle(device)
    counters = vehicle.driver.counters
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        for second in range(20, 27):
            device.send(gga(second))
            await until(lambda n=second - 19: counters["sentences"] == 2 * n - 1)
            await asyncio.sleep(0.12)
            device.send(rmc(second))
            await until(lambda n=second - 19: counters["sentences"] == 2 * n)
        await until(lambda: len(vehicle.fixes) == 7)
    velocities = [fix.v_ned_m_s for fix in vehicle.fixes]
    assert None not in velocities[1:], "from the second epoch on"
    assert [f.t_seen_ns for f in vehicle.fixes] == sorted(f.t_seen_ns for f in vehicle.fixes)


async def test_what_makes_fixes_poorer_is_an_event_once(device: Device) -> None:
    device.plug()
    vehicle = Vehicle(device)
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        for second in range(20, 25):
            device.send(gga(second).replace(b"-9.1", b"") + rmc(second))  # a wrong checksum now
            device.send(wire(made(gga(second).decode()[1:-5].replace("-9.1", ""))) + rmc(second))
            await until(lambda n=second - 20: len(vehicle.fixes) > n)
    told = [m for m in vehicle.emitted if isinstance(m, DeviceEvent)]
    assert [e.code for e in told].count("height_above_sea") == 1
    assert vehicle.driver.cautions["height_above_sea"] in [e.text for e in told]


async def test_a_receiver_that_hangs_is_named(device: Device) -> None:
    """It repeats one epoch without a pause: one fix, then duplicates, then no position."""
    device.plug()
    vehicle = Vehicle(device, timeout_s=0.3)
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        async with asyncio.timeout(PATIENCE_S):
            while "repeats" not in vehicle.driver.status.detail:
                device.send(gga(29))
                await asyncio.sleep(0.02)
    assert len(vehicle.fixes) == 1
    assert vehicle.driver.counters["duplicate_epoch"] > 1


async def test_garbage_never_leaves_the_driver(device: Device) -> None:
    device.plug()
    vehicle = Vehicle(device)
    async with running(vehicle):
        await until(lambda: opened(vehicle))
        sent = 0
        for i in range(60):
            piece = (
                bytes((i * j * 31 + j * j) % 256 for j in range(60)) + b"$GNGGA,$\xb5\x62\xd3\x00"
            )
            device.send(piece)
            sent += len(piece)
            await until(lambda sent=sent: vehicle.driver.counters["bytes_in"] == sent)
        device.send(gga(29))
        await until(lambda: len(vehicle.fixes) == 1)
    assert vehicle.driver.counters["garbage_bytes"] >= sent - 64


def test_options_refuse_what_cannot_work() -> None:
    for wrong in (
        {},
        {"port": "/dev/null", "baud": 0},
        {"port": "/dev/null", "speed": 9600},
        {"port": "/dev/null", "last_sentence": "GSV"},
        {"port": "/dev/null", "earliest_date": "yesterday"},
        {"port": "/dev/null", "timeout_s": 0},
    ):
        with pytest.raises(ValidationError):
            NmeaOptions.model_validate(wrong)
