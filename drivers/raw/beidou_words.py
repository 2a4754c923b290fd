"""BeiDou D1 and D2 words from UBX-RXM-SFRBX: BCH(15,11,1) checked, parity removed.

    word 1       15 bits free | 11 bits, 4 parity
    words 2-10   11 bits | 11 bits | 4 parity of the first | 4 parity of the second
    g(x)         x^4 + x + 1; a good code word is a multiple of it

The receiver undoes the interleaving of BDS-SIS-ICD-B1I-3.0 section 5.1.3. The code could correct
one bit of fifteen; here a damaged word is refused.
"""

from __future__ import annotations

from typing import Any

from drivers.raw.bits import Bits, s
from drivers.raw.messages import Ephemeris
from drivers.raw.subframes import RefusedError, Subframe, ephemeris, ura_m
from drivers.raw.weeks import WeekReference

WORDS = 10
PREAMBLE = 0b11100010010
FREE_BITS = 26
"""Information bits of word 1; every other word has 22."""
HEADER_BITS = 38
"""Preamble 11, reserved 4, subframe number 3, second of week 20."""
_DELAYS = (s(40, 10, 0, 1e-10), s(50, 10, 0, 1e-10))
"""TGD1 and TGD2, in 0.1 ns."""
GEO = frozenset(range(1, 6)) | frozenset(range(59, 64))


def _remainders() -> tuple[bool, ...]:
    good = []
    for word in range(1 << 15):
        rest = word
        for bit in range(14, 3, -1):
            if rest >> bit & 1:
                rest ^= 0b10011 << (bit - 4)
        good.append(rest == 0)
    return tuple(good)


_GOOD = _remainders()


def information(words: tuple[int, ...], count: int) -> Bits:
    """Information bits of the first `count` words. RefusedError `subframe_short`, `parity_bad`,
    `preamble_bad`."""
    if len(words) < WORDS:
        raise RefusedError("subframe_short")
    if not _GOOD[words[0] & 0x7FFF]:
        raise RefusedError("parity_bad")
    value = words[0] >> 4 & 0x3FFFFFF
    for word in words[1:count]:
        first = word >> 15 & 0x7FF0 | word >> 4 & 0xF
        second = word >> 4 & 0x7FF0 | word & 0xF
        if not (_GOOD[first] and _GOOD[second]):
            raise RefusedError("parity_bad")
        value = value << 22 | word >> 8 & 0x3FFFFF
    bits = Bits(value, FREE_BITS + 22 * (count - 1))
    if bits.unsigned(0, 11) != PREAMBLE:
        raise RefusedError("preamble_bad")
    return bits


def subframe_number(bits: Bits) -> int:
    return bits.unsigned(15, 3)


def second_of_week(bits: Bits) -> int:
    """BDT second of week at the start of this subframe."""
    return bits.unsigned(18, 20)


def beidou_ephemeris(
    subframe: Subframe,
    message: str,
    numbers: dict[str, Any],
    first: Bits,
    tow_s: int,
    weeks: WeekReference,
) -> Ephemeris:
    """Make the ephemeris of D1 or D2. RefusedError by name.

    `numbers`: values by the message's own table. `first`: subframe 1 (D1) or page 1 (D2) without
    its header; both hold health, ages, accuracy, week and delays at the same bits. `tow_s`: BDT at
    which `first` began.
    """
    if numbers["toe_s"] != numbers["toc_s"]:
        raise RefusedError("ephemeris_mixed")
    return ephemeris(
        subframe,
        message,
        numbers,
        sent=(weeks.bdt_week(first.unsigned(10, 13), tow_s), tow_s),
        delays=(first, _DELAYS),
        issue=first.unsigned(1, 5),
        accuracy_m=ura_m(first.unsigned(6, 4)),
        healthy=first.unsigned(0, 1) == 0,
    )
