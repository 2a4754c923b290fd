"""GnssDriver on a real pseudo terminal, and RTCM 3 as it is taken apart or refused."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import Driver, Emitted, PermanentDriverError
from drivers.measurements import DeviceEvent, PositionFix, TimeReport, UtcStamp
from drivers.nmea.decoder import NmeaDecoding
from drivers.raw.decoder import RawDecoder
from drivers.raw.driver import GnssDecoder, GnssDriver, GnssOptions
from drivers.raw.messages import Ephemeris, Klobuchar, RawGnssEpoch
from tests.drivers.at_work import at_work
from tests.drivers.nmea.sentences import gga, rmc
from tests.drivers.raw.frames import bcnav1, d1, lnav, measurement, put, rawx, rtcm, sfrbx, ubx
from tests.patience import until
from tests.pty_device import Device


def raw(second: int) -> bytes:
    """Observations of the same instant as `rmc` of that second: 2026-12-01 02:14, GPS week 2447."""
    return rawx(measurement(), week=2447, tow_s=172_800.0 + 8040.0 + second + 18.0)


class Vehicle:
    """A driver and all that it handed over."""

    def __init__(self, device: Device, **options: Any) -> None:
        self.emitted: list[Emitted] = []
        self.driver = GnssDriver(
            "gnss", GnssOptions(port=str(device.link), **options), self.emitted.append
        )

    def of(self, kind: Any) -> list[Any]:
        return [item for item in self.emitted if isinstance(item, kind)]

    def status(self) -> tuple[str, str]:
        return self.driver.status.state, self.driver.status.detail


@asynccontextmanager
async def running(vehicle: Vehicle) -> AsyncIterator[Vehicle]:
    async with at_work(vehicle.driver.run()):
        await until(lambda: vehicle.driver.counters["opened"] == 1)
        yield vehicle


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "gnss")
    device.plug()
    yield device
    device.unplug()


BROADCAST = b"".join(sfrbx(3, 21, 4, words) for words in d1(1))


async def test_fixes_and_observations_of_one_line(device: Device) -> None:
    vehicle = Vehicle(device)
    driver: Driver = vehicle.driver
    async with running(vehicle):
        for second in (29, 30, 31):
            device.send(gga(second) + raw(second) + rmc(second))
            await until(lambda n=second - 28: len(vehicle.of(RawGnssEpoch)) == n)  # type: ignore[misc]
        device.send(BROADCAST)
        await until(lambda: len(vehicle.of(Ephemeris)) == 1)
        await until(lambda: len(vehicle.of(PositionFix)) == 3)
        assert vehicle.status() == ("running", "")
    assert [e.code for e in vehicle.of(DeviceEvent)] == ["device_running"]
    assert len(vehicle.of(Klobuchar)) == 1
    assert len(vehicle.of(TimeReport)) == 3  # of RMC only
    assert all(e.source == "gnss" and e.t_seen_ns > 0 for e in vehicle.of(RawGnssEpoch))
    assert driver.counters["rawx"] == driver.counters["fixes"] == 3


async def test_raw_alone_is_running_and_tells_the_time(device: Device) -> None:
    vehicle = Vehicle(device)
    async with running(vehicle):
        for i in range(10):
            device.send(rawx(measurement(), tow_s=345_600.0 + i))
            await until(lambda n=i + 1: len(vehicle.of(RawGnssEpoch)) == n)  # type: ignore[misc]
        await until(lambda: vehicle.status()[0] == "running")
        await until(lambda: "no ephemeris yet" in vehicle.status()[1])
        device.send(BROADCAST)
        await until(lambda: vehicle.status() == ("running", ""))
    reports = vehicle.of(TimeReport)
    assert len(reports) == 5  # after 5 s without RMC
    assert reports[-1].trusted
    assert UtcStamp(reports[-1].utc_ns) == vehicle.of(RawGnssEpoch)[-1].stamp


@pytest.mark.parametrize(
    ("sent", "state", "words"),
    [
        (b"", "silent", "no bytes for 0.3 s"),
        (b"\xa5" * 50, "silent", "neither NMEA, UBX nor RTCM 3 verifies at 115200 baud"),
        (b"!AIVDM,1,1,,A,13HOI:0P0000VOHLCnHQKwvL05Ip,0*23\r\n" * 4, "silent", "AIS (!AIVDM) arr"),
        (b"login: \r\nLinux pi 6.1\r\n" * 4, "silent", "such as 'Linux pi 6.1'"),
        (ubx(b"\x0a\x04", b"\x00" * 92), "running", "switch on UBX-RXM-RAWX"),
        (rawx(measurement(), week=0), "running", "no time yet"),
        (gga(29, quality=0), "running", "no fix"),
    ],
    ids=["nothing", "baud", "ais", "console", "no_rawx", "no_time", "no_fix"],
)
async def test_status_says_what_is_wrong(
    device: Device, sent: bytes, state: str, words: str
) -> None:
    vehicle = Vehicle(device, timeout_s=0.3)
    async with running(vehicle), asyncio.timeout(20):
        while vehicle.status()[0] != state or words not in vehicle.status()[1]:
            device.send(sent)
            await asyncio.sleep(0.02)
    assert vehicle.of(RawGnssEpoch) == []


async def test_b1c_without_its_group_delays_says_so_until_they_come(device: Device) -> None:
    vehicle = Vehicle(device)
    b1c = measurement(gnss=3, prn=21, sig=5)
    async with running(vehicle):
        device.send(b"".join(sfrbx(3, 21, 4, words) for words in d1(1)))
        device.send(rawx(b1c))
        await until(lambda: "no_group_delay" in vehicle.status()[1])
        assert "1 BeiDou satellites on B1C or B2a" in vehicle.status()[1]
        assert "switch on UBX-RXM-SFRBX" in vehicle.status()[1]
        device.send(b"".join(sfrbx(3, 21, 6, words) for words in bcnav1(1)))
        device.send(rawx(b1c, tow_s=345_601.0))
        await until(lambda: vehicle.status() == ("running", ""))
        # One that is tracked on B3I too, or another that has its delays, is no reason to complain.
        device.send(rawx(measurement(gnss=3, prn=22, sig=5), b1c, tow_s=345_602.0))
        await until(lambda: len(vehicle.of(RawGnssEpoch)) == 3)
        assert vehicle.status() == ("running", "")


async def test_unplugged_in_the_middle_of_a_frame(device: Device) -> None:
    vehicle = Vehicle(device)
    async with running(vehicle):
        device.send(rawx(measurement()) + rawx(measurement())[:30])
        await until(lambda: len(vehicle.of(RawGnssEpoch)) == 1)
        device.unplug()
        await until(lambda: vehicle.status()[0] == "absent")
        device.plug()
        await until(lambda: vehicle.driver.counters["opened"] == 2)
        device.send(rawx(measurement(), tow_s=345_601.0))
        await until(lambda: len(vehicle.of(RawGnssEpoch)) == 2)
    assert vehicle.driver.counters["frame_cut"] == 1


def test_what_of_the_stream_to_use() -> None:
    stream = gga(29) + rmc(29) + rawx(measurement()) + BROADCAST + gga(30) + rmc(30)

    def kinds(**options: bool) -> set[str]:
        decoder = GnssDecoder("gnss", NmeaDecoding(), **options)
        found = decoder.feed(stream, 0) + decoder.flush()
        return {type(item).__name__ for item in found}

    raw = {"RawGnssEpoch", "Ephemeris", "Klobuchar"}
    assert kinds() == {"PositionFix", "TimeReport"} | raw
    assert kinds(use_nmea_fix=False) == {"TimeReport"} | raw
    assert kinds(use_raw=False) == {"PositionFix", "TimeReport"}


# --------------------------------------------------------------------------- RTCM 3


def msm7(
    number: int,
    epoch_ms: int,
    more: int,
    cells: list[tuple[int, int, int, int]],
    prn: int = 5,
    lock: int = 704,
    half: int = 0,
) -> bytes:
    """One satellite, one signal: (whole ms, 2^-10 ms, 2^-29 ms, rate code) of its only cell; its
    lock time indicator, and whether half a cycle is open."""
    whole, part, fine, rate = cells[0]
    fields = [
        (number, 12), (0, 12), (epoch_ms, 30), (more, 1), (0, 3), (0, 7), (0, 2), (0, 2), (0, 1),
        (0, 3), (1 << (64 - prn), 64), (1 << 30, 32), (1, 1),
        (whole, 8), (0, 4), (part, 10), (100, 14),
        (fine, 20), (8, 24), (lock, 10), (half, 1), (45 * 16, 10), (rate, 15),
    ]  # fmt: skip
    value = total = 0
    for field, length in fields:
        value, total = value << length | field & ((1 << length) - 1), total + length
    return rtcm((value << -total % 8).to_bytes((total + 7) // 8, "big"))


def dated() -> RawDecoder:
    decoder = RawDecoder("gnss")
    decoder.note_utc(1_796_091_269_000_000_000)  # 2026-12-01 02:14:29, GPS week 2447
    return decoder


GOOD = (73, 512, -1000, 2500)


def test_msm7_units() -> None:
    decoder = dated()
    (found,) = decoder.feed(msm7(1127, 180_867_000 - 14_000, 0, [GOOD], prn=21), 9)
    assert isinstance(found, RawGnssEpoch)
    assert (found.week, found.tow_s, found.t_seen_ns) == (2447, 180_867.0, 9)
    (signal,) = found.signals
    ms = 299_792.458
    assert (signal.satellite, signal.signal, signal.cno_db_hz) == ("C21", "2I", 45.0)
    assert signal.pseudorange_m == pytest.approx((73.5 - 1000 * 2**-29) * ms, abs=1e-6)
    assert signal.carrier_cycles == pytest.approx((73.5 + 8 * 2**-31) * 1_561_098.0, abs=1e-6)
    assert signal.range_rate_m_s == pytest.approx(100.25)
    assert signal.sd_pseudorange_m is None


@pytest.mark.parametrize(
    ("indicator", "lock_s"),
    [(0, 0.0), (63, 0.063), (64, 0.064), (95, 0.126), (96, 0.128), (127, 0.252), (704, 67108.864)],
)
def test_msm_says_how_long_a_carrier_has_been_followed(indicator: int, lock_s: float) -> None:
    """RTCM 10403.3, table 3.5-75: the ends of its first segments, and the last value."""
    (found,) = dated().feed(msm7(1077, 180_867_000, 0, [GOOD], lock=indicator), 9)
    assert isinstance(found, RawGnssEpoch)
    assert found.signals[0].lock_s == pytest.approx(lock_s, abs=1e-9)


def test_msm_with_half_a_cycle_open() -> None:
    decoder = dated()
    (found,) = decoder.feed(msm7(1077, 180_867_000, 0, [GOOD], half=1), 9)
    assert isinstance(found, RawGnssEpoch)
    assert found.signals[0].carrier_cycles is None
    assert decoder.counters["half_cycle_open"] == 1


def test_one_epoch_out_of_several_messages() -> None:
    gps = msm7(1077, 180_867_000, 1, [GOOD])
    galileo = msm7(1097, 180_867_000, 1, [GOOD])
    beidou = msm7(1127, 180_853_000, 0, [GOOD])
    glonass = rtcm(put(0, 176, 0, 12, 1087).to_bytes(22, "big"))
    decoder = dated()
    assert decoder.feed(gps + galileo, 0) == []
    assert decoder.epoch_open
    (found,) = decoder.feed(beidou, 5)
    assert isinstance(found, RawGnssEpoch)
    assert [s.system for s in found.signals] == ["G", "E", "C"]
    # A message of a system that is not used may be the last of its epoch.
    assert len(dated().feed(gps + glonass, 0)) == 1
    # The last one is lost: the next epoch ends this one.
    later = msm7(1077, 180_868_000, 1, [GOOD])
    (found,) = dated().feed(gps + galileo + later, 0)
    assert isinstance(found, RawGnssEpoch)
    assert len(found.signals) == 2


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        (msm7(1077, 0, 0, [(255, 0, 0, 0)]), "pseudorange_invalid"),
        (msm7(1077, 0, 0, [(73, 0, -(1 << 19), 0)]), "pseudorange_invalid"),
        (msm7(1077, 0, 0, [(10, 0, 0, 0)]), "pseudorange_implausible"),
        (msm7(1077, 0, 0, [GOOD], prn=40), "prn_unknown"),
        (msm7(1077, 700_000_000, 0, [GOOD]), "rtcm_unreadable"),
        (rtcm((1077 << 4).to_bytes(2, "big")), "rtcm_unreadable"),
        (rtcm((1042 << 4).to_bytes(2, "big") + b"\x00" * 5), "rtcm_unreadable"),
        (rtcm((1042 << 4).to_bytes(2, "big") + b"\x00" * 62), "satellite_unknown"),
        (rtcm((1019 << 4).to_bytes(2, "big") + b"\x40" + b"\x00" * 58), "ephemeris_implausible"),
        (rtcm((1005 << 4).to_bytes(2, "big") + b"\x00" * 17), "rtcm_not_used"),
        (rtcm((1073 << 4).to_bytes(2, "big") + b"\x00" * 17), "msm_kind_not_used"),
        (rtcm((1087 << 4).to_bytes(2, "big") + b"\x00" * 17), "glonass_not_used"),
    ],
)
def test_rtcm_refused_by_name(frame: bytes, name: str) -> None:
    decoder = dated()
    found = decoder.feed(frame, 0)
    assert all(isinstance(e, RawGnssEpoch) and not e.signals for e in found)
    assert decoder.counters["rtcm_frames"] == decoder.counters[name] == 1


def test_msm_without_a_rate() -> None:
    decoder = dated()
    (found,) = decoder.feed(msm7(1077, 0, 0, [(73, 0, 0, -(1 << 14))]), 0)
    assert isinstance(found, RawGnssEpoch)
    assert found.signals[0].range_rate_m_s is None


RTCM_NAMES = ("msm", "msm_superseded", "week_unknown", "rtcm_ephemerides", "rtcm_unreadable")
RTCM_NAMES += ("rtcm_not_used", "msm_kind_not_used", "glonass_not_used", "sbas_not_used")
RTCM_NAMES += ("qzss_not_used", "navic_not_used", "ephemeris_implausible", "ephemeris_mixed")
RTCM_NAMES += ("satellite_unknown",)


@given(
    st.sampled_from([1019, 1042, 1045, 1046, 1074, 1077, 1084, 1094, 1097, 1124, 1127, 1005, 4072]),
    st.binary(max_size=250),
)
@settings(max_examples=300, deadline=None)
def test_rtcm_frames_of_random_bits_never_raise(number: int, body: bytes) -> None:
    decoder = dated()
    payload = (number << 4 | (body[0] & 15 if body else 0)).to_bytes(2, "big") + body
    for event in decoder.feed(rtcm(payload), 0) + decoder.flush():
        assert event.source == "gnss"
    assert decoder.counters["rtcm_frames"] == 1
    assert sum(decoder.counters[name] for name in RTCM_NAMES) == 1


def test_without_pyrtcm(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    monkeypatch.setitem(sys.modules, "pyrtcm", None)
    with pytest.raises(PermanentDriverError, match=r"install fusiond\[raw\], or set rtcm = false"):
        Vehicle(device)
    Vehicle(device, rtcm=False)
    Vehicle(device, use_raw=False)
    decoder = RawDecoder("gnss")
    assert len(decoder.feed(rawx(measurement()), 0)) == 1
    with pytest.raises(PermanentDriverError, match="pyrtcm"):
        decoder.feed(msm7(1077, 0, 0, [GOOD]), 0)
    off = RawDecoder("gnss", rtcm=False)
    assert off.feed(msm7(1077, 0, 0, [GOOD]), 0) == []
    assert off.counters["rtcm_not_used"] == 1


def test_old_logs_need_their_date() -> None:
    stream = b"".join(sfrbx(0, 7, 0, words) for words in lnav(1))
    decoder = GnssDecoder("gnss", NmeaDecoding(earliest_date=date(2000, 1, 1)))
    (found,) = decoder.feed(stream, 0)
    assert isinstance(found, Ephemeris)
    assert found.week == 2450 - 1024


@pytest.mark.parametrize(
    ("utc_s", "leap_s"),
    [(1_459_975_092, 17), (1_341_100_799, 15), (1_341_100_800, 16), (1_136_073_599, 13)],
)
def test_stamps_of_an_old_log_have_the_leap_seconds_of_their_date(utc_s: int, leap_s: int) -> None:
    decoder = RawDecoder("gnss", earliest=date(2000, 5, 1))
    decoder.note_utc(utc_s * 1_000_000_000)
    tow_ms = (utc_s - 315_964_800 + leap_s) % 604_800 * 1000
    (epoch,) = decoder.feed(msm7(1077, tow_ms, 0, [GOOD]), 0)
    assert isinstance(epoch, RawGnssEpoch)
    assert epoch.stamp == UtcStamp(utc_s * 1_000_000_000)


def system_parameters(day: int, second: int, leap: int) -> bytes:
    fields = [(1013, 12), (0, 12), (day, 16), (second, 17), (0, 5), (leap, 8)]
    value = total = 0
    for field, length in fields:
        value, total = value << length | field, total + length
    return rtcm((value << -total % 8).to_bytes((total + 7) // 8, "big"))


def test_1013_dates_a_stream_and_tells_its_leap_seconds() -> None:
    decoder = RawDecoder("gnss")
    assert decoder.feed(system_parameters(57_484, 74_292, 16), 0) == []  # 2016-04-06, a wrong count
    (epoch,) = decoder.feed(msm7(1077, 333_509_000, 0, [GOOD]), 0)
    assert isinstance(epoch, RawGnssEpoch)
    assert (epoch.week, epoch.stamp) == (1891, UtcStamp(1_459_975_093_000_000_000))
    assert decoder.counters["rtcm_system_parameters"] == 1
    decoder.feed(system_parameters(57_484, 74_292, 255), 0)
    assert decoder.counters["leap_seconds_implausible"] == 1
