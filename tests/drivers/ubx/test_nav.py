"""UBX-NAV: epochs out of frames made bit by bit, against pyubx2 and logs of real receivers."""

from __future__ import annotations

import io
import math
import random
from datetime import date
from pathlib import Path

import pytest
import pyubx2
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.decoder_options import SolutionDecoding
from drivers.measurements import (
    ArrivalStamp,
    Heading,
    Measurement,
    PositionFix,
    TimeOfDayStamp,
    TimeReport,
    UtcStamp,
)
from drivers.nmea.decoder import NmeaDecoder, NmeaDecoding
from drivers.ubx.decoder import UbxDecoder
from tests.drivers import solutions
from tests.drivers.raw.frames import ubx
from tests.drivers.raw.test_recordings import MIXED, WALK, read
from tests.drivers.solutions import check_refused, check_split_anywhere, fixes
from tests.drivers.ubx.frames import (
    cov,
    dop,
    end_of_epoch,
    hpposllh,
    nav,
    posecef,
    posllh,
    pvt,
    relposned,
    sol,
    status,
    timegps,
    timeutc,
    utc_ns,
    velecef,
    velned,
)

LAT, LON = math.radians(39.9687242), math.radians(116.3257202)
OLD = SolutionDecoding(earliest_date=date(2014, 1, 1))


def decoded(
    *frames: bytes, decoding: SolutionDecoding | None = None
) -> tuple[list[Measurement], UbxDecoder]:
    return solutions.decoded(UbxDecoder, *frames, decoding=decoding)


def test_pvt_alone() -> None:
    found, decoder = decoded(pvt())
    time, fix = found
    assert time == TimeReport("gnss", 7, utc_ns() - 127_759, False)
    assert fix == PositionFix(
        "gnss", 7, UtcStamp(utc_ns() - 127_759), pytest.approx(LAT), pytest.approx(LON), 36.2, 4,
        25, None, None, pytest.approx((0.014 / math.sqrt(2), 0.014 / math.sqrt(2), 0.02)),
        (1.0, -2.0, 0.03), pytest.approx((0.0999, 0.0999, 0.0999), abs=1e-3),
    )  # fmt: skip
    assert decoder.counters["nav_messages"] == decoder.counters["fixes"] == 1


def test_finer_messages_of_an_epoch_take_the_place_of_coarser() -> None:
    frames = (pvt(), hpposllh(), dop(), cov(), timegps(), end_of_epoch())
    for order in (frames, (*frames[4::-1], frames[5])):
        found, _ = decoded(*order)
        (fix,) = fixes(found)
        assert fix.lat_rad == pytest.approx(math.radians(39.968724166), abs=1e-15)
        assert fix.lon_rad == pytest.approx(math.radians(116.325720212), abs=1e-15)
        assert fix.height_m == pytest.approx(36.2005)
        assert fix.sd_ned_m == pytest.approx((0.01, 0.02, 0.03))
        assert fix.sd_v_ned_m_s == pytest.approx((0.1, 0.2, 0.3))
        assert (fix.hdop, fix.vdop) == (0.77, 0.99)
        assert fix.stamp == UtcStamp(utc_ns() - 127_759)
    (fix,) = fixes(decoded(pvt(), hpposllh(), cov(valid=0))[0])
    assert fix.sd_ned_m == pytest.approx((0.0141 / math.sqrt(2),) * 2 + (0.0205,))


@pytest.mark.parametrize(
    ("frames", "height_m"),
    [
        ((posllh(), velned(), status(), timeutc()), 36.2),
        ((posllh(), velned(), status(), timegps()), 36.2),
        ((sol(), velned()), None),
    ],
    ids=["timeutc", "timegps", "sol"],
)
def test_before_generation_7(frames: tuple[bytes, ...], height_m: float | None) -> None:
    (fix,) = fixes(decoded(*frames)[0])
    assert isinstance(fix.stamp, UtcStamp)
    assert abs(fix.stamp.utc_ns - utc_ns() + 127_759) <= 1
    assert fix.v_ned_m_s == pytest.approx((1.0, -2.0, 0.03))
    if height_m is None:  # ECEF: its header says where Esbjerg is
        assert math.degrees(fix.lat_rad) == pytest.approx(55.4938, abs=1e-3)
        assert math.degrees(fix.lon_rad) == pytest.approx(8.4568, abs=1e-3)
        assert fix.height_m == pytest.approx(59.3, abs=0.5)
        assert fix.sd_ned_m == pytest.approx((10.0 / math.sqrt(3),) * 3)
    else:
        assert fix.height_m == height_m
        assert fix.sd_ned_m == pytest.approx((1.0, 1.0, 2.0), abs=1e-3)


