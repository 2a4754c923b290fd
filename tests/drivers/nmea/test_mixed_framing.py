"""NMEA sentences out of mixed bytes: what passes, what is refused and why, resynchronising."""

from __future__ import annotations

import itertools
from collections import Counter
from functools import reduce
from operator import xor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.nmea.incremental_checksum import LONGEST_RTCM, RunningCrc24q, RunningFletcher, crc24q
from drivers.nmea.mixed_framing import (
    MAX_SENTENCE,
    MAX_UBX_PAYLOAD,
    NmeaSplitter,
    Sentence,
    StreamSplitter,
    is_rdss_sentence,
)
from tests.drivers.raw import frames
from tests.drivers.raw.frames import rtcm


def nmea(body: str) -> bytes:
    return b"$%s*%02X\r\n" % (body.encode(), reduce(xor, body.encode(), 0))


def ubx(payload: bytes, class_id: bytes = b"\x01\x07") -> bytes:
    return frames.ubx(class_id, payload)


GGA = b"$GNGGA,021429.00,3958.12345,N,11619.54321,E,4,18,0.62,45.300,M,-9.100,M,1.0,0000*47\r\n"
HDT = b"$GNHDT,350.00,T*1D\r\n"
DOLLARS = b"$GP$GNGGA,0\xb5\x62\xd3\x00$"
MSM_1127 = (1127 << 4).to_bytes(2, "big")


def split(*pieces: bytes) -> tuple[list[bytes], Counter[str]]:
    splitter = NmeaSplitter()
    found = [sentence for piece in pieces for sentence in splitter.feed(piece)]
    found += splitter.finish()
    return [sentence.raw for sentence in found], splitter.counters


def test_fields_and_names() -> None:
    (sentence,) = NmeaSplitter().feed(HDT)
    assert sentence == Sentence("GNHDT", ("350.00", "T"), HDT.rstrip())
    assert (sentence.talker, sentence.formatter) == ("GN", "HDT")
    (own,) = NmeaSplitter().feed(nmea("PUBX,00,1"))
    assert (own.talker, own.formatter) == ("P", "UBX")


def test_crc24q_check_value() -> None:
    # The check value of CRC-24/LTE-A, the same polynomial 864CFB with initial value 0.
    assert crc24q(b"123456789") == 0xCDE703
    # RTCM 10403.3 appendix: the first bytes of a 1005 message, whole frame.
    frame = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")
    assert crc24q(frame) == 0


def test_binary_frames_are_skipped_whole() -> None:
    stream = HDT + ubx(DOLLARS * 9) + GGA + rtcm(MSM_1127 + DOLLARS * 20) + HDT + ubx(b"")
    sentences, counters = split(stream)
    assert sentences == [HDT.rstrip(), GGA.rstrip(), HDT.rstrip()]
    assert counters == Counter(
        {"sentences": 3, "ubx_frames": 2, "rtcm_frames": 1, "garbage_bytes": 0}
    )


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        (GGA.replace(b"39", b"38", 1), "checksum_bad"),
        (HDT.replace(b"*1D", b"*1Z"), "checksum_bad"),
        (HDT.replace(b"*1D", b"* D"), "checksum_bad"),
        (HDT.replace(b"*1D", b""), "checksum_missing"),
        (b"$GNGGA,021429.00,3958.1\n", "checksum_missing"),
        (b"$GNGGA,021429.00,3958.1", "inner_dollar"),
        (b"$GNRMC,0214\x0029.00*00\r\n", "not_text"),
        (nmea("GNTXT," + "x" * MAX_SENTENCE), "sentence_too_long"),
        (nmea("gnhdt,350.00,T"), "address_bad"),
        (nmea("GN,1"), "address_bad"),
        (ubx(b"abc")[:-1] + b"\xff", "ubx_damaged"),
        (rtcm(MSM_1127 + b"abc")[:-1] + b"\xff", "rtcm_damaged"),
    ],
)
def test_refused_by_name_and_the_next_good_sentence_passes(bad: bytes, name: str) -> None:
    sentences, counters = split(bad + HDT)
    assert sentences == [HDT.rstrip()]
    assert counters[name] == 1
    assert counters["garbage_bytes"] > 0


