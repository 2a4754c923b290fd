"""Logs of real receivers, against counts made by another way of reading the same bytes."""

from __future__ import annotations

import math
import re
from datetime import UTC, date, datetime
from functools import reduce
from operator import xor

import pytest

from drivers.measurements import Measurement, PositionFix, TimeReport, UtcStamp
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from tests.places import DATA

LOGS = DATA / "nmea"


def read(name: str) -> bytes:
    path = LOGS / name
    if not path.exists():
        pytest.skip(f"real receiver log {name} is absent: {path} (set FUSIOND_DATA)")
    return path.read_bytes()


def decode(log: bytes, size: int = 1 << 20) -> tuple[list[Measurement], NmeaDecoder]:
    decoder = NmeaDecoder("gnss", NmeaDecoding(earliest_date=date(2015, 1, 1)))
    found = [m for i in range(0, len(log), size) for m in decoder.feed(log[i : i + size], 0)]
    return found + decoder.flush(), decoder


def lines(log: bytes, formatter: bytes) -> list[list[str]]:
    """Fields of every line of a formatter whose checksum is right, found by pattern alone."""
    found = re.findall(rb"\$((?:G[NPBLA]|BD)" + formatter + rb"[^$*\r\n]*)\*([0-9A-F]{2})", log)
    return [body.decode().split(",") for body, hh in found if reduce(xor, body, 0) == int(hh, 16)]


def count_ubx(log: bytes) -> int:
    """Every place in the file where a whole UBX frame verifies."""
    count = 0
    for match in re.finditer(rb"\xb5\x62", log):
        at = match.start()
        end = at + 6 + int.from_bytes(log[at + 4 : at + 6], "little")
        a = b = 0
        for byte in log[at + 2 : end]:
            a = a + byte & 0xFF
            b = b + a & 0xFF
        count += log[end : end + 2] == bytes([a, b])
    return count


def count_rtcm(log: bytes) -> int:
    """Every place in the file where a whole RTCM 3 frame verifies, by long division."""
    count = 0
    for match in re.finditer(rb"\xd3[\x00-\x03]", log):
        at = match.start()
        frame = log[at : at + 6 + (int.from_bytes(log[at + 1 : at + 3], "big") & 0x3FF)]
        remainder = 0
        for byte in frame:
            remainder ^= byte << 16
            for _ in range(8):
                remainder <<= 1
                if remainder & 0x1000000:
                    remainder ^= 0x1864CFB
        count += len(frame) > 6 and remainder == 0
    return count


def test_zed_f9r_three_protocols_on_one_wire() -> None:
    log = read("ublox-zed-f9r.log")
    found, decoder = decode(log)
    counters = decoder.counters
    assert counters["sentences"] == len(lines(log, rb"[A-Z]{3}")) == 871
    assert counters["ubx_frames"] == count_ubx(log) == 277
    assert counters["rtcm_frames"] == count_rtcm(log) == 224
    for refused in ("garbage_bytes", "checksum_bad", "ubx_damaged", "rtcm_damaged", "bad_field"):
        assert counters[refused] == 0, refused
    gga, gst = lines(log, b"GGA"), lines(log, b"GST")
    fixes = [m for m in found if isinstance(m, PositionFix)]
    assert len(fixes) == len(gga) == 30
    for fix, printed, sigma in zip(fixes, gga, gst, strict=True):
        assert math.degrees(fix.lat_rad) == pytest.approx(45 + float(printed[2][2:]) / 60)
        assert math.degrees(fix.lon_rad) == pytest.approx(7 + float(printed[4][3:]) / 60)
        assert fix.height_m == pytest.approx(float(printed[9]) + float(printed[11]))
        assert fix.quality == int(printed[6])
        assert fix.sd_ned_m == tuple(map(float, sigma[6:9]))
        assert fix.v_ned_m_s == (0.0, 0.0, None)  # parked: speed without a course
    assert sum(isinstance(m, TimeReport) for m in found) == 30


def test_zed_f9r_instants() -> None:
    found, _ = decode(read("ublox-zed-f9r.log"))
    first = int(datetime(2025, 4, 11, 23, 14, 8, tzinfo=UTC).timestamp()) * 1_000_000_000
    stamps = [m.stamp for m in found if isinstance(m, PositionFix)]
    assert stamps == [UtcStamp(first + i * 1_000_000_000) for i in range(30)]


def test_zed_f9r_dead_reckoning_is_refused() -> None:
    """The log holds RTK float only. The same bytes with quality 6 give no fix and say why."""
    log = read("ublox-zed-f9r.log")
    _, decoder = decode(log)
    states = [fields[6] for fields in lines(log, b"GGA")]
    assert decoder.counters["dead_reckoning_refused"] == states.count("6") == 0

    def dead_reckoning(match: re.Match[bytes]) -> bytes:
        body = match[1] + b",6," + match[2]
        return b"$%s*%02X" % (body, reduce(xor, body, 0))

    changed = re.sub(rb"\$(GNGGA(?:,[^,]*){5}),5,([^*]*)\*..", dead_reckoning, log)
    assert len(changed) == len(log)
    found, decoder = decode(changed)
    assert not [m for m in found if isinstance(m, PositionFix)]
    assert decoder.counters["dead_reckoning_refused"] == 30
    assert decoder.counters["sentences"] == 871


@pytest.mark.parametrize(
    ("name", "epochs", "fixes", "day"),
    [("beidou-bd.log", 10, 5, date(2015, 2, 25)), ("beidou-gb.log", 5, 2, date(2015, 3, 2))],
)
def test_beidou_talkers(name: str, epochs: int, fixes: int, day: date) -> None:
    log = read(name)
    found, decoder = decode(log)
    gga = lines(log, b"GGA")
    assert decoder.counters["epochs"] == len(gga) == epochs
    assert decoder.counters["no_fix"] == sum(line[6] == "0" for line in gga)
    got = [m for m in found if isinstance(m, PositionFix)]
    assert len(got) == fixes == sum(line[6] == "1" for line in gga)
    for fix in got:
        assert isinstance(fix.stamp, UtcStamp)
        assert datetime.fromtimestamp(fix.stamp.utc_ns // 10**9, UTC).date() == day
        assert fix.v_ned_m_s is not None
        assert fix.vdop is not None


@pytest.mark.parametrize("name", ["ublox-zed-f9r.log", "beidou-bd.log", "beidou-gb.log"])
def test_split_at_every_byte_gives_the_same(name: str) -> None:
    log = read(name)[:60_000]
    whole, by_byte = decode(log), decode(log, 1)
    assert whole[0] == by_byte[0]
    assert whole[1].counters == by_byte[1].counters


def test_every_damaged_byte_costs_at_most_its_epoch() -> None:
    log = read("beidou-gb.log")
    _, good = decode(log)
    for at in range(0, len(log), 7):
        damaged = log[:at] + bytes([log[at] ^ 0x81]) + log[at + 1 :]
        _, decoder = decode(damaged)
        assert good.counters["sentences"] - 1 <= decoder.counters["sentences"]
        assert decoder.counters["fixes"] >= good.counters["fixes"] - 1
