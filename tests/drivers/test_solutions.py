"""The drivers ubx, bestpos and sbf on a pseudo terminal, and what they share: judgement, GGA."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from drivers.base import Emitted
from drivers.bestpos.driver import BestposDriver
from drivers.measurements import DeviceEvent, Heading, PositionFix, TimeReport
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.raw.driver import GnssDecoder
from drivers.sbf.driver import SbfDriver
from drivers.ubx.driver import UbxDriver
from fusiond.configuration.schema import Config
from fusiond.doctor.doctor import examine
from tests.drivers.at_work import at_work
from tests.drivers.bestpos import logs as bestpos
from tests.drivers.nmea.sentences import gga, rmc
from tests.drivers.sbf import blocks as sbf
from tests.drivers.ubx import frames as ubx
from tests.patience import until
from tests.pty_device import Device


class Protocol(NamedTuple):
    """A driver, epochs of a position and a heading, and what its `status` says."""

    driver: Any
    epoch: Any
    heading: Any
    refused: bytes
    why: str
    no_position: bytes
    switch_on: str


PROTOCOLS = {
    "ubx": Protocol(
        UbxDriver,
        lambda k: ubx.pvt(k) + ubx.dop(k),
        ubx.relposned,
        ubx.pvt(flags=0),
        "the receiver does not stand by its fixes",
        ubx.nav(0x35, "I", 0),
        "switch on UBX-NAV-PVT",
    ),
    "bestpos": Protocol(
        BestposDriver,
        lambda k: bestpos.bestpos(k) + bestpos.bestvel(k),
        bestpos.heading,
        bestpos.bestpos(kind="INS_PSRSP"),
        "own inertial solution",
        bestpos.novatel("RXSTATUSA", "0,5"),
        "switch it on (LOG BESTPOSA ONTIME",
    ),
    "sbf": Protocol(
        SbfDriver,
        lambda k: sbf.pvt(k) + sbf.dop(k),
        lambda k: sbf.attitude(k) + sbf.attitude_covariance(k),
        sbf.pvt(mode=0),
        "the receiver has no fix",
        sbf.block(4027, bytes(40)),
        "switch on PVTGeodetic",
    ),
}


@pytest.fixture(params=PROTOCOLS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "gnss")
    device.plug()
    yield device
    device.unplug()


def made(name: str, device: Device, **options: Any) -> tuple[Any, list[Emitted]]:
    kind, emitted = PROTOCOLS[name].driver, list[Emitted]()
    chosen = kind.Options(port=str(device.link), **options)
    return kind("gnss", chosen, emitted.append), emitted


def of(emitted: list[Emitted], kind: type) -> list[Any]:
    return [each for each in emitted if isinstance(each, kind)]


async def test_a_line_becomes_fixes_headings_and_time(name: str, device: Device) -> None:
    protocol = PROTOCOLS[name]
    driver, emitted = made(name, device)
    async with at_work(driver.run()):
        await until(lambda: driver.counters["opened"] == 1)
        for k in range(3):
            device.send(protocol.epoch(k) + protocol.heading(k))
            await until(lambda k=k: len(of(emitted, PositionFix)) == k + 1)
        await until(lambda: len(of(emitted, Heading)) == 3)
        assert driver.status.state == "running"
        assert driver.status.detail == ""
        device.unplug()
        await until(lambda: driver.status.state == "absent")
    assert len(of(emitted, TimeReport)) == 3
    assert all(fix.v_ned_m_s is not None or name != "ubx" for fix in of(emitted, PositionFix))


async def test_a_date_that_cannot_be_is_an_event_once(name: str, device: Device) -> None:
    """An old log, or a rollover: what was done about it is told."""
    driver, emitted = made(name, device, earliest_date="2090-01-01")
    async with at_work(driver.run()):
        await until(lambda: driver.counters["opened"] == 1)
        for k in range(3):
            device.send(PROTOCOLS[name].epoch(k) + PROTOCOLS[name].heading(k))
            await until(lambda k=k: len(of(emitted, PositionFix)) == k + 1)
    (told,) = [e for e in of(emitted, DeviceEvent) if e.code == "implausible_date"]
    assert "before 2090-01-01: its dates are not used, its times of day are" in told.text
    assert list(driver.cautions) == ["implausible_date"]
    assert of(emitted, TimeReport) == []


async def test_status_says_what_is_wrong(name: str, device: Device) -> None:
    protocol = PROTOCOLS[name]
    for sent, state, words in (
        (b"\xa5" * 60, "silent", "at 115200 baud"),
        (protocol.no_position, "running", protocol.switch_on),
        (protocol.refused, "running", protocol.why),
    ):
        driver, emitted = made(name, device, timeout_s=0.3)
        async with at_work(driver.run()), asyncio.timeout(20):
            while driver.status.state != state or words not in driver.status.detail:
                device.send(sent)
                await asyncio.sleep(0.02)
        assert of(emitted, PositionFix) == []


@pytest.mark.parametrize("other", ["nmea", *PROTOCOLS])
async def test_another_protocol_is_named_with_its_driver(
    name: str, other: str, device: Device
) -> None:
    """By the doctor too, which would say otherwise that the baud rate is wrong."""
    if other == name:
        return
    config = Config.model_validate(
        {
            "sources": {"gnss": {"driver": name, "port": str(device.link), "timeout_s": 0.3}},
            "mqtt": {"enabled": False},
        }
    )
    out = io.StringIO()
    task = asyncio.create_task(examine(config, 1.0, out))
    for k in range(8):
        await asyncio.sleep(0.1)
        device.send(gga(29 + k) + rmc(29 + k) if other == "nmea" else PROTOCOLS[other].epoch(k))
    await task
    findings = [line for line in out.getvalue().splitlines() if line.startswith("  ! ")]
    said = [line for line in findings if f'driver = "{other}"' in line]
    assert said, out.getvalue()
    assert "baud" not in "".join(findings)


async def test_doctor_reads_it(name: str, device: Device) -> None:
    config = Config.model_validate(
        {
            "sources": {
                "gnss": {
                    "driver": name,
                    "port": str(device.link),
                    "earliest_date": "2026-11-20",
                }
            },
            "mqtt": {"enabled": False},
        }
    )
    out = io.StringIO()
    task = asyncio.create_task(examine(config, 1.0, out))
    for k in range(8):
        await asyncio.sleep(0.1)
        device.send(PROTOCOLS[name].epoch(k))
    await task
    text = out.getvalue()
    assert f"gnss: {name} on {device.link}: running" in text
    assert "PositionFix: " in text
    assert "position lat 39.9687242 +- 0.0000000, lon 116.3257202" in text
    assert "height 36.20 +- 0.00 m" in text


def test_the_gga_for_a_caster_is_the_fix(name: str) -> None:
    """What NMEA's decoder reads of it is where the fix is, to a centimetre."""
    decoder = (
        PROTOCOLS[name]
        .driver("gnss", PROTOCOLS[name].driver.Options(port="tcp://localhost:1"), lambda _: None)
        ._decoder
    )
    assert decoder.gga == b""
    (fix,) = of(decoder.feed(PROTOCOLS[name].epoch(0), 0) + decoder.flush(), PositionFix)
    nmea = NmeaDecoder("gnss", NmeaDecoding())
    sentence = decoder.gga + b"\r\n" + rmc(29)
    (printed,) = of(nmea.feed(sentence, 0) + nmea.flush(), PositionFix)
    assert printed.lat_rad == pytest.approx(fix.lat_rad, abs=2e-9)
    assert printed.lon_rad == pytest.approx(fix.lon_rad, abs=2e-9)
    assert printed.height_m == pytest.approx(fix.height_m, abs=1e-3)
    assert (printed.quality, printed.satellites) == (fix.quality, fix.satellites)


def test_one_fix_an_epoch_of_a_line_with_nmea_and_ubx() -> None:
    """The first epoch's NMEA comes before its UBX; then UBX stands for both, until it ends."""
    decoder = GnssDecoder("gnss", NmeaDecoding())
    seen: list[PositionFix] = []
    for k in range(12):
        stream = gga(29 + k) + rmc(29 + k)
        if k < 3:
            stream += ubx.pvt(k, nano=0) + ubx.end_of_epoch(k)
        seen += of(decoder.feed(stream, k * 1_000_000_000), PositionFix)
    seen += of(decoder.flush(), PositionFix)
    instants = [fix.stamp.utc_ns // 1_000_000_000 for fix in seen]
    assert len(instants) == len(set(instants))
    down = [fix.v_ned_m_s is not None and fix.v_ned_m_s[2] is not None for fix in seen]
    assert down[1:3] == [True, True]
    assert not any(down[3:])
    assert len(seen) >= 7
    assert decoder.counters["nmea_fix_superseded"] >= 2
    without = GnssDecoder("gnss", NmeaDecoding(), use_nmea_fix=False)
    assert of(without.feed(ubx.pvt() + ubx.end_of_epoch(), 0), PositionFix) == []
