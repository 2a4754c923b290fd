"""SBF: epochs out of blocks made bit by bit, of which another program has read the golden ones."""

from __future__ import annotations

import math
import random
from collections import Counter
from datetime import date
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.decoder_options import SolutionDecoding
from drivers.measurements import Heading, Measurement, PositionFix, TimeReport, UtcStamp
from drivers.sbf.decoder import SbfDecoder
from drivers.sbf.framing import BlockSplitter
from tests.drivers import solutions
from tests.drivers.sbf.blocks import (
    NO_NUMBER,
    attitude,
    attitude_covariance,
    block,
    covariance,
    dop,
    end_of_pvt,
    pvt,
    receiver_time,
)
from tests.drivers.solutions import UTC_NS, check_refused, check_split_anywhere, fixes

OLD = SolutionDecoding(earliest_date=date(2010, 1, 1))
GOLDEN = Path(__file__).with_name("golden.sbf")


def decoded(*blocks: bytes) -> tuple[list[Measurement], SbfDecoder]:
    return solutions.decoded(SbfDecoder, *blocks)


def test_pvt_alone() -> None:
    time, fix = decoded(pvt())[0]
    assert time == TimeReport("gnss", 7, UTC_NS, False)
    level = 0.02 / math.sqrt(2.0)
    assert fix == PositionFix(
        "gnss", 7, UtcStamp(UTC_NS), math.radians(39.9687242), math.radians(116.3257202), 36.2, 4,
        31, None, None, pytest.approx((level, level, 0.025)),
        pytest.approx((1.0, -2.0, 0.03)), None,
    )  # fmt: skip
    (bare,) = fixes(decoded(pvt(revision=0))[0])
    assert bare.sd_ned_m is None


def test_covariances_stand_for_accuracies() -> None:
    blocks = (pvt(), covariance(5906), covariance(5908, scale=2.0), dop(), end_of_pvt())
    for order in (blocks, (*blocks[3::-1], blocks[4])):
        (fix,) = fixes(decoded(*order)[0])
        assert fix.sd_ned_m == pytest.approx((0.01, 0.02, 0.03))
        assert fix.sd_v_ned_m_s == pytest.approx((0.02, 0.04, 0.06))
        assert (fix.hdop, fix.vdop) == (0.77, 0.99)
    (fix,) = fixes(decoded(pvt(), covariance(5906, error=3))[0])
    assert fix.sd_ned_m == pytest.approx((0.02 / math.sqrt(2.0),) * 2 + (0.025,))


@pytest.mark.parametrize(("mode", "quality"), [(1, 1), (2, 2), (4, 4), (5, 5), (6, 2), (10, 2)])
def test_quality(mode: int, quality: int) -> None:
    (fix,) = fixes(decoded(pvt(mode=mode))[0])
    assert fix.quality == quality


def test_what_is_not_given() -> None:
    (plane,) = fixes(decoded(pvt(mode=4 | 0x80))[0])
    assert plane.height_m is None
    assert plane.v_ned_m_s == (1.0, -2.0, None)
    (still,) = fixes(decoded(pvt(v=(NO_NUMBER,) * 3, satellites=255, h_acc=65535))[0])
    assert (still.v_ned_m_s, still.satellites, still.sd_ned_m) == (None, None, None)
    (unknown,) = fixes(decoded(pvt(height=NO_NUMBER))[0])
    assert unknown.height_m is None


@pytest.mark.parametrize(
    ("each", "name"),
    [
        (pvt(mode=0), "no_fix"),
        (pvt(error=2), "no_fix"),
        (pvt(lat=NO_NUMBER, lon=NO_NUMBER), "no_fix"),
        (pvt(mode=15), "no_fix"),
        (pvt(mode=3), "manual_refused"),
        (pvt(datum=250), "datum_refused"),
        (pvt(when=(0xFFFFFFFF, 2447)), "untimed_epoch"),
        (pvt(when=(1000, 0xFFFF)), "untimed_epoch"),
        (pvt(height=math.nan), "height_implausible"),
        (pvt(lat=2.0), "position_implausible"),
        (pvt(v=(3000.0, 0.0, 0.0)), "speed_implausible"),
        (pvt() + end_of_pvt() + pvt(), "duplicate_epoch"),
    ],
)
def test_refused_by_name(each: bytes, name: str) -> None:
    check_refused(SbfDecoder, each, name)


