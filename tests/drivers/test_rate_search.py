"""A receiver that sends at another rate than it is read at, while the daemon runs."""

from __future__ import annotations

import asyncio
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base import DriverStatus
from drivers.measurements import DeviceEvent, PositionFix
from drivers.nmea.driver import NmeaDriver, NmeaOptions
from drivers.rate_search import BAUDS, LISTEN_NS, RateSearch
from drivers.receiver import ReceiverDriver
from drivers.ubx.driver import UbxDriver
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import gga, rmc
from tests.patience import PATIENCE_S, until
from tests.pty_device import Device

SPEEDS = {termios.B4800: 4800, termios.B9600: 9600, termios.B38400: 38400, termios.B115200: 115200}


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "gnss")
    device.plug()
    yield device
    device.unplug()


class Receiver:
    """Sends at `baud`; what is read at another rate is noise."""

    def __init__(self, device: Device, baud: int) -> None:
        self._device, self.baud = device, baud
        self._second = 0

    @property
    def read_at(self) -> int:
        return SPEEDS.get(termios.tcgetattr(self._device.master)[5], 0)

    def send(self) -> None:
        self._second = self._second % 50 + 1
        said = gga(self._second) + rmc(self._second)
        self._device.send(
            said if self.read_at == self.baud else bytes(byte * 7 % 128 | 0x80 for byte in said)
        )


async def test_a_receiver_that_changes_its_rate_is_followed_and_told(device: Device) -> None:
    """115200 as configured, 9600 after it has lost its battery, and 115200 again."""
    now_ns, emitted = 0, []
    options = NmeaOptions(port=str(device.link), baud=115200, timeout_s=0.5)
    driver = NmeaDriver("gnss", options, emitted.append, lambda: now_ns)
    receiver = Receiver(device, 115200)

    def fixes() -> int:
        return sum(isinstance(each, PositionFix) for each in emitted)

    async def goes_on() -> None:
        nonlocal now_ns
        before = fixes()
        async with asyncio.timeout(PATIENCE_S):
            while fixes() < before + 3:
                receiver.send()
                now_ns += 500_000_000
                await asyncio.sleep(0.02)

    async with at_work(driver.run()):
        await until(lambda: driver.counters["opened"] == 1)
        await goes_on()
        assert (driver.cautions, driver.counters["bauds_tried"]) == ({}, 0)
        receiver.baud = 9600
        await goes_on()
        assert "at 9600 baud, and not at 115200" in driver.cautions["baud_followed"]
        assert driver.status == DriverStatus("running", "")
        receiver.baud = 115200
        await goes_on()
        assert "baud_followed" not in driver.cautions
    told = [each.code for each in emitted if isinstance(each, DeviceEvent)]
    assert told == [
        *("device_running", "device_silent", "device_running", "baud_followed"),
        *("device_silent", "device_running"),
    ]


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (b"", "no bytes"),
        (b"\xff", "bytes arrive"),
        (gga(1).partition(b"*")[0] + b"\r\n", "NMEA se"),
    ],
    ids=["nothing", "a disturbance", "a cause that is known"],
)
async def test_no_rate_is_tried_for_what_no_rate_mends(
    device: Device, sent: bytes, why: str
) -> None:
    now_ns = 0
    driver: ReceiverDriver = NmeaDriver(
        "gnss", NmeaOptions(port=str(device.link), timeout_s=0.5), lambda _: None, lambda: now_ns
    )
    async with at_work(driver.run()):
        await until(lambda: driver.counters["opened"] == 1)
        for _ in range(8 if len(sent) > 1 else 1):
            device.send(sent)
        await until(lambda: driver.counters["bytes_in"] >= len(sent))
        now_ns += 60 * 1_000_000_000
        await until(lambda: driver.status.state == "silent")
        assert driver.status.detail.startswith(why)
        assert driver.counters["bauds_tried"] == 0


def test_other_receivers_follow_too() -> None:
    driver = UbxDriver("gnss", UbxDriver.Options(port="/dev/none"), lambda _: None, lambda: 0)
    driver.inputs.take("open", t_ns=0)
    for k in range(100):
        driver.counters["bytes_in"] += 100
        driver.inputs.take("read", b"\x80" * 100, k * 1_000_000_000)
        driver.inputs.take("watch", t_ns=k * 1_000_000_000)
    assert driver.counters["bauds_tried"] > len(BAUDS)


def test_every_rate_comes_in_turn_the_configured_one_among_them() -> None:
    search, tried = RateSearch(4_000_000), []
    for k in range(40):
        if (baud := search.next(k * LISTEN_NS // 2, 1000 * k)) is not None:
            tried.append(baud)
    assert tried[: len(BAUDS)] == list(BAUDS)
    assert tried[len(BAUDS)] == 4_000_000
    assert len(tried) == 20