def test_velocity_of_sol_is_turned_from_earth_axes() -> None:
    (fix,) = fixes(decoded(sol())[0])
    for order in ((posecef(), velecef(), status()), (velecef(), status(), posecef())):
        (other,) = fixes(decoded(*order, timeutc())[0])
        assert other.lat_rad == fix.lat_rad
        assert (other.height_m, other.sd_ned_m) == (fix.height_m, fix.sd_ned_m)
        assert (other.v_ned_m_s, other.sd_v_ned_m_s) == (fix.v_ned_m_s, fix.sd_v_ned_m_s)
    assert fix.v_ned_m_s is not None
    north, east, down = fix.v_ned_m_s
    assert north == pytest.approx(1.006, abs=5e-3)
    assert abs(east) < 5e-3
    assert abs(down) < 5e-3


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        (pvt(flags=0), "limits_exceeded"),  # gpsd's log ublox-glo: 275 of 299 epochs
        (pvt(fix=0), "no_fix"),
        (pvt(fix=0, flags=0), "no_fix"),
        (pvt(fix=5), "time_only_refused"),  # gpsd's logs ublox-lea-m8f, ublox-neo-m8t-s
        (pvt(fix=9), "no_fix"),
        (pvt(flags3=1), "no_fix"),
        (hpposllh(flags=1) + status(), "no_fix"),
        (pvt(fix=1), "dead_reckoning_refused"),
        (pvt(valid=1), "untimed_epoch"),
        (pvt(height=200_000_000), "height_implausible"),
        (pvt(lat=910_000_000), "position_implausible"),
        (pvt(v=(2_000_000, 0, 0)), "speed_implausible"),
        (pvt(sd_h=0xFFFFFFFF), "sigma_too_large"),
        (posllh(), "status_missing"),
        (pvt() + end_of_epoch() + pvt(), "duplicate_epoch"),
    ],
)
def test_refused_by_name(frame: bytes, name: str) -> None:
    check_refused(UbxDecoder, frame, name)


@pytest.mark.parametrize(
    "frame",
    [pvt(day=(2026, 13, 1)), pvt(nano=2_000_000_000), pvt(length=83), nav(0x04, "I", 1),
     ubx(b"\x01\x3c", b"\x00" * 40)],
)  # fmt: skip
def test_unreadable(frame: bytes) -> None:
    found, decoder = decoded(frame)
    assert found == []
    assert decoder.counters["nav_unreadable"] == 1


def test_a_date_that_cannot_be_leaves_the_time_of_day() -> None:
    """A week rollover: 1024 weeks back. The fix is one all the same, and nobody's clock is set."""
    (fix,), decoder = decoded(pvt(day=(2007, 4, 17)))
    assert isinstance(fix, PositionFix)
    assert fix.stamp == TimeOfDayStamp(pytest.approx(2 * 3600 + 14 * 60 + 29 - 127_759e-9))
    assert decoder.counters["implausible_date"] == decoder.counters["fixes"] == 1


def test_a_plane_fix_has_no_height() -> None:
    (fix,) = fixes(decoded(pvt(fix=2))[0])
    assert fix.height_m is None
    assert fix.v_ned_m_s == (1.0, -2.0, None)
    assert fix.sd_v_ned_m_s is not None
    assert fix.sd_v_ned_m_s[2] is None


def test_a_velocity_that_is_not_known_costs_no_position() -> None:
    found, decoder = decoded(pvt(sd_speed=0xFFFFFFFF))
    (fix,) = fixes(found)
    assert (fix.v_ned_m_s, fix.sd_v_ned_m_s) == (None, None)
    assert decoder.counters["velocity_unknown"] == 1


@pytest.mark.parametrize(("flags", "quality"), [(1, 1), (3, 2), (3 | 1 << 6, 5), (1 | 2 << 6, 4)])
def test_quality(flags: int, quality: int) -> None:
    (fix,) = fixes(decoded(pvt(flags=flags))[0])
    assert fix.quality == quality