def test_leap_seconds() -> None:
    (fix,) = fixes(decoded(receiver_time(leap=19), pvt())[0])
    assert fix.stamp == UtcStamp(UTC_NS - 1_000_000_000)
    (fix,) = fixes(decoded(receiver_time(leap=-128), pvt())[0])
    assert fix.stamp == UtcStamp(UTC_NS)


def test_heading_of_two_antennas() -> None:
    found, decoder = decoded(attitude(), attitude_covariance(), attitude(1), attitude(2))
    headings = [m for m in found if isinstance(m, Heading)]
    assert [m.yaw_rad for m in headings] == pytest.approx([math.radians(123.5)] * 3)
    assert [m.sd_rad for m in headings] == [pytest.approx(math.radians(0.2)), None, None]
    assert headings[2].stamp == UtcStamp(UTC_NS + 2_000_000_000)
    _, decoder = decoded(attitude(mode=0), attitude(error=1), attitude(mode=1), attitude(mode=3))
    assert decoder.counters["heading_not_valid"] == decoder.counters["heading_not_fixed"] == 2


@pytest.mark.parametrize(
    ("each", "name"),
    [
        (pvt()[:-1] + b"\x55", "sbf_damaged"),
        (pvt()[:40] + pvt(1), "sbf_damaged"),
        (block(4007, b"\x00" * 40), "blocks_unreadable"),
        (block(4027, b"\x00" * 40), "blocks_not_used"),
    ],
)
def test_counted_by_name_and_the_next_one_is_read(each: bytes, name: str) -> None:
    found, decoder = decoded(each, pvt(2), pvt(3))
    assert decoder.counters[name] == 1
    stamps = {m.stamp for m in fixes(found)}
    assert stamps >= {UtcStamp(UTC_NS + k * 1_000_000_000) for k in (2, 3)}


def test_golden_log() -> None:
    """Ten seconds of a mosaic-H with NMEA between, a lost fix and a damaged block. pysbf2 1.0.7
    reads the same blocks of it: numbers, times, places and modes."""
    found, decoder = decoded(GOLDEN.read_bytes())
    assert {name: n for name, n in decoder.counters.items() if n} == {
        "sbf_blocks": 68,
        "blocks_used": 58,
        "blocks_not_used": 10,
        "sbf_damaged": 1,
        "epochs": 9,
        "fixes": 8,
        "no_fix": 1,
        "headings": 9,
        "heading_not_fixed": 1,
        "other_bytes": decoder.counters["other_bytes"],
    }
    assert [m.quality for m in fixes(found)] == [1, 2, 5, 4, 4, 4, 4, 4]
    seconds = [
        (m.stamp.utc_ns - UTC_NS) * 1e-9 for m in fixes(found) if isinstance(m.stamp, UtcStamp)
    ]
    assert seconds == [1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 8.0, 9.0]


def test_split_anywhere_gives_the_same() -> None:
    check_split_anywhere(SbfDecoder, GOLDEN.read_bytes())


SEEDS = (pvt(), covariance(5906), covariance(5908), dop(), receiver_time(), end_of_pvt(),
         attitude(), attitude_covariance())  # fmt: skip


@given(st.lists(st.sampled_from(SEEDS), max_size=8), st.randoms(use_true_random=False))
@settings(max_examples=300, deadline=None)
def test_mutated_blocks_with_a_good_crc_never_raise(seeds: list[bytes], rng: random.Random) -> None:
    decoder = SbfDecoder("gnss", OLD)
    for seed in seeds:
        body = bytearray(seed[8:])
        for _ in range(rng.randrange(4)):
            body[rng.randrange(len(body))] = rng.randrange(256)
        number = int.from_bytes(seed[4:6], "little")
        for m in decoder.feed(block(number & 0x1FFF, bytes(body), number >> 13), 0):
            assert m.source == "gnss"
    decoder.flush()
    names = ("blocks_used", "blocks_not_used", "blocks_unreadable", "late_message")
    assert sum(decoder.counters[name] for name in names) == len(seeds)
    later = [m for k in range(4) for m in decoder.feed(pvt(k) + end_of_pvt(k), 0)]
    assert fixes(later)


@given(st.binary(max_size=400), st.integers(1, 50))
def test_every_byte_is_accounted_for(stream: bytes, size: int) -> None:
    counters = Counter[str]()
    splitter = BlockSplitter(counters)
    blocks = []
    for k in range(0, len(stream), size):
        blocks += splitter.feed(stream[k : k + size])
    blocks += splitter.finish()
    assert counters["other_bytes"] == len(stream) - sum(8 + len(b.body) for b in blocks)
    assert splitter.waiting == 0
