"""BeiDou D1 (MEO and IGSO, 50 bit/s): subframes 1, 2 and 3 of one frame make an ephemeris.

The message has no issue number that all three carry (AODE and AODC are ages and repeat), so they
must follow each other by 6 s of BDT and toe must equal toc. Subframe 1 also has the ionosphere.
Source: BDS-SIS-ICD-B1I-3.0, section 5.2.4 and figures 5-8 to 5-10.
"""

from __future__ import annotations

from drivers.raw.beidou_words import (
    HEADER_BITS,
    WORDS,
    beidou_ephemeris,
    information,
    second_of_week,
    subframe_number,
)
from drivers.raw.bits import Bits, angle, klobuchar_table, read, s, u
from drivers.raw.messages import Ephemeris
from drivers.raw.subframes import Decoded, Parts, Subframe, klobuchar
from drivers.raw.weeks import WeekReference

_N = 186
"""Bits of a subframe without parity and header; the table counts through 1, 2 and 3."""
TABLE = {
    "toc_s": u(23, 17, 3),
    "clock_drift_rate": s(124, 11, -66),
    "clock_bias_s": s(135, 24, -33),
    "clock_drift": s(159, 22, -50),
    "mean_motion_correction": angle(_N, 16, -43),
    "cuc": s(_N + 16, 18, -31),
    "mean_anomaly": angle(_N + 34, 32, -31),
    "eccentricity": u(_N + 66, 32, -33),
    "cus": s(_N + 98, 18, -31),
    "crc": s(_N + 116, 18, -6),
    "crs": s(_N + 134, 18, -6),
    "sqrt_a": u(_N + 152, 32, -19),
    "toe_s": u(_N + 184, 17, 3),  # two bits in subframe 2, the rest in 3
    "inclination": angle(2 * _N + 15, 32, -31),
    "cic": s(2 * _N + 47, 18, -31),
    "ascending_node_rate": angle(2 * _N + 65, 24, -43),
    "cis": s(2 * _N + 89, 18, -31),
    "inclination_rate": angle(2 * _N + 107, 14, -43),
    "ascending_node": angle(2 * _N + 121, 32, -31),
    "perigee": angle(2 * _N + 153, 32, -31),
}
_IONOSPHERE = klobuchar_table(60)


class D1Decoder:
    """Decoder of one satellite's subframes."""

    def __init__(self) -> None:
        self._parts = Parts()

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a subframe. RefusedError by name, `ephemeris_mixed` among them."""
        bits = information(subframe.words, WORDS)
        number = subframe_number(bits)
        if number not in (1, 2, 3):
            return []
        body = bits.cut(HEADER_BITS, bits.length)
        frame_s = second_of_week(bits) - 6 * (number - 1)
        found: Decoded = []
        if number == 1:
            found.append(klobuchar(subframe, body, _IONOSPHERE))
        # Subframes of two frames are normal: the receiver joined in the middle, or lost one.
        self._parts.add(frame_s, number, body)
        if len(self._parts.found) == 3:
            found.append(self._ephemeris(subframe, frame_s, weeks))
        return found

    def _ephemeris(self, subframe: Subframe, tow_s: int, weeks: WeekReference) -> Ephemeris:
        one: Bits = self._parts.found[1]
        numbers = read(Bits.join(*(self._parts.found[n] for n in (1, 2, 3))), TABLE)
        self._parts.clear()
        return beidou_ephemeris(subframe, "d1", numbers, one, tow_s, weeks)
