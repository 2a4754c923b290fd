r"""Navigation messages in a receiver's output: GPS LNAV, BeiDou D1 and D2, with parity.

    LNAV   subframe of 10 words, 24 data and 6 parity bits, Hamming (32, 26); 300 bits in 6 s
    D1     subframe of 10 words, word 1: 26 + 4, others 22 + 8; BCH (15, 11, 1), g = x^4 + x + 1;
           300 bits in 6 s
    D2     the same words at ten times the rate; the ephemeris is spread over the first five words
           of the ten pages of subframe 1, one every 3 s

A word is an integer of 30 bits, the first bit sent on top. Receivers of the UBX family give LNAV
words with the polarity taken out (the word is complemented where the word before ended in 1, and
bit 31 holds the D29* to check it with, bit 30 a D30* of 0), and BeiDou words with the interleaving
taken out (11 + 11 information bits, then 4 + 4 parity bits). Recorded streams show both.

Source: IS-GPS-200N 20.3.3 and table 20-XIV; BDS-SIS-ICD-B1I-3.0 sections 5.1.3, 5.2.4 and 5.3.3.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.raw.messages import Ephemeris, Klobuchar
from fusiond.simulation.gnss.nav_fields import FIELDS, Bits, Wire, klobuchar_wire, wire

LNAV_PREAMBLE = 0b10001011
BEIDOU_PREAMBLE = 0b11100010010
LNAV_PERIOD_S = 6
D2_PERIOD_S = 3
"""Interval of the pages of D2 subframe 1."""
LEAP_SECONDS = 18
"""GPST - UTC since 2017-01-01, for the UTC part of LNAV page 18."""

# Data bits that D25 to D30 sum over, after the D29* or D30* that they begin with (29 or 30).
_HAMMING = (
    (29, (1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23)),
    (30, (2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24)),
    (29, (1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22)),
    (30, (2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23)),
    (30, (1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24)),
    (29, (3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24)),
)


def hamming(data: int, d29: int, d30: int) -> int:
    """Parity bits D25 to D30 of 24 source bits after a word that ended in `d29`, `d30`."""
    parity = 0
    for before, places in _HAMMING:
        bit = d29 if before == 29 else d30
        for place in places:
            bit ^= data >> (24 - place) & 1
        parity = parity << 1 | bit
    return parity


def lnav_words(data: Sequence[int]) -> tuple[int, ...]:
    """Ten words of 32 bits from ten times 24 source bits; words 2 and 10 leave their last two open.

    Those two bits are chosen such that the word ends in 00 on the air, as the standard asks.
    """
    out = []
    d29 = d30 = 0  # as sent: the subframe before ended in 00
    for k, source in enumerate(data):
        if k in {1, 9}:
            source = next(  # noqa: PLW2901
                c for c in range(source, source + 4) if not hamming(c, d29, d30) & 3
            )
        parity = hamming(source, d29, d30)
        flip = 0x3F if d30 else 0
        out.append((d29 ^ d30) << 31 | source << 6 | parity ^ flip)
        d29, d30 = parity >> 1 & 1, parity & 1
    return tuple(out)


def lnav_subframe(number: int, tow_s: int, body: Bits) -> tuple[int, ...]:
    """Words of subframe `number` that starts at `tow_s` from the 192 bits of words 3 to 10."""
    count = (tow_s // LNAV_PERIOD_S + 1) % 100_800
    head = Bits().put_all(((LNAV_PREAMBLE, 8), (0, 16), (count, 17), (0, 2), (number, 3), (0, 2)))
    head.put_all([(body.value, body.length)])
    return lnav_words(head.words([24] * 10))


def lnav(ephemeris: Ephemeris, week: int, tow_s: int) -> tuple[tuple[int, ...], ...]:
    """Subframes 1, 2 and 3 sent from GPS time `week`, `tow_s`. Raises ValueError as `wire`."""
    w = wire(ephemeris)
    f = _Putter(w)
    one = Bits().put_all(
        ((week % 1024, 10), (1, 2), (w.accuracy, 4), (0 if w.healthy else 63, 6), (0, 2))
    )
    one.put_all(((0, 24), (0, 24), (0, 24), (0, 16), (w.group_delay[0], 8), (w.issue, 8)))
    f(one, "toc_s", "clock_drift_rate", "clock_drift", "clock_bias_s").put(0, 2)
    two = Bits().put(w.issue, 8)
    f(two, "crs", "mean_motion_correction", "mean_anomaly", "cuc", "eccentricity", "cus", "sqrt_a")
    f(two, "toe_s").put(0, 8)
    three = Bits()
    f(three, "cic", "ascending_node", "cis", "inclination", "crc", "perigee", "ascending_node_rate")
    f(three.put(w.issue, 8), "inclination_rate").put(0, 2)
    return tuple(
        lnav_subframe(k + 1, tow_s + k * LNAV_PERIOD_S, body)
        for k, body in enumerate((one, two, three))
    )


def lnav_ionosphere(model: Klobuchar, week: int, tow_s: int) -> tuple[int, ...]:
    """Subframe 4, page 18 (satellite id 56): ionosphere, and UTC without a clock difference."""
    body = Bits().put_all(((1, 2), (56, 6)))
    body.put_all((value, 8) for value in klobuchar_wire(model))
    utc = ((0, 24), (0, 32), (tow_s >> 12, 8), (week % 256, 8), (LEAP_SECONDS, 8), (week % 256, 8))
    body.put_all((*utc, (1, 8), (LEAP_SECONDS, 8), (0, 16)))
    return lnav_subframe(4, tow_s, body)


# ---------------------------------------------------------------------------- BeiDou


def bch(information: int) -> int:
    """Four parity bits of 11 information bits."""
    rest = information << 4
    for place in range(14, 3, -1):
        if rest >> place & 1:
            rest ^= 0b10011 << (place - 4)
    return rest


def beidou_words(information: Bits) -> tuple[int, ...]:
    """Words of 30 bits from 26 + 22 (n - 1) information bits."""
    count = 1 + (information.length - 26) // 22
    first, *others = information.words([26, *[22] * (count - 1)])
    out = [first << 4 | bch(first & 0x7FF)]
    for word in others:
        out.append(word << 8 | bch(word >> 11) << 4 | bch(word & 0x7FF))
    return tuple(out)


def _beidou_head(number: int, sow_s: int) -> Bits:
    return Bits().put_all(((BEIDOU_PREAMBLE, 11), (0, 4), (number, 3), (sow_s % 604_800, 20)))


def d1(
    ephemeris: Ephemeris, model: Klobuchar, week: int, sow_s: int
) -> tuple[tuple[int, ...], ...]:
    """D1 subframes 1, 2 and 3 sent from BDT `week`, `sow_s`. Raises ValueError as `wire`."""
    w = wire(ephemeris)
    f = _Putter(w)
    one = _beidou_head(1, sow_s)
    one.put_all(((not w.healthy, 1), (w.issue, 5), (w.accuracy, 4), (week % 8192, 13)))
    f(one, "toc_s").put_all((delay, 10) for delay in w.group_delay)
    one.put_all((value, 8) for value in klobuchar_wire(model))
    f(one, "clock_drift_rate", "clock_bias_s", "clock_drift").put(w.issue, 5)
    toe = w.raw["toe_s"]
    two = _beidou_head(2, sow_s + 6)
    f(two, "mean_motion_correction", "cuc", "mean_anomaly", "eccentricity", "cus", "crc", "crs")
    f(two, "sqrt_a").put(toe >> 15, 2)
    three = _beidou_head(3, sow_s + 12).put(toe & 0x7FFF, 15)
    f(three, "inclination", "cic", "ascending_node_rate", "cis", "inclination_rate")
    f(three, "ascending_node", "perigee").put(0, 1)
    return tuple(map(beidou_words, (one, two, three)))


def d2(
    ephemeris: Ephemeris, model: Klobuchar, week: int, sow_s: int
) -> tuple[tuple[int, ...], ...]:
    """The ten pages of D2 subframe 1 sent from BDT `week`, `sow_s`. Raises ValueError as `wire`.

    Words 6 to 10 are reserved; they are sent as zeros with their parity (which is zero).
    """
    w = wire(ephemeris)
    f = _Putter(w)
    first = Bits().put_all(((not w.healthy, 1), (w.issue, 5), (w.accuracy, 4), (week % 8192, 13)))
    f(first, "toc_s").put_all((delay, 10) for delay in w.group_delay).put(0, 12)
    ionosphere = Bits().put_all((value, 8) for value in klobuchar_wire(model)).put(0, 8)
    # Pages 3 to 10: the fields run on from page to page over reserved bits.
    stream = Bits().put(0, 38)
    f(stream, "clock_bias_s").put_all(_split(w, "clock_drift", 4, 6))
    f(stream, "clock_drift_rate").put(w.issue, 5)
    f(stream, "mean_motion_correction").put_all(_split(w, "cuc", 14, 8))
    f(stream, "mean_anomaly", "cus").put_all(_split(w, "eccentricity", 10, 8))
    f(stream, "sqrt_a").put_all(_split(w, "cic", 10, 8))
    f(stream, "cis", "toe_s").put_all(_split(w, "inclination", 21, 8))
    f(stream, "crc", "crs").put_all(_split(w, "ascending_node_rate", 19, 6))
    f(stream, "ascending_node").put_all(_split(w, "perigee", 27, 8))
    f(stream, "inclination_rate").put(0, 53)
    pages = [first.value, ionosphere.value, *stream.words([72] * 8)]
    out = []
    for k, page in enumerate(pages):
        bits = _beidou_head(1, sow_s + k * D2_PERIOD_S).put(k + 1, 4).put(page, 72)
        out.append(beidou_words(bits.put(0, 110)))
    return tuple(out)


def _split(w: Wire, name: str, upper: int, reserved: int) -> tuple[tuple[int, int], ...]:
    """Field with its upper bits at the end of a page, `reserved` bits, the rest on the next."""
    bits, value = FIELDS[w.system][name].bits, w.raw[name]
    low = bits - upper
    return (value >> low, upper), (0, reserved), (value & ((1 << low) - 1), low)


class _Putter:
    """Bit string to which fields of one ephemeris are appended by name."""

    def __init__(self, w: Wire) -> None:
        self.wire = w

    def __call__(self, bits: Bits, *names: str) -> Bits:
        fields = FIELDS[self.wire.system]
        return bits.put_all((self.wire.raw[name], fields[name].bits) for name in names)