def test_longest_sentence_that_passes() -> None:
    body = "GNTXT," + "x" * (MAX_SENTENCE - 10)
    assert len(nmea(body).rstrip()) == MAX_SENTENCE
    assert split(nmea(body))[0] == [nmea(body).rstrip()]
    assert split(nmea(body + "x"))[1]["sentence_too_long"] == 1


@pytest.mark.parametrize(
    "head",
    [
        b"\xb5\x62\x02\x15\x00\x20",  # a UBX header of 8192 bytes that never come
        b"\xb5\x62\x02\x15\x01\x20",  # and one that no receiver sends
        b"\xd3\x03\xff\x46\x70",  # an RTCM 3 header of 1023 bytes
        b"\xb5",
        b"\xd3",
        b"\xd3\x00",
    ],
)
def test_one_good_sentence_proves_a_binary_header_false(head: bytes) -> None:
    """No time-out and no length to wait for: the very next sentence comes out."""
    splitter = NmeaSplitter()
    assert [s.raw for s in splitter.feed(head + HDT)] == [HDT.rstrip()]


def test_endless_streams_stay_bounded() -> None:
    for endless in (b"$" * 100_000, b"$A" * 50_000, b"x" * 100_000, b"$" + b"A" * 100_000):
        splitter = NmeaSplitter()
        for start in range(0, len(endless), 1000):
            splitter.feed(endless[start : start + 1000])
            assert splitter.waiting <= MAX_SENTENCE
    splitter = NmeaSplitter()
    for _ in range(40):
        splitter.feed(b"\xb5\x62\x02\x15\x00\x20" * 200)
        assert splitter.waiting <= MAX_UBX_PAYLOAD + 8
    assert [s.raw for s in splitter.feed(HDT)] == [HDT.rstrip()]


@pytest.mark.parametrize(
    "head",
    [
        b"\xb5\x62\x02\x15\x00\x20",  # UBX, 8192 bytes to come
        b"\xb5\x62\x01\x07\x20\x00",  # 32 bytes
        b"\xd3\x03\xff\x46\x70",  # RTCM 3, 1023 bytes
        b"\xd3\x00\x13\x3e\xd0",
        b"\xb5\x62\x02\x15\x00\x20\xd3\x03\xff\x46\x70",
    ],
)
@pytest.mark.parametrize("piece", [1, 7, 100_000])
def test_false_headers_cost_a_byte_thrice_at_most(head: bytes, piece: int) -> None:
    """However many headers claim a byte, the sums take it in twice, the CRC once."""
    splitter = StreamSplitter()
    stream = head * (60_000 // len(head))
    for start in range(0, len(stream), piece):
        splitter.feed(stream[start : start + piece])
    splitter.finish()
    assert splitter.summed <= 3 * len(stream)
    assert splitter.counters["garbage_bytes"] == len(stream)


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), min_size=2, max_size=12))
@settings(max_examples=100, deadline=None)
def test_running_checks_say_what_the_whole_check_says(data: bytes, ends: list[int]) -> None:
    """Of any stretch, in any order, with bytes leaving in front."""
    sums, remainders = RunningFletcher(), RunningCrc24q()
    buffer = bytearray(data)
    for a, b in itertools.pairwise(ends):
        start, end = sorted((min(a, len(buffer)), min(b, len(buffer))))
        stretch = bytes(buffer[start:end])
        assert remainders.holds(buffer, start, end) is (crc24q(stretch) == 0)
        if len(stretch) >= 2:
            good = ubx(stretch[4:-2], stretch[:2])[2:] if len(stretch) >= 6 else b""
            first = second = 0
            for byte in stretch[:-2]:
                first = (first + byte) % 256
                second = (second + first) % 256
            assert sums.holds(buffer, start, end) is (stretch[-2:] == bytes([first, second]))
            assert not good or RunningFletcher().holds(bytearray(good), 0, len(good))
        gone = start // 2
        del buffer[:gone]
        sums.drop(gone)
        remainders.drop(gone)


