"""The BESTPOS family: its CRC, logs of each form, and what they come to."""

from __future__ import annotations

import math
import random
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.bestpos.decoder import TYPES, BestposDecoder
from drivers.bestpos.framing import LogSplitter, log_crc
from drivers.measurements import Heading, Measurement, PositionFix, TimeReport, UtcStamp
from tests.drivers import solutions
from tests.drivers.bestpos.logs import (
    PLACE,
    bestnav,
    bestpos,
    bestvel,
    heading,
    log,
    novatel,
    unicore,
)
from tests.drivers.solutions import UTC_NS, check_refused, check_split_anywhere, fixes

GOLDEN = Path(__file__).with_name("golden.log")
# One of each form, made for this test; each CRC was worked out bit by bit from the polynomial.
MADE = (
    b"#BESTPOSA,USB2,0,47.0,FINESTEERING,2447,180901.000,02000020,3e71,16248;SOL_COMPUTED,"
    b"NARROW_INT,39.96901530170,116.32610482250,46.0125,-9.1000,WGS84,0.0093,0.0071,0.0188,"
    b'"0042",1.200,0.000,29,27,27,24,00,01,3d,15*56df26f2\r\n',
    b"#BESTVELA,COM3,0,64.5,FINESTEERING,2447,180902.000,02000020,77d0,16248;SOL_COMPUTED,"
    b"DOPPLER_VELOCITY,0.200,0.000,3.2150,141.507330,-0.0420,0.0*4a01f73a\r\n",
    b"#HEADING2A,COM3,0,58.0,FINESTEERING,2447,180903.200,02000020,91ac,16248;SOL_COMPUTED,"
    b'NARROW_INT,1.204016380,143.608215440,0.8437250980,0,0.415730025,0.634180017,"RV01","BS07",'
    b"22,20,20,18,0,01,0,15*77b85097\r\n",
    b"#TIMEA,COM3,0,62.0,FINESTEERING,2447,180904.000,02000020,46be,16248;VALID,2.415063510e-09,"
    b"1.130527700e-09,-18.00000000000,2026,12,1,2,14,46000,VALID*1f90952f\r\n",
    b"#UNIHEADINGA,63,GPS,FINE,2447,180905000,0,0,18,9;SOL_COMPUTED,NARROW_INT,1.2038,143.6120,"
    b'0.8450,0.0000,0.4180,0.6350,"7",24,19,19,12,3,01,3,71*8b619465\r\n',
    b"#BESTPOSA,COM1,0,88.0,FINE,2447,180906.000,318204,27,18;SOL_COMPUTED,FIXEDPOS,39.96880012340,"
    b'116.32590045670,44.8700,-9.1000,WGS84,0.0000,0.0000,0.0000,"",0.000,0.000,36,25,25,14,0,02,03,'
    b"11*7f740cf4\r\n",
)


def decoded(*logs: bytes) -> tuple[list[Measurement], BestposDecoder]:
    return solutions.decoded(BestposDecoder, *logs)


