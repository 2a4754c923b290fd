"""Galileo I/NAV from UBX-RXM-SFRBX: pages of an even and an odd half, 120 bits each.

    even, words 0-3    0 | type | data 112 | tail 6
    odd,  words 4-7    1 | type | data 16 | reserved 64 | CRC 24 | reserved 8 | tail 6
    CRC-24Q            over the first 114 bits of the even half and the first 82 of the odd one

Data word types 1 to 4 carry IODnav, which must be the same in all. Type 5 (delays, health, week)
has none: it is taken only behind a word of the issue being collected, and belongs to it, since an
issue changes at the start of a subframe, which holds all five. Source: Galileo OS SIS ICD 2.1,
sections 4.3.2 and 4.3.5.
"""

from __future__ import annotations

from drivers.nmea.incremental_checksum import crc24q
from drivers.raw.bits import Bits, angle, read, s, u
from drivers.raw.messages import Ephemeris
from drivers.raw.subframes import (
    Decoded,
    Parts,
    RefusedError,
    Subframe,
    ephemeris,
    sisa_m,
)
from drivers.raw.weeks import WeekReference

WORDS = 8
_HALF = 128
_EVEN_BITS, _ODD_BITS = 114, 82

_N = 128
"""Bits of a data word; the table counts through types 1 to 5."""
TABLE = {
    "toe_s": u(16, 14, 0, 60.0),
    "mean_anomaly": angle(30, 32, -31),
    "eccentricity": u(62, 32, -33),
    "sqrt_a": u(94, 32, -19),
    "ascending_node": angle(_N + 16, 32, -31),
    "inclination": angle(_N + 48, 32, -31),
    "perigee": angle(_N + 80, 32, -31),
    "inclination_rate": angle(_N + 112, 14, -43),
    "ascending_node_rate": angle(2 * _N + 16, 24, -43),
    "mean_motion_correction": angle(2 * _N + 40, 16, -43),
    "cuc": s(2 * _N + 56, 16, -29),
    "cus": s(2 * _N + 72, 16, -29),
    "crc": s(2 * _N + 88, 16, -5),
    "crs": s(2 * _N + 104, 16, -5),
    "cic": s(3 * _N + 22, 16, -29),
    "cis": s(3 * _N + 38, 16, -29),
    "toc_s": u(3 * _N + 54, 14, 0, 60.0),
    "clock_bias_s": s(3 * _N + 68, 31, -34),
    "clock_drift": s(3 * _N + 99, 21, -46),
    "clock_drift_rate": s(3 * _N + 120, 6, -59),
}
_DELAYS = (s(47, 10, -32), s(57, 10, -32))


def data_word(words: tuple[int, ...]) -> Bits:
    """Data bits (128) of a page. RefusedError `subframe_short`, `half_page` (not an even half and
    its odd one), `alert_page`, `crc_bad`."""
    if len(words) < WORDS:
        raise RefusedError("subframe_short")
    value = 0
    for word in words[:WORDS]:
        value = value << 32 | word
    page = Bits(value, 2 * _HALF)
    if page.unsigned(0, 1) != 0 or page.unsigned(_HALF, 1) != 1:
        raise RefusedError("half_page")
    covered = Bits.join(page.cut(0, _EVEN_BITS), page.cut(_HALF, _HALF + _ODD_BITS))
    # 196 bits fill 25 bytes with four zeros in front, which a CRC that starts from 0 does not see.
    if crc24q(covered.value.to_bytes(25, "big")) != page.unsigned(_HALF + _ODD_BITS, 24):
        raise RefusedError("crc_bad")
    if page.unsigned(1, 1) or page.unsigned(_HALF + 1, 1):
        raise RefusedError("alert_page")
    return Bits.join(page.cut(2, 114), page.cut(_HALF + 2, _HALF + 18))


class InavDecoder:
    """Decoder of one satellite's pages on one signal."""

    def __init__(self) -> None:
        self._parts = Parts()

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a page of I/NAV. RefusedError by name, `ephemeris_mixed` among them."""
        bits = data_word(subframe.words)
        kind = bits.unsigned(0, 6)
        parts = self._parts
        if kind == 4 and bits.unsigned(16, 6) != subframe.prn:
            raise RefusedError("satellite_mismatch")
        if 1 <= kind <= 4:
            mixed = parts.add(bits.unsigned(6, 10), kind, bits)
            if mixed:
                raise RefusedError("ephemeris_mixed")
        elif kind == 5 and parts.found:
            parts.found[5] = bits
        if len(parts.found) < 5:
            return []
        return [self._ephemeris(subframe, weeks)]

    def _ephemeris(self, subframe: Subframe, weeks: WeekReference) -> Ephemeris:
        found: dict[int, Bits] = dict(self._parts.found)
        self._parts.clear()
        numbers = read(Bits.join(*(found[kind] for kind in range(1, 6))), TABLE)
        five = found[5]
        tow = five.unsigned(85, 20)
        return ephemeris(
            subframe,
            "inav",
            numbers,
            sent=(weeks.galileo_week(five.unsigned(73, 12), tow), tow),
            delays=(five, _DELAYS),
            issue=found[1].unsigned(6, 10),
            accuracy_m=sisa_m(found[3].unsigned(120, 8)),
            # Health and data validity of E1-B, which carries this message.
            healthy=five.unsigned(69, 2) == 0 and five.unsigned(72, 1) == 0,
        )