def test_time_is_believed_after_even_steps() -> None:
    decoder = UbxDecoder("gnss")
    found = [m for k in range(5) for m in decoder.feed(pvt(k), k * 1_000_000_000)]
    reports = [m for m in found + decoder.flush() if isinstance(m, TimeReport)]
    assert [m.trusted for m in reports] == [False, False, True, True, True]
    unresolved = UbxDecoder("gnss")
    found = [m for k in range(5) for m in unresolved.feed(pvt(k, valid=3), k * 1_000_000_000)]
    assert not any(m.trusted for m in found if isinstance(m, TimeReport))


def test_a_leap_second_repeats_the_last_one() -> None:
    frame = bytearray(pvt(0, day=(2026, 12, 31))[6:-2])
    frame[8:11] = bytes((23, 59, 60))
    found, _ = decoded(ubx(b"\x01\x07", bytes(frame)))
    (fix,) = fixes(found)
    assert fix.stamp == UtcStamp(1_798_761_599_000_000_000 - 127_759)


# --------------------------------------------------------------------------- where an epoch ends


def test_the_last_message_is_learned_and_unlearned() -> None:
    decoder = UbxDecoder("gnss")
    counts = []
    for k in range(6):
        at_once = decoder.feed(pvt(k) + dop(k), 0)
        counts.append(len(fixes(at_once)))
    # The first three close with the next one; then DOP is known to be the last.
    assert counts == [0, 1, 2, 1, 1, 1]
    found = decoder.feed(pvt(6) + dop(6) + hpposllh(6), 0)
    assert len(fixes(found)) == 1
    assert decoder.counters["late_message"] == 1
    assert fixes(decoder.feed(pvt(7) + dop(7) + hpposllh(7), 0)) == []
    assert len(fixes(decoder.silence())) == 1


def test_end_of_epoch_closes_at_once() -> None:
    decoder = UbxDecoder("gnss")
    for k in range(4):
        assert fixes(decoder.feed(pvt(k) + dop(k), 0)) == []
        assert len(fixes(decoder.feed(end_of_epoch(k), 0))) == 1
        assert not decoder.epoch_open


def test_positions_between_times_are_dated_by_itow() -> None:
    found, _ = decoded(
        *(status(0) + posllh(0) + timeutc(0), *(status(k) + posllh(k) for k in range(1, 4)))
    )
    stamps = [m.stamp for m in fixes(found)]
    assert stamps == [UtcStamp(utc_ns(k) - 127_759) for k in range(4)]


# --------------------------------------------------------------------------- heading


def test_heading_of_a_moving_base() -> None:
    found, decoder = decoded(pvt(), end_of_epoch(), relposned(), pvt(1), relposned(1))
    headings = [m for m in found if isinstance(m, Heading)]
    assert [m.stamp for m in headings] == [UtcStamp(utc_ns(k) - 127_759) for k in (0, 1)]
    assert headings[0].yaw_rad == pytest.approx(math.radians(123.45678))
    assert headings[0].sd_rad == pytest.approx(math.radians(0.2))
    assert decoder.counters["relposned"] == decoder.counters["headings"] == 2
    offset = SolutionDecoding(heading_offset_deg=90.0)
    (heading,) = decoded(relposned(), decoding=offset)[0]
    assert isinstance(heading, Heading)
    assert heading.yaw_rad == pytest.approx(math.radians(213.45678 - 360.0))
    assert heading.stamp == ArrivalStamp()  # nobody has told the time yet


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (0x1 | 0x4 | 2 << 3 | 0x100, "baseline_of_a_station"),
        (0x1 | 0x4 | 2 << 3 | 0x20, "heading_not_valid"),
        (0x4 | 2 << 3 | 0x20 | 0x100, "heading_not_valid"),
        (0x1 | 0x4 | 1 << 3 | 0x20 | 0x100, "heading_not_fixed"),
    ],
)
def test_what_is_no_heading(flags: int, name: str) -> None:
    found, decoder = decoded(relposned(flags=flags))
    assert found == []
    assert decoder.counters[name] == 1


# --------------------------------------------------------------------------- real receivers


