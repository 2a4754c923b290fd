"""Broadcast subframes: every field against RTKLIB over random bits, and what is refused."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from datetime import date
from typing import Any

import pytest

from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Ephemeris, Klobuchar, RawEvent
from tests.drivers.raw.frames import (
    beidou_header,
    beidou_words,
    d1,
    d2,
    differences,
    inav,
    inav_words,
    lnav,
    lnav_words,
    put,
    sfrbx,
)

RUNS = 40


@pytest.fixture
def rtklib() -> Any:
    """The oracle, for x86-64 only."""
    return pytest.importorskip("pyrtklib")


def _octets(rtklib: Any, *words: tuple[int, int]) -> Any:
    """Bit strings (value, length) end to end in RTKLIB's array of bytes."""
    value = total = 0
    for word, length in words:
        value, total = value << length | word, total + length
    value, total = value << -total % 8, total + -total % 8
    array = getattr(rtklib, "Arr1Dunsigned char")(total // 8 + 8)
    for i, byte in enumerate(value.to_bytes(total // 8, "big")):
        array[i] = byte
    return array


def _unused(rtklib: Any) -> tuple[Any, Any]:
    """Where the oracle puts ionosphere and UTC."""
    return rtklib.Arr1Ddouble(8), rtklib.Arr1Ddouble(8)


def decode(
    gnss: int, prn: int, sig: int, frames: list[list[int]], decoder: RawDecoder | None = None
) -> list[RawEvent]:
    decoder = decoder or RawDecoder("gnss")
    return decoder.feed(b"".join(sfrbx(gnss, prn, sig, words) for words in frames), 5)


def only(events: list[RawEvent]) -> Ephemeris:
    (found,) = [e for e in events if isinstance(e, Ephemeris)]
    return found


@pytest.mark.parametrize("seed", range(RUNS))
def test_gps_lnav_field_by_field(rtklib: Any, seed: int) -> None:
    frames = lnav(seed)
    ours = only(decode(0, 7, 0, frames))
    eph = rtklib.eph_t()
    buffer = _octets(
        rtklib, *((w >> 6 & 0xFFFFFF, 24) for frame in frames for w in frame), (0, 480)
    )
    rtklib.decode_frame(buffer, eph, rtklib.alm_t(), *_unused(rtklib))
    assert eph.toes > 0.0  # 1 is returned only with an almanac; the orbit is filled in or not
    assert differences(ours, eph) == {}
    assert (ours.week, ours.issue) == (2450, eph.iode)
    assert ours.toc_s == (frames[0][7] >> 6 & 0xFFFF) * 16.0
    alert = frames[2][1] >> 12 & 1  # HOW bit 18
    assert ours.healthy == (eph.svh == 0 and not alert)
    assert (ours.satellite, ours.message, ours.source, ours.t_seen_ns) == ("G07", "lnav", "gnss", 5)


@pytest.mark.parametrize("seed", range(RUNS))
def test_beidou_d1_field_by_field(rtklib: Any, seed: int) -> None:
    frames = d1(seed)
    events = decode(3, 21, 4, frames)
    ours, ionosphere = only(events), events[0]
    eph, (ion, utc) = rtklib.eph_t(), _unused(rtklib)
    buffer = _array(rtklib, b"".join(_pack30(frame) for frame in frames))
    rtklib.decode_bds_d1(buffer, eph, ion, utc)
    assert eph.toes > 0.0
    assert differences(ours, eph) == {}
    assert (ours.week, ours.toc_s, ours.healthy) == (1094, ours.toe_s, eph.svh == 0)
    assert isinstance(ionosphere, Klobuchar)
    assert ionosphere.system == "C"
    assert list(ionosphere.alpha + ionosphere.beta) == [ion[i] for i in range(8)]


@pytest.mark.parametrize("seed", range(RUNS))
def test_beidou_d2_field_by_field(rtklib: Any, seed: int) -> None:
    """No recording has a geostationary satellite: random pages, decoded by both."""
    pages = d2(seed)
    events = decode(3, 59, 10, pages)
    ours = only(events)
    eph = rtklib.eph_t()
    buffer = _array(rtklib, b"".join(_pack30(page) for page in pages))
    rtklib.decode_bds_d2(buffer, eph, _unused(rtklib)[0])
    assert eph.toes > 0.0
    assert differences(ours, eph) == {}
    assert (ours.week, ours.toc_s, ours.healthy) == (1094, ours.toe_s, eph.svh == 0)
    assert (ours.satellite, ours.message) == ("C59", "d2")
    assert isinstance(events[0], Klobuchar)


@pytest.mark.parametrize("seed", range(RUNS))
def test_galileo_inav_field_by_field(rtklib: Any, seed: int) -> None:
    pages = inav(seed)
    ours = only(decode(2, 7, 1, pages))
    data = {kind: _inav_data(page) for kind, page in zip((2, 4, 1, 3, 5), pages, strict=True)}
    # RTKLIB wants word types 0 to 6, and of type 0 and 6 only that they are those.
    data |= {0: 0, 6: 6 << 122}
    data[0] = put(0, 128, 6, 2, 2)
    eph = rtklib.eph_t()
    buffer = _octets(rtklib, *((data[kind], 128) for kind in range(7)))
    rtklib.decode_gal_inav(buffer, eph, *_unused(rtklib))
    assert eph.toes > 0.0
    assert differences(ours, eph) == {}
    assert (ours.week, ours.issue) == (2450, eph.iode)
    # RTKLIB: E5b health and validity in bits 7 to 6 and 8, those of E1-B in bits 1 to 2 and 0.
    assert ours.healthy == (eph.svh & 7 == 0)
    assert ours.toc_s == ours.toe_s


def _pack30(words: list[int]) -> bytes:
    """300 bits in 38 bytes."""
    value = 0
    for word in words:
        value = value << 30 | word & 0x3FFFFFFF
    return (value << 4).to_bytes(38, "big")


def _array(rtklib: Any, data: bytes) -> Any:
    array = getattr(rtklib, "Arr1Dunsigned char")(len(data) + 8)
    for i, byte in enumerate(data):
        array[i] = byte
    return array


def _inav_data(words: list[int]) -> int:
    """The 128 data bits, as RTKLIB takes them out of the page."""
    page = 0
    for word in words:
        page = page << 32 | word
    return (page >> 142 & ((1 << 112) - 1)) << 16 | page >> 110 & 0xFFFF


# --------------------------------------------------------------------------- one issue only

Make = Callable[..., list[list[int]]]
MESSAGES: list[tuple[Make, int, int, int]] = [(lnav, 0, 7, 0), (inav, 2, 7, 1)]


@pytest.mark.parametrize(("make", "gnss", "prn", "sig"), MESSAGES)
def test_two_issues_never_mix(make: Make, gnss: int, prn: int, sig: int) -> None:
    old, new = make(1, issue=77), make(2, issue=78)
    # Galileo's last word names no issue: it belongs to the words that came before it.
    for cut in range(1, len(old) - (make is inav)):
        decoder = RawDecoder("gnss")
        assert decode(gnss, prn, sig, old[:cut] + new[cut:], decoder) == []
        assert decoder.counters["ephemeris_mixed"] == 1
        again = only(decode(gnss, prn, sig, new, decoder))
        assert again == only(decode(gnss, prn, sig, new))


def test_galileo_word_5_of_the_issue_before_is_not_taken() -> None:
    old, new = inav(1, issue=77), inav(2, issue=78)
    events = decode(2, 7, 1, old[4:] + new)
    assert only(events) == only(decode(2, 7, 1, new))


@pytest.mark.parametrize(("make", "prn", "sig"), [(d1, 21, 4), (d2, 1, 1)])
def test_beidou_frames_never_mix(make: Make, prn: int, sig: int) -> None:
    step = 30
    first, second = make(1), make(2, sow=345_600 + step)
    for cut in range(1, len(first)):
        found = decode(3, prn, sig, first[:cut] + second[cut:])
        assert [e for e in found if isinstance(e, Ephemeris)] == []
    # A change of toe inside a frame: toc came with the old one.
    last = make(2, toe=43_650)
    late = 2 if make is d1 else 6
    decoder = RawDecoder("gnss")
    found = decode(3, prn, sig, first[:late] + last[late:], decoder)
    assert [e for e in found if isinstance(e, Ephemeris)] == []
    assert decoder.counters["ephemeris_mixed"] == 1


def test_any_order_of_two_satellites() -> None:
    """Subframes of two satellites interleaved: each gets its own."""
    mine, other = lnav(1), lnav(2)
    decoder = RawDecoder("gnss")
    found: list[RawEvent] = []
    for a, b in zip(mine, other, strict=True):
        found += decode(0, 7, 0, [a], decoder) + decode(0, 8, 0, [b], decoder)
    assert [e.satellite for e in found if isinstance(e, Ephemeris)] == ["G07", "G08"]
    assert found[0] == only(decode(0, 7, 0, mine))


# --------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("frames", "gnss", "prn", "sig", "used"),
    [(lnav(3), 0, 7, 0, 10), (d1(3), 3, 21, 4, 10), (d2(3), 3, 1, 3, 5)],
    ids=["lnav", "d1", "d2"],
)
def test_every_single_wrong_bit_is_refused(
    frames: list[list[int]], gnss: int, prn: int, sig: int, used: int
) -> None:
    decoder, wrong = RawDecoder("gnss"), 0
    words = frames[0]
    for i, bit in itertools.product(range(used), range(30)):
        if gnss == 3 and i == 0 and bit > 14:
            continue  # the first 15 bits of a BeiDou subframe carry no parity
        bad = [*words[:i], words[i] ^ 1 << bit, *words[i + 1 :]]
        assert decode(gnss, prn, sig, [bad], decoder) == []
        wrong += 1
    assert decoder.counters["parity_bad"] == wrong


def test_every_wrong_bit_of_a_galileo_page_is_refused() -> None:
    (words, *_), decoder, refused = inav(3), RawDecoder("gnss"), 0
    covered = [*range(114), *range(128, 128 + 106)]
    for at in covered:
        bad = list(words)
        bad[at // 32] ^= 1 << (31 - at % 32)
        assert decode(2, 7, 1, [bad], decoder) == []
        refused += 1
    assert decoder.counters["crc_bad"] + decoder.counters["half_page"] == refused
    assert decoder.counters["half_page"] == 2


def test_named_refusals() -> None:
    decoder = RawDecoder("gnss")
    lnav_frame, d1_frame = lnav(1)[0], d1(1)[0]
    decode(0, 7, 0, [lnav_frame[:9]], decoder)
    decode(3, 21, 4, [d1_frame[:4]], decoder)
    decode(2, 7, 1, [inav(1)[0][:4]], decoder)
    assert decoder.counters["subframe_short"] == 3
    even = inav(1)[0][:4]
    decode(2, 7, 1, [even + even], decoder)
    assert decoder.counters["half_page"] == 1
    decode(2, 7, 1, [inav_words(1 << 122, alert=1)], decoder)
    assert decoder.counters["alert_page"] == 1
    decode(2, 8, 1, inav(1, prn=7)[1:2], decoder)
    assert decoder.counters["satellite_mismatch"] == 1
    decode(0, 7, 0, [lnav_words(0)], decoder)
    decode(3, 21, 4, [beidou_words(0)], decoder)
    assert decoder.counters["preamble_bad"] == 2
    decode(3, 64, 4, [d1_frame], decoder)
    assert decoder.counters["satellite_unknown"] == 1


def test_an_orbit_of_no_navigation_satellite_is_refused() -> None:
    frames = d1(1)
    bits = beidou_header(0, 2, 345_606)
    frames[1] = beidou_words(put(bits, 224, 222, 2, 43_200 >> 15))  # all zero, parity right
    decoder = RawDecoder("gnss")
    assert not any(isinstance(e, Ephemeris) for e in decode(3, 21, 4, frames, decoder))
    assert decoder.counters["ephemeris_implausible"] == 1


@pytest.mark.parametrize(
    ("gnss", "prn", "sig", "name"),
    [
        (2, 7, 3, "fnav_not_used"),
        (2, 7, 8, "galileo_cnav_not_used"),
        (3, 21, 9, "bcnav_not_used"),
        (1, 131, 0, "sbas_not_used"),
        (5, 2, 0, "qzss_not_used"),
        (6, 2, 0, "glonass_not_used"),
        (7, 2, 0, "navic_not_used"),
        (9, 2, 0, "unknown_system_not_used"),
    ],
)
def test_messages_that_are_not_decoded(gnss: int, prn: int, sig: int, name: str) -> None:
    decoder = RawDecoder("gnss")
    assert decode(gnss, prn, sig, [[0] * 10], decoder) == []
    assert decoder.counters[name] == 1


def test_receivers_before_generation_9_leave_the_signal_zero() -> None:
    assert only(decode(3, 1, 0, d2(1))).message == "d2"
    assert only(decode(3, 21, 0, d1(1))).message == "d1"
    assert only(decode(2, 7, 0, inav(1))).message == "inav"
    decoder = RawDecoder("gnss")
    decode(0, 7, 0, [[0x8B << 24] + [0] * 9], decoder)
    assert decoder.counters["crc_bad"] == 1  # by CNAV's


# --------------------------------------------------------------------------- ionosphere, weeks


def test_gps_ionosphere() -> None:
    """Figure 20-1 of IS-GPS-200, sheet 8: words 3, 4 and 5 of page 18, from bit 9 of word 3 on."""
    raw = [11, -3, -7, 127, 40, -128, 1, -2]
    bits = put(random.Random(4).getrandbits(240), 240, 0, 8, 0x8B)
    bits = put(put(bits, 240, 43, 3, 4), 240, 48, 8, 0b01_111000)  # data ID 1, page 56
    for i, n in enumerate(raw):
        word, byte = divmod(1 + i, 3)
        bits = put(bits, 240, 24 * (2 + word) + 8 * byte, 8, n)
    words = lnav_words(bits)
    (found,) = decode(0, 7, 0, [words, words])  # said twice, told once
    assert isinstance(found, Klobuchar)
    assert found.system == "G"
    assert found.alpha == (11 * 2**-30, -3 * 2**-27, -7 * 2**-24, 127 * 2**-24)
    assert found.beta == (40 * 2**11, -128 * 2**14, 1 * 2**16, -2 * 2**16)


def test_gps_week_goes_by_the_fullest_one_known() -> None:
    week = 2450 % 1024
    assert week != 2450
    assert only(decode(0, 7, 0, lnav(1))).week == 2450  # the first after the build
    old = RawDecoder("gnss", earliest=date(2000, 1, 1))
    assert only(decode(0, 7, 0, lnav(1), old)).week == 1426
    decode(3, 21, 4, d1(1), old)  # BeiDou week 1094 is GPS week 2450
    assert only(decode(0, 7, 0, lnav(1), old)).week == 2450


@pytest.mark.parametrize(("toe", "week"), [(0, 1095), (43_200, 1094), (75_599, 1094)])
def test_toe_behind_the_end_of_the_week(toe: int, week: int) -> None:
    """Sent 60 s before the week ends; only toe just behind the end belongs to the next."""
    assert only(decode(3, 21, 4, d1(1, sow=604_740, toe=toe))).week == week