def bit_by_bit(data: bytes) -> int:
    """The manuals' 32-bit CRC, without a table."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


@pytest.mark.parametrize("name", ["ADRNAVA", "SPPNAVA", "PPPNAVA"])
def test_unicores_solutions_of_one_kind(name: str) -> None:
    """Laid out as BESTNAV, which serves where both are; PPPNAV ends before the velocity."""
    fields = bestnav().decode().partition(";")[2].partition("*")[0].split(",")
    body = ",".join(fields if name != "PPPNAVA" else fields[:21])
    (fix,) = fixes(decoded(unicore(name, body))[0])
    assert fix.sd_ned_m == (0.014, 0.012, 0.031)
    assert (fix.v_ned_m_s is None) == (name == "PPPNAVA")
    other = unicore(name, body.replace("0.0140,0.0120", "0.9000,0.9000"))
    for both in ((bestnav(), other), (other, bestnav())):
        (fix,) = fixes(decoded(*both)[0])
        assert fix.sd_ned_m == (0.014, 0.012, 0.031)
        assert fix.v_ned_m_s is not None


@given(st.binary(max_size=300))
def test_crc_is_that_of_the_polynomial(data: bytes) -> None:
    assert log_crc(data) == bit_by_bit(data)


def test_one_log_of_each_form() -> None:
    found, decoder = decoded(*MADE)
    assert decoder.counters["logs"] == decoder.counters["logs_used"] == len(MADE)
    assert decoder.counters["crc_bad"] == 0
    (fix,) = fixes(found)
    assert math.degrees(fix.lat_rad) == pytest.approx(39.96901530170, abs=1e-11)
    assert fix.height_m == pytest.approx(46.0125 - 9.1)
    assert fix.sd_ned_m == (0.0093, 0.0071, 0.0188)
    assert decoder.refusal == "manual_refused"
    assert [math.degrees(m.yaw_rad) for m in found if isinstance(m, Heading)] == [
        pytest.approx(143.608215440),
        pytest.approx(143.6120),
    ]


def test_bestpos_and_bestvel_are_one_epoch() -> None:
    time, fix = decoded(bestpos(), bestvel())[0]
    assert time == TimeReport("gnss", 7, UTC_NS, False)
    east = 5.0 * math.sin(math.radians(120.0))
    assert fix == PositionFix(
        "gnss", 7, UtcStamp(UTC_NS), math.radians(39.9687242), math.radians(116.3257202),
        pytest.approx(36.2), 4, 31, None, None, (0.014, 0.012, 0.031),
        pytest.approx((-2.5, east, -0.1)), None,
    )  # fmt: skip
    assert len(fixes(decoded(bestvel(), bestpos())[0])) == 1
    assert decoded(bestpos(), bestvel(latency="0.150"))[1].counters["velocity_latent"] == 1


@pytest.mark.parametrize("base", ["GPS", "BDS"])
def test_bestnav_has_all(base: str) -> None:
    (fix,) = fixes(decoded(bestnav(base=base))[0])
    assert fix.stamp == UtcStamp(UTC_NS)
    assert fix.sd_v_ned_m_s == (0.02, 0.02, 0.03)
    assert fix.v_ned_m_s is not None
    assert fix.satellites == 28
    short = "INSUFFICIENT_OBS,NONE,0.000,0.000,0.0000,0.000000,0.0000,0.0,0.0"
    (still,) = fixes(decoded(bestnav(velocity=short))[0])
    assert still.v_ned_m_s is None


def test_leap_seconds_of_header_time_log_and_date() -> None:
    (fix,) = fixes(decoded(bestnav(leap=19))[0])
    assert fix.stamp == UtcStamp(UTC_NS - 1_000_000_000)
    (fix,) = fixes(decoded(bestnav(leap=99))[0])  # implausible: that of the date
    assert fix.stamp == UtcStamp(UTC_NS)
    time = novatel("TIMEA", "VALID,0.0,0.0,-19.00000000000,2026,12,1,2,14,28000,VALID")
    (fix,) = fixes(decoded(time, bestpos())[0])
    assert fix.stamp == UtcStamp(UTC_NS - 1_000_000_000)


@pytest.mark.parametrize(
    ("first", "second", "quality"),
    [
        (bestpos(name="PSRPOSA", kind="SINGLE"), bestpos(), 4),
        (bestpos(), bestpos(name="PSRPOSA", kind="SINGLE"), 4),
        (bestpos(kind="INS_RTKFIXED"), bestpos(name="BESTGNSSPOSA", kind="NARROW_FLOAT"), 5),
        (bestpos(kind="INS_RTKFIXED"), bestpos(name="PSRPOSA", kind="SINGLE"), 1),
    ],
)
def test_best_of_an_epoch(first: bytes, second: bytes, quality: int) -> None:
    (fix,) = fixes(decoded(first, second)[0])
    assert fix.quality == quality


@pytest.mark.parametrize(
    ("each", "name"),
    [
        (bestpos(status="INSUFFICIENT_OBS", kind="NONE"), "no_fix"),
        (bestpos(status="COLD_START"), "no_fix"),
        (bestpos(kind="NONE"), "no_fix"),
        (bestpos(kind="FIXEDPOS"), "manual_refused"),
        (bestpos(kind="PROPAGATED"), "dead_reckoning_refused"),
        (bestpos(kind="INS_PSRSP"), "inertial_refused"),
        (bestpos(kind="INSPVA"), "inertial_refused"),
        (bestpos(kind="TELEPATHY"), "no_fix"),
        (bestpos(place=PLACE.replace("WGS84", "NAD27")), "datum_refused"),
        (bestpos(clock="UNKNOWN"), "untimed_epoch"),
        (bestpos(place=PLACE.replace("39.9", "99.9")), "position_implausible"),
        (bestpos(place=PLACE.replace("45.3000", "450000.0")), "height_implausible"),
        (bestpos(place=PLACE.replace("0.0140", "999999.0")), "sigma_too_large"),
        (bestpos() + bestvel() + bestpos(), "duplicate_epoch"),
    ],
)
def test_refused_by_name(each: bytes, name: str) -> None:
    check_refused(BestposDecoder, each, name)


@pytest.mark.parametrize(
    ("each", "name"),
    [
        (bestpos().replace(b"NARROW", b"NARROX"), "crc_bad"),
        (bestpos()[:80] + bestpos(1), "log_cut"),
        (b"#" + b"A" * 3000 + bestpos(1), "log_too_long"),
        (log("BESTPOSA,COM1,0", "SOL_COMPUTED"), "header_bad"),
        (log("BESTPOSA,COM1,0,83.5,FINESTEERING,week,1.0,0,0,0", "SOL_COMPUTED"), "header_bad"),
        (novatel("BESTPOSA", "SOL_COMPUTED,SINGLE,1.0"), "bad_field"),
        (bestpos(place=PLACE.replace("45.3000", "4x")), "bad_field"),
        (bestpos(place=PLACE.replace("45.3000", "nan")), "bad_field"),
        (bestpos(place=PLACE.replace("45.3000", "1_0")), "bad_field"),
        (novatel("RANGEA", "1,2"), "logs_not_used"),
        (heading(kind="NARROW_FLOAT"), "heading_not_fixed"),
        (unicore("UNIHEADINGA", "INSUFFICIENT_OBS,NONE,0,0,0,0,0,0"), "heading_not_valid"),
    ],
)
def test_counted_by_name_and_the_next_one_is_read(each: bytes, name: str) -> None:
    found, decoder = decoded(each, bestpos(2), bestpos(3))
    assert decoder.counters[name] == 1
    assert {m.stamp for m in fixes(found)} >= {
        UtcStamp(UTC_NS + 2_000_000_000),
        UtcStamp(UTC_NS + 3_000_000_000),
    }


def test_types_are_those_of_nmea() -> None:
    qualities = {quality for quality in TYPES.values() if isinstance(quality, int)}
    assert qualities == {1, 2, 4, 5}
    for kind, quality in TYPES.items():
        if isinstance(quality, int):
            (fix,) = fixes(decoded(bestpos(kind=kind))[0])
            assert fix.quality == quality
            assert (fix.height_m is None) == (kind == "FIXEDHEIGHT")


def test_the_last_log_of_an_epoch_is_learned() -> None:
    decoder = BestposDecoder("gnss")
    counts = [len(fixes(decoder.feed(bestpos(k) + bestvel(k), 0))) for k in range(5)]
    assert counts == [0, 1, 2, 1, 1]


def test_golden_log() -> None:
    """Ten seconds of a UM982 with two antennas and of an OEM7, with NMEA, answers and damage."""
    found, decoder = decoded(GOLDEN.read_bytes())
    assert {name: n for name, n in decoder.counters.items() if n} == {
        "logs": 28,
        "logs_used": 27,
        "logs_not_used": 1,
        "epochs": 14,
        "fixes": 13,
        "headings": 8,
        "heading_not_fixed": 1,
        "no_fix": 1,
        "crc_bad": 1,
        "log_cut": 1,
        "other_bytes": decoder.counters["other_bytes"],
    }
    made = fixes(found)
    assert [m.quality for m in made] == [1, 5, 5, 4, 4, 4, 4, 4, 4, 2, 2, 2, 2]
    assert all(m.v_ned_m_s is not None for m in made)
    seconds = [(m.stamp.utc_ns - UTC_NS) * 1e-9 for m in made if isinstance(m.stamp, UtcStamp)]
    assert seconds == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 20.0, 21.0, 22.0, 23.0]


def test_split_anywhere_gives_the_same() -> None:
    check_split_anywhere(BestposDecoder, GOLDEN.read_bytes())


SEEDS = (bestpos(), bestvel(), bestnav(), heading(), *MADE)


def mended(each: bytes) -> bytes:
    text = each[1:].rpartition(b"*")[0]
    return b"#%b*%08x\r\n" % (text, log_crc(text))


@given(st.lists(st.sampled_from(SEEDS), max_size=6), st.randoms(use_true_random=False))
@settings(max_examples=300, deadline=None)
def test_mutated_logs_with_a_good_crc_never_raise(seeds: list[bytes], rng: random.Random) -> None:
    decoder = BestposDecoder("gnss")
    for seed in seeds:
        changed = bytearray(seed)
        for _ in range(rng.randrange(4)):
            changed[rng.randrange(1, len(seed) - 11)] = rng.randrange(256)
        for m in decoder.feed(mended(bytes(changed)), 0):
            assert m.source == "gnss"
    decoder.flush()
    assert decoder.counters["other_bytes"] >= 0
    later = [m for k in range(4) for m in decoder.feed(bestpos(k) + bestvel(k), 0)]
    assert fixes(later + decoder.flush())


@given(st.binary(max_size=400), st.integers(1, 50))
def test_every_byte_is_accounted_for(stream: bytes, size: int) -> None:
    counters = Counter[str]()
    splitter = LogSplitter(counters)
    for k in range(0, len(stream), size):
        assert splitter.feed(stream[k : k + size]) == []
    splitter.finish()
    assert counters["other_bytes"] == len(stream)
    assert splitter.waiting == 0


def test_body_below_the_sigmas_may_be_cut() -> None:
    (fix,) = fixes(decoded(novatel("BESTPOSA", f"SOL_COMPUTED,SINGLE,{PLACE}"))[0])
    assert fix.satellites is None