def test_longest_rtcm_frame_passes() -> None:
    frame = rtcm(MSM_1127 + bytes(1021))
    assert len(frame) == LONGEST_RTCM
    splitter = StreamSplitter()
    assert [item.raw for item in splitter.feed(b"\xd3\x00" + frame)] == [frame]


def test_a_cut_frame_at_the_end_gives_up_what_is_inside() -> None:
    # The header claims more than comes, and the sentence inside lacks its line end.
    sentences, counters = split(b"\xd3\x00\x40\x46\x70" + b"\xb5\x62\x01\x07\x05\x00abcde")
    assert sentences == []
    assert counters["garbage_bytes"] == 16


PIECES = st.sampled_from(
    [
        GGA,
        HDT,
        nmea("BDZDA,3,000329.00,01,01,2006,-08,00,00,00,00,N"),
        ubx(DOLLARS),
        ubx(b"\xd3\x00\x13" * 30),
        ubx(HDT),
        rtcm(MSM_1127 + b"\xb5\x62\x01\x07\x20\x00" * 8),
        rtcm(MSM_1127 + GGA),
        GGA[:30],
        HDT[:-3],
        b"\xb5\x62\x01\x07\x40\x00",
        b"\xd3\x00\x30\x46\x70",
        b"\r\n",
        b"$",
    ]
)
STREAMS = st.lists(PIECES | st.binary(max_size=40), max_size=14).map(b"".join)


@given(STREAMS)
@settings(max_examples=150)
def test_split_at_every_byte_gives_the_same(stream: bytes) -> None:
    whole = split(stream)
    assert split(*(stream[i : i + 1] for i in range(len(stream)))) == whole


@given(STREAMS, st.lists(st.integers(0, 600), max_size=6))
@settings(max_examples=150)
def test_any_split_gives_the_same(stream: bytes, cuts: list[int]) -> None:
    edges = [0, *sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    pieces = [stream[a:b] for a, b in itertools.pairwise(edges)]
    assert split(*pieces) == split(stream)


@given(st.binary(max_size=300))
@settings(max_examples=200)
def test_resynchronises_within_one_good_sentence(garbage: bytes) -> None:
    splitter = NmeaSplitter()
    splitter.feed(garbage)
    came = [s.raw for s in splitter.feed(b"\r\n" + GGA)]
    assert came[-1:] == [GGA.rstrip()]


@pytest.mark.parametrize(
    ("body", "rdss"),
    [
        ("BDDWR,1,0242407,084936.50,2302.2434,N,11323.6667,E,14,M,-6,M,1,V,V,L", True),
        ("BDFKI,DWA,N,Y,0,0058", True),
        ("BDBSI,02,08,0,3,0,0,0,0,0,3,0,0", True),
        ("BDICI,0000000,00000000,0000000,0,0,0,N,0", True),
        ("CCDWA,0000000,V,1,L,,0,,,0", True),
        ("BDZDA,3,000329.00,01,01,2006,-08,00,00,00,00,N", True),
        ("BDZDA,021429.00,19,06,2025,00,00", False),
        ("BDZDA,,,,,,", False),
        ("BDGGA,021429.00,,,,,0,00,99.99,,,,,,", False),
        ("BDGSV,1,1,00,1", False),
        ("GNZDA,021429.00,19,06,2025,00,00", False),
    ],
)
def test_rdss_text_is_told_apart(body: str, rdss: bool) -> None:
    (sentence,) = NmeaSplitter().feed(nmea(body))
    assert is_rdss_sentence(sentence) is rdss
