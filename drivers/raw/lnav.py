"""GPS LNAV from UBX-RXM-SFRBX: ten words of 30 bits, six of them parity.

    word     D29* D30* | d1 ... d24 | D25 ... D30     bits 31-30, 29-6, 5-0 of a U4
    D25..29  parity, IS-GPS-200 table 20-XIV

The receiver has already corrected the data's polarity, and leaves the last two bits of the previous
word in bits 31-30: all words of a recording verify so. Subframes 1, 2 and 3 make an ephemeris if
IODE of 2 and 3 and the low byte of IODC agree; page 18 of subframe 4 (data ID 56) has the
ionosphere. Source: IS-GPS-200, 20.3.3 and figure 20-1.
"""

from __future__ import annotations

from drivers.raw.bits import Bits, angle, klobuchar_table, read, s, u
from drivers.raw.subframes import (
    Decoded,
    RefusedError,
    Subframe,
    ephemeris,
    klobuchar,
    ura_m,
)
from drivers.raw.weeks import WEEK_S, WeekReference

WORDS = 10
PREAMBLE = 0x8B
IONOSPHERE_PAGE = 56

_N = 240
"""Bits of a subframe without parity; the table counts through 1, 2 and 3."""
TABLE = {
    "toc_s": u(176, 16, 4),
    "clock_drift_rate": s(192, 8, -55),
    "clock_drift": s(200, 16, -43),
    "clock_bias_s": s(216, 22, -31),
    "crs": s(_N + 56, 16, -5),
    "mean_motion_correction": angle(_N + 72, 16, -43),
    "mean_anomaly": angle(_N + 88, 32, -31),
    "cuc": s(_N + 120, 16, -29),
    "eccentricity": u(_N + 136, 32, -33),
    "cus": s(_N + 168, 16, -29),
    "sqrt_a": u(_N + 184, 32, -19),
    "toe_s": u(_N + 216, 16, 4),
    "cic": s(2 * _N + 48, 16, -29),
    "ascending_node": angle(2 * _N + 64, 32, -31),
    "cis": s(2 * _N + 96, 16, -29),
    "inclination": angle(2 * _N + 112, 32, -31),
    "crc": s(2 * _N + 144, 16, -5),
    "perigee": angle(2 * _N + 160, 32, -31),
    "ascending_node_rate": angle(2 * _N + 192, 24, -43),
    "inclination_rate": angle(2 * _N + 224, 14, -43),
}
_TGD = s(160, 8, -31)
_IONOSPHERE = klobuchar_table(56)


def _mask(*bits: int) -> int:
    """Bits of IS-GPS-200 table 20-XIV: d1 is the highest of 24, above them D29*, D30*."""
    return sum(1 << (24 - bit) for bit in bits)


_D29, _D30 = 1 << 25, 1 << 24
_EQUATIONS = (
    _D29 | _mask(1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23),
    _D30 | _mask(2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24),
    _D29 | _mask(1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22),
    _D30 | _mask(2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23),
    _D30 | _mask(1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24),
    _D29 | _mask(3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24),
)


def parity(word: int) -> int:
    """Six parity bits of a word, whose bits 31 to 6 are used."""
    above = word >> 6
    value = 0
    for equation in _EQUATIONS:
        value = value << 1 | (above & equation).bit_count() & 1
    return value


def subframe_bits(words: tuple[int, ...]) -> Bits:
    """Data bits (240) without parity. RefusedError `subframe_short`, `parity_bad`,
    `preamble_bad`."""
    if len(words) < WORDS:
        raise RefusedError("subframe_short")
    value = 0
    for word in words[:WORDS]:
        if parity(word) != word & 0x3F:
            raise RefusedError("parity_bad")
        value = value << 24 | word >> 6 & 0xFFFFFF
    bits = Bits(value, _N)
    if bits.unsigned(0, 8) != PREAMBLE:
        raise RefusedError("preamble_bad")
    return bits


class LnavDecoder:
    """Decoder of one GPS satellite's subframes."""

    def __init__(self) -> None:
        self._parts: dict[int, Bits] = {}

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a subframe. RefusedError by name, `ephemeris_mixed` among them."""
        bits = subframe_bits(subframe.words)
        number = bits.unsigned(43, 3)
        if number == 4 and bits.unsigned(50, 6) == IONOSPHERE_PAGE:
            return [klobuchar(subframe, bits, _IONOSPHERE)]
        if number not in (1, 2, 3):
            return []
        self._parts[number] = bits
        issues = {_issue(n, part) for n, part in self._parts.items()}
        if len(issues) > 1:
            self._parts = {number: bits}
            raise RefusedError("ephemeris_mixed")
        if len(self._parts) < 3:
            return []
        one, whole = self._parts[1], Bits.join(*(self._parts[n] for n in (1, 2, 3)))
        self._parts = {}
        numbers = read(whole, TABLE)
        tow = (one.unsigned(24, 17) * 6 - 6) % WEEK_S  # the HOW counts to the next subframe
        return [
            ephemeris(
                subframe,
                "lnav",
                numbers,
                sent=(weeks.gps_week(one.unsigned(48, 10), tow), tow),
                delays=(one, (_TGD,)),
                issue=issues.pop(),
                accuracy_m=ura_m(one.unsigned(60, 4)),
                healthy=one.unsigned(64, 6) == 0 and not bits.unsigned(41, 1),  # nor alert flag
            )
        ]


def _issue(number: int, bits: Bits) -> int:
    """IODE, or the low byte of IODC."""
    return bits.unsigned({1: 168, 2: 48, 3: 216}[number], 8)
