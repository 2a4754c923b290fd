"""B-CNAV1 and B-CNAV2: against D1 of the same satellites, and of words made bit by bit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from drivers.raw.decoder import RawDecoder
from drivers.raw.messages import Bdgim, Ephemeris, RawGnssEpoch
from fusiond.gnss.orbit import Orbits
from tests.drivers.raw.frames import bcnav1, bcnav2, put, sfrbx, with_crc
from tests.drivers.raw.test_recordings import WALK, decode

B1C, B2A = 6, 8


def taken(sig: int, frames: list[list[int]], prn: int = 21) -> tuple[list[Any], RawDecoder]:
    decoder = RawDecoder("gnss")
    found = [e for words in frames for e in decoder.feed(sfrbx(3, prn, sig, words), 5)]
    return [e for e in found if not isinstance(e, Bdgim)], decoder


def ionosphere(sig: int, words: list[int]) -> list[Bdgim]:
    """What a block says of it."""
    found = RawDecoder("gnss").feed(sfrbx(3, 21, sig, words), 5)
    return [e for e in found if isinstance(e, Bdgim)]


@pytest.fixture(scope="module")
def walk() -> dict[tuple[str, str], Ephemeris]:
    events, _ = decode(WALK)
    return {(e.satellite, e.message): e for e in events if isinstance(e, Ephemeris)}


def test_orbits_and_clocks_are_those_of_d1(walk: dict[tuple[str, str], Ephemeris]) -> None:
    """Three messages of one satellite, each with an orbit fitted for it: RMS 0.08 m, 0.05 ns. What
    a field shifted by a bit makes is kilometres."""
    compared = set()
    for (name, message), e in walk.items():
        if message not in ("bcnav1", "bcnav2") or (name, "d1") not in walk:
            continue
        for tow in (406_800.0, 408_700.0, 410_400.0):
            states = Orbits.of([e, walk[name, "d1"]]).at(2381, tow)
            apart = states.position[0] - states.position[1]
            assert np.linalg.norm(apart) < 0.5, (name, message, tow)
            assert np.linalg.norm(states.velocity[0] - states.velocity[1]) < 1e-3
            assert abs(states.clock_s[0] - states.clock_s[1]) < 3e-10
        assert e.healthy == walk[name, "d1"].healthy == (name != "C50")
        assert e.issue == walk[name, "d1"].issue
        compared.add((name, message))
    names = ("C21", "C22", "C34", "C42", "C43", "C44", "C50")
    assert compared == {(name, message) for name in names for message in ("bcnav1", "bcnav2")}


def test_delays_of_both_messages_agree(walk: dict[tuple[str, str], Ephemeris]) -> None:
    """Both have T_GD of B1C and B2a; that of B1C is within 5 ns of TGD1, 14 MHz beside it."""
    for name in ("C21", "C22", "C34", "C36", "C42", "C43", "C44"):
        one, two = walk[name, "bcnav1"], walk[name, "bcnav2"]
        assert one.group_delay_s[:2] == two.group_delay_s[:2]
        assert all(1e-11 < abs(e.group_delay_s[2]) < 5e-9 for e in (one, two))
        if (name, "d1") in walk:
            assert abs(one.group_delay_s[0] - walk[name, "d1"].group_delay_s[0]) < 5e-9


def test_bcnav1_bit_by_bit() -> None:
    frames = bcnav1(3)
    (found,), decoder = taken(B1C, frames)
    assert decoder.counters["subframes_bcnav1"] == 2
    assert (found.message, found.satellite, found.week, found.toe_s) == (
        "bcnav1", "C21", 1094, 345_600.0,
    )  # fmt: skip
    assert found.sqrt_a == math.sqrt(27_906_100.0 + 12_345 * 2.0**-9)
    assert found.eccentricity == 123_456_789 * 2.0**-33
    assert (found.issue, found.healthy, found.accuracy_m) == (77, True, None)
    # The last 43 bits: T_GD B2a 12, ISC B1C 12, T_GD B1C 12, 7 free.
    two = int.from_bytes(b"".join(w.to_bytes(4, "big") for w in frames[0]), "big") >> 32
    delays = [(two >> 7 + 12 * k & 0xFFF) for k in (0, 2, 1)]
    signed = [d - 4096 if d > 2047 else d for d in delays]
    assert found.group_delay_s == tuple(d * 2.0**-34 for d in signed)
    # Health comes with subframe 3; without it nothing is known of it.
    assert taken(B1C, frames[:1])[0] == []
    (ill,), _ = taken(B1C, bcnav1(3, health=4))
    assert not ill.healthy


def test_bcnav2_needs_one_issue_and_its_pair() -> None:
    ten, eleven, thirty = bcnav2(4)
    (found,), _ = taken(B2A, [ten, eleven, thirty])
    assert (found.message, found.week, found.toe_s) == ("bcnav2", 1094, 345_600.0)
    assert taken(B2A, [thirty, ten, eleven])[0] == [found]
    assert taken(B2A, [ten, thirty])[0] == []
    # 11 of another pair has no issue of its own: it is not taken.
    later = bcnav2(5, sow_s=345_600 + 6)
    assert taken(B2A, [ten, later[1], thirty])[0] == []
    mixed, decoder = taken(B2A, [ten, eleven, bcnav2(4, issue=78)[2]])
    assert (mixed, decoder.counters["ephemeris_mixed"]) == ([], 1)


@pytest.mark.parametrize(
    ("sig", "frames", "name"),
    [
        (B1C, [[1] * 19], "crc_bad"),
        (B1C, [[0] * 10], "subframe_short"),
        (B1C, [[0] * 19, [0] * 9], "ephemeris_implausible"),  # all zero: its CRC is right
        (B2A, [[0] * 8], "subframe_short"),
        (B2A, [[1] * 9], "crc_bad"),
        (B2A, bcnav2(1, prn=22)[:1], "satellite_mismatch"),
    ],
)
def test_refused_by_name(sig: int, frames: list[list[int]], name: str) -> None:
    found, decoder = taken(sig, frames)
    assert found == []
    assert decoder.counters[name] == 1


ALPHA = (26.25, -2.75, 9.5, 7.75, -11.25, -0.625, 0.75, 1.875, -16.0)
"""In eighths of a TECU: 10 bits, then 8 each; the fifth is sent without its sign."""


def coefficients() -> list[tuple[int, int]]:
    """Value and bits of each, one behind the other."""
    sent = [round(8 * (-a if k == 4 else a)) for k, a in enumerate(ALPHA)]
    return [(value & 0x3FF, 10) if k == 0 else (value & 0xFF, 8) for k, value in enumerate(sent)]


@pytest.mark.parametrize("message", ["bcnav1", "bcnav2"])
def test_ionosphere_bit_by_bit(message: str) -> None:
    """Page 1 of subframe 3 behind page 6 bits, health 2, flags 3, indices 4, 5 and 22; message 30
    behind 42 bits of head, clock 69, issue 10 and two delays of 12."""
    one = message == "bcnav1"
    total, at, sig = (240, 42, B1C) if one else (264, 145, B2A)
    bits = put(0, 240, 0, 6, 1) if one else put(put(0, 264, 0, 6, 21), 264, 6, 6, 30)
    for value, length in coefficients():
        bits = put(bits, total, at, length, value)
        at += length
    assert at == (116 if one else 219)
    words = with_crc(bits, total, 9)
    assert ionosphere(sig, words) == [Bdgim("gnss", 5, ALPHA)]
    ill = put(bits, total, 6 if one else 30, 2, 1)
    other = put(bits, total, 0, 6, 2) if one else put(bits, total, 6, 6, 31)
    none = put(bits, total, 42, 74, 0) if one else put(bits, total, 145, 74, 0)
    for changed in (ill, other, none):
        assert ionosphere(sig, with_crc(changed, total, 9)) == []


def test_the_same_ionosphere_is_told_once() -> None:
    decoder = RawDecoder("gnss")
    for words in bcnav2(4) * 3:
        decoder.feed(sfrbx(3, 21, B2A, words), 5)
    assert decoder.counters["ionospheres"] == 1


def test_b1c_of_the_walk_comes_with_delays() -> None:
    """Without D1, as of a receiver that tracks B1C alone: every epoch is still complete."""
    events, counters = decode(WALK)
    epochs = [e for e in events if isinstance(e, RawGnssEpoch)]
    assert sum(s.signal == "1P" for e in epochs for s in e.signals) == 4174
    assert counters["subframes_bcnav1"] == 148
