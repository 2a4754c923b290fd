"""BeiDou B-CNAV1 (B1C) and B-CNAV2 (B2a) from UBX-RXM-SFRBX: ephemeris, delays, and the ionosphere
(BDGIM).

    B-CNAV1  subframe 1 in 3 words, undecoded; 2 in 19: 576 bits, CRC 24; 3 in 9: 240 bits, CRC 24
    B-CNAV2  one message in 9 words: PRN 6, type 6, second of week 18, data 234, CRC 24
    A        A_ref + dA,  A_ref 27,906,100 m of a MEO, 42,162,200 m of an IGSO

The ionosphere is in page 1 of subframe 3 and in message 30. The receiver has undone LDPC code and
interleaving, and fills the last word with zeros. Subframe 2 is an ephemeris with its clock and
delays; health is in subframe 3. Messages 10, 11 and 30 belong together if the low byte of IODC is
IODE; 11 has no issue number and follows its 10 by 3 s. The clock refers to B3I, as that of D1.
Sources: BDS-SIS-ICD-B1C-1.0 sections 6 and 7; BDS-SIS-ICD-B2a-1.0 sections 6 and 7.
"""

from __future__ import annotations

import math

from drivers.nmea.incremental_checksum import crc24q
from drivers.raw.bits import Bits, Table, angle, bdgim_table, read, s, u
from drivers.raw.messages import Ephemeris
from drivers.raw.subframes import Decoded, RefusedError, Subframe, bdgim, ephemeris
from drivers.raw.weeks import WeekReference

SUBFRAMES = {3: 1, 19: 2, 9: 3}
"""Words of B-CNAV1's subframes."""
_SUBFRAME_2, _SUBFRAME_3, _MESSAGE = 576, 240, 264
"""Bits before the CRC."""
MESSAGES = (10, 11, 30)
FOLLOWS_S = 3
REFERENCE_AXIS_M = {2: 42_162_200.0, 3: 27_906_100.0}
"""Reference axis by satellite type, IGSO and MEO; GEO (1) send neither message."""


def _orbit(at: int) -> Table:
    """Ephemeris I, 203 bits, without the axis."""
    return {
        "toe_s": u(at, 11, 0, 300.0),
        "semi_major_rate": s(at + 39, 25, -21),
        "mean_motion_correction": angle(at + 64, 17, -44),
        "mean_motion_rate": angle(at + 81, 23, -57),
        "mean_anomaly": angle(at + 104, 33, -32),
        "eccentricity": u(at + 137, 33, -34),
        "perigee": angle(at + 170, 33, -32),
    }


def _plane(at: int) -> Table:
    """Ephemeris II, 222 bits."""
    return {
        "ascending_node": angle(at, 33, -32),
        "inclination": angle(at + 33, 33, -32),
        "ascending_node_rate": angle(at + 66, 19, -44),
        "inclination_rate": angle(at + 85, 15, -44),
        "cis": s(at + 100, 16, -30),
        "cic": s(at + 116, 16, -30),
        "crs": s(at + 132, 24, -8),
        "crc": s(at + 156, 24, -8),
        "cus": s(at + 180, 21, -30),
        "cuc": s(at + 201, 21, -30),
    }


def _clock(at: int) -> Table:
    """Clock correction, 69 bits."""
    return {
        "toc_s": u(at, 11, 0, 300.0),
        "clock_bias_s": s(at + 11, 25, -34),
        "clock_drift": s(at + 36, 22, -50),
        "clock_drift_rate": s(at + 58, 11, -66),
    }


# Where the parts of subframe 2, and of messages 10, 11 and 30, begin.
_ORBIT_1, _PLANE_1, _CLOCK_1 = 39, 242, 464
_ORBIT_2, _PLANE_2, _CLOCK_2 = 61, 42, 42
TABLE_1 = _orbit(_ORBIT_1) | _plane(_PLANE_1) | _clock(_CLOCK_1)
_TYPE, _AXIS = 11, 13
"""Fields of Ephemeris I: satellite type, 2 bits, and dA, 26 bits of 2^-9 m."""
_DELAYS_1 = (s(557, 12, -34), s(533, 12, -34), s(545, 12, -34))
_DELAYS_2 = (s(219, 12, -34), s(121, 12, -34), s(133, 12, -34))
"""Delays: T_GD of B1C's pilot, T_GD of B2a's pilot, ISC of the data component of the message's own
signal."""


_IONOSPHERE_1, _IONOSPHERE_2 = bdgim_table(42), bdgim_table(145)
IONOSPHERE_PAGE = 1
"""Page of the ionosphere in subframe 3."""


