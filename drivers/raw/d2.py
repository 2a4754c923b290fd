"""BeiDou D2 (GEO, 500 bit/s): ten pages of subframe 1, one every 3 s, make an ephemeris.

A page uses the first five words, 114 information bits, of which its header takes 42. A number may
continue in the next page, so the pages are joined without their spare bits. Page n of a set begins
3 (n - 1) s after page 1, and toe must equal toc. Page 2 has the ionosphere. Source:
BDS-SIS-ICD-B1I-3.0, section 5.3.3 and figure 5-14.
"""

from __future__ import annotations

from drivers.raw.beidou_words import beidou_ephemeris, information, second_of_week, subframe_number
from drivers.raw.bits import Bits, angle, klobuchar_table, read, s, u
from drivers.raw.messages import Ephemeris
from drivers.raw.subframes import Decoded, Parts, Subframe, klobuchar
from drivers.raw.weeks import WeekReference

PAGE_WORDS = 5
PAGE_S = 3
USED = {
    1: (42, 102),
    3: (80, 108),
    4: (42, 106),
    5: (42, 106),
    6: (42, 106),
    7: (42, 106),
    8: (42, 108),
    9: (42, 106),
    10: (42, 61),
}
"""Used bits of each page of the orbit: the first, and the one behind the last."""

TABLE = {
    "toc_s": u(23, 17, 3),
    "clock_bias_s": s(60, 24, -33),
    "clock_drift": s(84, 22, -50),  # pages 3 and 4
    "clock_drift_rate": s(106, 11, -66),
    "mean_motion_correction": angle(122, 16, -43),
    "cuc": s(138, 18, -31),  # 4 and 5
    "mean_anomaly": angle(156, 32, -31),
    "cus": s(188, 18, -31),
    "eccentricity": u(206, 32, -33),  # 5 and 6
    "sqrt_a": u(238, 32, -19),
    "cic": s(270, 18, -31),  # 6 and 7
    "cis": s(288, 18, -31),
    "toe_s": u(306, 17, 3),
    "inclination": angle(323, 32, -31),  # 7 and 8
    "crc": s(355, 18, -6),
    "crs": s(373, 18, -6),
    "ascending_node_rate": angle(391, 24, -43),  # 8 and 9
    "ascending_node": angle(415, 32, -31),
    "perigee": angle(447, 32, -31),  # 9 and 10
    "inclination_rate": angle(479, 14, -43),
}
_IONOSPHERE = klobuchar_table(42)


class D2Decoder:
    """Decoder of one geostationary satellite's subframes."""

    def __init__(self) -> None:
        self._parts = Parts()

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a subframe. RefusedError by name, `ephemeris_mixed` among them."""
        bits = information(subframe.words, PAGE_WORDS)
        if subframe_number(bits) != 1:
            return []
        page = bits.unsigned(38, 4)
        if page == 2:
            return [klobuchar(subframe, bits, _IONOSPHERE)]
        if page not in USED:
            return []
        first_s = second_of_week(bits) - PAGE_S * (page - 1)
        self._parts.add(first_s, page, bits.cut(*USED[page]))
        if len(self._parts.found) < len(USED):
            return []
        return [self._ephemeris(subframe, first_s, weeks)]

    def _ephemeris(self, subframe: Subframe, tow_s: int, weeks: WeekReference) -> Ephemeris:
        one: Bits = self._parts.found[1]
        numbers = read(Bits.join(*(self._parts.found[page] for page in USED)), TABLE)
        self._parts.clear()
        return beidou_ephemeris(subframe, "d2", numbers, one, tow_s, weeks)