def test_walk_is_what_pyubx2_reads_and_what_its_nmea_prints() -> None:
    log = read(WALK)
    found, decoder = decoded(log, decoding=OLD)
    mine = fixes(found)
    theirs = [
        m for _, m in pyubx2.UBXReader(io.BytesIO(log), protfilter=2) if m.identity == "NAV-PVT"
    ]
    nmea = NmeaDecoder("gnss", NmeaDecoding(earliest_date=date(2014, 1, 1)))
    printed = fixes([*nmea.feed(log, 0), *nmea.flush()])
    assert len(mine) == len(theirs) == len(printed) == 536
    assert decoder.counters["ubx_not_used"] == 536 + 2328
    for fix, m, line in zip(mine, theirs, printed, strict=True):
        assert math.degrees(fix.lat_rad) == pytest.approx(m.lat, abs=1e-10)
        assert math.degrees(fix.lon_rad) == pytest.approx(m.lon, abs=1e-10)
        assert fix.height_m == pytest.approx(m.height / 1000.0)
        assert fix.v_ned_m_s == pytest.approx((m.velN / 1e3, m.velE / 1e3, m.velD / 1e3))
        assert fix.quality == {1: 5, 2: 4}[m.carrSoln] == line.quality
        assert fix.satellites == m.numSV
        assert isinstance(line.stamp, UtcStamp)
        assert isinstance(fix.stamp, UtcStamp)
        assert abs(fix.stamp.utc_ns - line.stamp.utc_ns) <= 5_000_000


def test_sigma_is_that_of_gst() -> None:
    """hAcc of a ZED-F9R is the root of the sum of GST's squares, and vAcc GST's third."""
    log = read(MIXED)
    mine = fixes(decoded(log, decoding=OLD)[0])
    nmea = NmeaDecoder("gnss", NmeaDecoding(earliest_date=date(2014, 1, 1)))
    printed = fixes([*nmea.feed(log, 0), *nmea.flush()])
    assert len(mine) == len(printed) == 30
    for fix, line in zip(mine, printed, strict=True):
        assert fix.sd_ned_m is not None
        assert line.sd_ned_m is not None
        assert math.hypot(*fix.sd_ned_m[:2]) == pytest.approx(
            math.hypot(*line.sd_ned_m[:2]), abs=2e-3
        )
        assert fix.sd_ned_m[2] == pytest.approx(line.sd_ned_m[2], abs=2e-3)
        assert fix.height_m == pytest.approx(line.height_m, abs=0.11)  # GGA: decimetres, twice
        assert (fix.quality, fix.hdop) == (line.quality, pytest.approx(line.hdop))


@pytest.mark.parametrize("path", [WALK, MIXED], ids=["walk", "zed_f9r"])
def test_split_at_every_byte_gives_the_same(path: Path) -> None:
    check_split_anywhere(UbxDecoder, read(path)[:30_000], sizes=(1,), decoding=OLD)


# --------------------------------------------------------------------------- hostile bytes

SEEDS = (pvt(), hpposllh(), dop(), cov(), timegps(), timeutc(), posllh(), velned(), status(),
         sol(), posecef(), velecef(), end_of_epoch(), relposned())  # fmt: skip


@given(st.lists(st.sampled_from(SEEDS), max_size=8), st.randoms(use_true_random=False))
@settings(max_examples=300, deadline=None)
def test_mutated_payloads_with_a_good_check_never_raise(
    seeds: list[bytes], rng: random.Random
) -> None:
    decoder = UbxDecoder("gnss", OLD)
    for seed in seeds:
        payload = bytearray(seed[6:-2])
        for _ in range(rng.randrange(4)):
            payload[rng.randrange(len(payload))] = rng.randrange(256)
        for m in decoder.feed(ubx(seed[2:4], bytes(payload)), 0):
            assert m.source == "gnss"
    decoder.flush()
    counters = decoder.counters
    names = ("nav_messages", "nav_unreadable", "late_message", "relposned", "ubx_not_used")
    assert sum(counters[name] for name in names) == counters["ubx_frames"] == len(seeds)
    # Good epochs behind whatever came are read; a date that came before may have been a later one.
    assert fixes([m for k in range(4) for m in decoder.feed(pvt(k) + end_of_epoch(k), 0)])
