"""GPS CNAV (L2C, L5) from UBX-RXM-SFRBX: the signals' group delays of message 30.

    preamble 8, PRN 6, type 6, TOW 17, alert 1, data 238, CRC 24: 300 bits in ten words of 32
    type 30: T_GD and ISC of L1 C/A, L2C, L5 I5, L5 Q5, 13 bits of 2^-35 s each from bit 127 on

A number with only its highest bit set is unknown. Other types are checked but not read: LNAV has
the same orbit and clock. Source: IS-GPS-200N 30.3.3.3.1 and figure 30-3; IS-GPS-705J 20.3.3.3.
"""

from __future__ import annotations

from drivers.nmea.incremental_checksum import crc24q
from drivers.raw.bits import Bits
from drivers.raw.messages import SignalDelays
from drivers.raw.subframes import Decoded, RefusedError, Subframe
from drivers.raw.weeks import WeekReference

WORDS, LENGTH, COVERED = 10, 300, 276
DELAYS_TYPE = 30
_FIRST, _BITS, _WEIGHT_S = 127, 13, 2.0**-35
SIGNALS = (("1C",), ("2S", "2L", "2X"), ("5I",), ("5Q",))
"""Signals of the four corrections behind T_GD."""


class CnavDecoder:
    """Decoder of one GPS satellite's messages."""

    def decode(self, subframe: Subframe, weeks: WeekReference) -> Decoded:
        """Result of a message. RefusedError by name."""
        if len(subframe.words) < WORDS:
            raise RefusedError("subframe_short")
        value = 0
        for word in subframe.words[:WORDS]:
            value = value << 32 | word
        bits = Bits(value, 32 * WORDS).cut(0, LENGTH)
        # 276 bits are no whole bytes: leading zeros do not change a remainder that begins with
        # zero.
        if crc24q(bits.unsigned(0, COVERED).to_bytes(35, "big")) != bits.unsigned(COVERED, 24):
            raise RefusedError("crc_bad")
        if bits.unsigned(8, 6) != subframe.prn:
            raise RefusedError("satellite_mismatch")
        if bits.unsigned(14, 6) != DELAYS_TYPE or bits.unsigned(37, 1):
            return []
        raw = [bits.signed(_FIRST + _BITS * k, _BITS) for k in range(5)]
        known = [n != -(1 << (_BITS - 1)) for n in raw]
        if not known[0]:
            return []
        isc = tuple(
            (name, n * _WEIGHT_S)
            for names, n, there in zip(SIGNALS, raw[1:], known[1:], strict=True)
            for name in names
            if there
        )
        return [
            SignalDelays(
                subframe.source,
                subframe.t_seen_ns,
                subframe.system,
                subframe.prn,
                raw[0] * _WEIGHT_S,
                isc,
            )
        ]