def _checked(words: tuple[int, ...], length: int) -> Bits:
    """First `length` bits, checked. RefusedError `crc_bad`."""
    value = 0
    for word in words:
        value = value << 32 | word
    bits = Bits(value, 32 * len(words))
    covered = bits.cut(0, length)
    if crc24q(covered.value.to_bytes(length // 8, "big")) != bits.unsigned(length, 24):
        raise RefusedError("crc_bad")
    return covered


def _sqrt_a(bits: Bits, at: int) -> float:
    """Root of the semi-major axis of Ephemeris I at bit `at`. RefusedError for an impossible
    satellite type."""
    reference = REFERENCE_AXIS_M.get(bits.unsigned(at + _TYPE, 2))
    if reference is None:
        raise RefusedError("ephemeris_implausible")
    return math.sqrt(reference + bits.signed(at + _AXIS, 26) * 2.0**-9)


class Bcnav1Decoder:
    """Decoder of one satellite's subframes on B1C."""

    def __init__(self) -> None:
        self._two: Bits | None = None
        self._healthy: bool | None = None

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a subframe: an ephemeris once both 2 and 3 have been received, and the
        ionosphere of 3. RefusedError by name."""
        number = SUBFRAMES.get(len(subframe.words))
        if number is None:
            raise RefusedError("subframe_short")
        if number == 1:
            return []
        found: Decoded = []
        if number == 2:
            self._two = _checked(subframe.words, _SUBFRAME_2)
        else:
            three = _checked(subframe.words, _SUBFRAME_3)
            # Page 6 bits, HS 2, then DIF and SIF of this signal.
            self._healthy = three.unsigned(6, 4) == 0
            if three.unsigned(0, 6) == IONOSPHERE_PAGE and self._healthy:
                found += bdgim(subframe, three, _IONOSPHERE_1)
        if self._two is not None and self._healthy is not None:
            found.append(self._ephemeris(subframe, self._two, self._healthy, weeks))
        return found

    def _ephemeris(
        self, subframe: Subframe, two: Bits, healthy: bool, weeks: WeekReference
    ) -> Ephemeris:
        numbers = read(two, TABLE_1) | {"sqrt_a": _sqrt_a(two, _ORBIT_1)}
        issue = two.unsigned(31, 8)
        if two.unsigned(21, 10) & 0xFF != issue:
            raise RefusedError("ephemeris_mixed")
        tow_s = two.unsigned(13, 8) * 3600
        week = weeks.bdt_week(two.unsigned(0, 13), tow_s)
        return ephemeris(
            subframe,
            "bcnav1",
            numbers,
            sent=(week, tow_s),
            delays=(two, _DELAYS_1),
            issue=issue,
            accuracy_m=None,
            healthy=healthy,
        )


class Bcnav2Decoder:
    """Decoder of one satellite's messages on B2a."""

    def __init__(self) -> None:
        self._parts: dict[int, Bits] = {}

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a message. RefusedError by name, `ephemeris_mixed` among them."""
        if len(subframe.words) < 9:
            raise RefusedError("subframe_short")
        bits = _checked(subframe.words[:9], _MESSAGE)
        if bits.unsigned(0, 6) != subframe.prn:
            raise RefusedError("satellite_mismatch")
        kind, tow_s, parts = bits.unsigned(6, 6), bits.unsigned(12, 18) * FOLLOWS_S, self._parts
        if kind not in MESSAGES:
            return []
        # HS 2 bits, DIF and SIF of this signal.
        good = kind == 30 and bits.unsigned(30, 4) == 0
        found = bdgim(subframe, bits, _IONOSPHERE_2) if good else []
        if kind == 11 and not (10 in parts and _second_of(parts[10]) == tow_s - FOLLOWS_S):
            return []
        if kind == 10:
            parts.pop(11, None)
        parts[kind] = bits
        if 10 in parts and 30 in parts and parts[30].unsigned(111, 10) & 0xFF != _issue(parts[10]):
            self._parts = {kind: bits}
            raise RefusedError("ephemeris_mixed")
        if len(parts) < len(MESSAGES):
            return found
        ten, eleven, thirty = (parts[n] for n in MESSAGES)
        self._parts = {30: thirty}
        numbers = read(ten, _orbit(_ORBIT_2)) | read(eleven, _plane(_PLANE_2))
        numbers |= read(thirty, _clock(_CLOCK_2)) | {"sqrt_a": _sqrt_a(ten, _ORBIT_2)}
        week = weeks.bdt_week(ten.unsigned(30, 13), _second_of(ten))
        # HS 2 bits, DIF and SIF of this signal, in 11 and 30.
        healthy = eleven.unsigned(30, 4) == 0 and thirty.unsigned(30, 4) == 0
        found.append(
            ephemeris(
                subframe,
                "bcnav2",
                numbers,
                sent=(week, _second_of(ten)),
                delays=(thirty, _DELAYS_2),
                issue=_issue(ten),
                accuracy_m=None,
                healthy=healthy,
            )
        )
        return found


def _second_of(bits: Bits) -> int:
    """BDT second of week at the start of this message."""
    return bits.unsigned(12, 18) * FOLLOWS_S


def _issue(ten: Bits) -> int:
    return ten.unsigned(53, 8)
