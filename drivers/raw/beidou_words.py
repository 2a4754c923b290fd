"""BeiDou D1 and D2 words as UBX-RXM-SFRBX hands them over: BCH(15,11,1) checked, parity taken out.

    word 1       15 bits free | 11 bits, 4 parity
    words 2-10   11 bits | 11 bits | 4 parity of the first | 4 parity of the second
    g(x)         x^4 + x + 1; a good code word is a multiple of it

The interleaving of BDS-SIS-ICD-B1I-3.0 section 5.1.3 is undone by the receiver. The code could
correct one bit of fifteen; a word in doubt is refused instead.
"""

from __future__ import annotations

from drivers.raw.bits import Bits
from drivers.raw.messages import Klobuchar
from drivers.raw.subframes import RefusedError, Subframe

WORDS = 10
PREAMBLE = 0b11100010010
FREE_BITS = 26
"""Information bits of word 1; every other word has 22."""
HEADER_BITS = 38
"""Preamble 11, reserved 4, subframe number 3, second of week 20."""
GROUP_DELAY_S = 1e-10
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
    """The information bits of the first `count` words. RefusedError `subframe_short`,
    `parity_bad`, `preamble_bad`."""
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
    """BDT second of week at which this subframe began."""
    return bits.unsigned(18, 20)


def klobuchar(subframe: Subframe, alpha: dict[str, float], beta: dict[str, float]) -> Klobuchar:
    """From the numbers of `klobuchar_table`."""
    return Klobuchar(
        subframe.source,
        subframe.t_seen_ns,
        "C",
        (alpha["0"], alpha["1"], alpha["2"], alpha["3"]),
        (beta["0"], beta["1"], beta["2"], beta["3"]),
    )
