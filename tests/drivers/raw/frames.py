"""Bytes that a receiver would send: UBX frames, and broadcast words with their parity."""

from __future__ import annotations

import functools
import random
import struct
from typing import Any

from drivers.nmea.incremental_checksum import crc24q
from drivers.raw.lnav import parity
from drivers.raw.messages import Ephemeris

# One measurement of UBX-RXM-RAWX: range, carrier, Doppler, gnssId, svId, sigId, freqId, lock time,
# C/N0, sigma codes of range, carrier and Doppler, tracking status.
GOOD = (2.2e7, 1.1e8, -1000.0, 0, 5, 0, 0, 1000, 45, 5, 1, 6, 7)


def ubx(class_id: bytes, payload: bytes) -> bytes:
    covered = class_id + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in covered:
        a = (a + byte) % 256
        b = (b + a) % 256
    return b"\xb5\x62" + covered + bytes([a, b])


def rtcm(payload: bytes) -> bytes:
    frame = b"\xd3" + len(payload).to_bytes(2, "big") + payload
    return frame + crc24q(frame).to_bytes(3, "big")


def measurement(**changed: Any) -> tuple[Any, ...]:
    names = ("range", "carrier", "doppler", "gnss", "prn", "sig", "freq", "lock", "cno")
    names += ("sd_range", "sd_carrier", "sd_doppler", "track")
    values = dict(zip(names, GOOD, strict=True)) | changed
    return tuple(values[name] for name in names)


def rawx(
    *measurements: tuple[Any, ...],
    tow_s: float = 345_600.25,
    week: int = 2440,
    leap: int = 18,
    status: int = 1,
) -> bytes:
    head = struct.pack("<dHbBB3x", tow_s, week, leap, len(measurements), status)
    body = b"".join(struct.pack("<ddfBBBBHBBBBBx", *m) for m in measurements)
    return ubx(b"\x02\x15", head + body)


def sfrbx(gnss: int, prn: int, sig: int, words: list[int]) -> bytes:
    head = struct.pack("<BBBBBBBB", gnss, prn, sig, 0, len(words), 3, 2, 0)
    return ubx(b"\x02\x13", head + struct.pack(f"<{len(words)}I", *words))


def put(value: int, total: int, at: int, length: int, field: int) -> int:
    """`value` of `total` bits with `field` in `length` bits from bit `at`."""
    shift = total - at - length
    return value & ~(((1 << length) - 1) << shift) | (field & (1 << length) - 1) << shift


def lnav_words(bits: int) -> list[int]:
    """Ten words of 240 bits, the last two bits of the word before on top, as u-blox sends them."""
    words, last = [], 0
    for i in range(10):
        word = last << 30 | (bits >> (216 - 24 * i) & 0xFFFFFF) << 6
        words.append(word | parity(word))
        last = words[-1] & 3
    return words


@functools.cache
def _bch(eleven: int) -> int:
    rest = eleven << 4
    for bit in range(14, 3, -1):
        if rest >> bit & 1:
            rest ^= 0b10011 << (bit - 4)
    return rest


def beidou_words(bits: int) -> list[int]:
    """Ten words of 224 information bits, deinterleaved as u-blox sends them."""
    words = [bits >> 198 << 4 | _bch(bits >> 198 & 0x7FF)]
    for i in range(9):
        both = bits >> (176 - 22 * i) & 0x3FFFFF
        words.append(both << 8 | _bch(both >> 11) << 4 | _bch(both & 0x7FF))
    return words


def inav_words(data: int, alert: int = 0) -> list[int]:
    """The eight words of a page with 128 data bits."""
    even = alert << 112 | data >> 16
    odd = (1 << 81) | alert << 80 | (data & 0xFFFF) << 64
    crc = crc24q((even << 82 | odd).to_bytes(25, "big"))
    page = (even << 14) << 128 | (odd << 24 | crc) << 22
    return [page >> (224 - 32 * i) & 0xFFFFFFFF for i in range(8)]


SQRT_A, ECCENTRICITY = 5153 << 19, 123_456_789
"""5153 m^1/2 in 2^-19 and 0.0144 in 2^-33, as every message sends them."""


def lnav(seed: int, issue: int = 77) -> list[list[int]]:
    """Subframes 1, 2 and 3 of random bits and one issue, as words."""
    rng, frames = random.Random(seed), []
    for number in (1, 2, 3):
        bits = put(rng.getrandbits(240), 240, 0, 8, 0x8B)
        bits = put(bits, 240, 24, 17, 57_600 + number)  # the next subframe's start over 6 s
        bits = put(bits, 240, 43, 3, number)
        bits = put(bits, 240, {1: 168, 2: 48, 3: 216}[number], 8, issue)
        if number == 1:
            bits = put(bits, 240, 48, 10, 2450 % 1024)
        if number == 2:
            bits = put(bits, 240, 136, 32, ECCENTRICITY)
            bits = put(bits, 240, 184, 32, SQRT_A)
            bits = put(bits, 240, 216, 16, 21_600 + seed)  # near the transmission, in 16 s
        frames.append(lnav_words(bits))
    return frames


def beidou_header(bits: int, number: int, sow: int) -> int:
    for at, length, field in ((0, 11, 0b11100010010), (15, 3, number), (18, 20, sow)):
        bits = put(bits, 224, at, length, field)
    return bits


def d1(seed: int, sow: int = 345_600, toe: int = 43_200) -> list[list[int]]:
    """Subframes 1, 2 and 3 of random bits; `toe` in 8 s."""
    rng, frames = random.Random(seed), []
    for number in (1, 2, 3):
        bits = beidou_header(rng.getrandbits(224), number, sow + 6 * (number - 1))
        if number == 1:
            bits = put(put(bits, 224, 48, 13, 1094), 224, 61, 17, toe)
        elif number == 2:
            bits = put(put(bits, 224, 104, 32, ECCENTRICITY), 224, 190, 32, SQRT_A)
            bits = put(bits, 224, 222, 2, toe >> 15)
        else:
            bits = put(bits, 224, 38, 15, toe)
        frames.append(beidou_words(bits))
    return frames


def d2(seed: int, sow: int = 345_600, toe: int = 43_200) -> list[list[int]]:
    """The ten pages of random bits; `toe` in 8 s."""
    rng, pages = random.Random(seed), []
    for page in range(1, 11):
        bits = beidou_header(rng.getrandbits(224), 1, sow + 3 * (page - 1))
        bits = put(bits, 224, 38, 4, page)
        if page == 1:
            bits = put(put(bits, 224, 52, 13, 1094), 224, 65, 17, toe)
        elif page == 5:
            bits = put(bits, 224, 96, 10, ECCENTRICITY >> 22)
        elif page == 6:
            bits = put(put(bits, 224, 42, 22, ECCENTRICITY), 224, 64, 32, SQRT_A)
        elif page == 7:
            bits = put(bits, 224, 68, 17, toe)
        pages.append(beidou_words(bits))
    return pages


def inav(seed: int, prn: int = 7, issue: int = 77) -> list[list[int]]:
    """Data words 1 to 5, as they come in an E1 subframe: 2, 4, 1, 3, 5."""
    rng, pages = random.Random(seed), []
    for kind in (2, 4, 1, 3, 5):
        data = put(rng.getrandbits(128), 128, 0, 6, kind)
        if kind < 5:
            data = put(data, 128, 6, 10, issue)
        if kind == 1:
            data = put(data, 128, 16, 14, 5760 + seed)  # 60 s
            data = put(put(data, 128, 62, 32, ECCENTRICITY), 128, 94, 32, SQRT_A)
        elif kind == 4:
            data = put(put(data, 128, 16, 6, prn), 128, 54, 14, 5760 + seed)
        elif kind == 5:
            data = put(put(data, 128, 73, 12, 1426), 128, 85, 20, 345_600)
        pages.append(inav_words(data))
    return pages


def with_crc(bits: int, length: int, words: int) -> list[int]:
    """`length` bits, their CRC-24Q and zeros in so many words."""
    whole = bits << 24 | crc24q(bits.to_bytes(length // 8, "big"))
    whole <<= 32 * words - length - 24
    return [whole >> (32 * (words - 1 - i)) & 0xFFFFFFFF for i in range(words)]


def _bcnav_orbit(bits: int, total: int, at: int) -> int:
    """A MEO's Ephemeris I, near its reference axis and with 0.0144 as above."""
    bits = put(put(bits, total, at, 11, 1152), total, at + 11, 2, 3)
    return put(put(bits, total, at + 13, 26, 12345), total, at + 137, 33, ECCENTRICITY << 1)


def bcnav1(seed: int, issue: int = 77, health: int = 0) -> list[list[int]]:
    """Subframes 2 and 3 of random bits."""
    rng = random.Random(seed)
    two = put(put(rng.getrandbits(576), 576, 0, 13, 1094), 576, 13, 8, 96)
    two = put(put(two, 576, 21, 10, issue), 576, 31, 8, issue)
    two = _bcnav_orbit(two, 576, 39)
    three = put(rng.getrandbits(240), 240, 6, 4, health)
    return [with_crc(two, 576, 19), with_crc(three, 240, 9)]


def bcnav2(seed: int, prn: int = 21, issue: int = 77, sow_s: int = 345_600) -> list[list[int]]:
    """Messages 10, 11 and 30 of random bits."""
    rng, found = random.Random(seed), []
    for number, kind in enumerate((10, 11, 30)):
        bits = put(put(rng.getrandbits(264), 264, 0, 6, prn), 264, 6, 6, kind)
        bits = put(bits, 264, 12, 18, sow_s // 3 + number)
        if kind == 10:
            bits = put(put(bits, 264, 30, 13, 1094), 264, 53, 8, issue)
            bits = _bcnav_orbit(bits, 264, 61)
        else:
            bits = put(bits, 264, 30, 4, 0)
        if kind == 30:
            bits = put(bits, 264, 111, 10, issue)
        found.append(with_crc(bits, 264, 9))
    return found


def oracle_fields(eph: Any) -> dict[str, float]:
    """Of an `eph_t` of RTKLIB, by our names."""
    return {
        "toe_s": eph.toes,
        "sqrt_a": eph.A**0.5,
        "eccentricity": eph.e,
        "inclination": eph.i0,
        "ascending_node": eph.OMG0,
        "perigee": eph.omg,
        "mean_anomaly": eph.M0,
        "mean_motion_correction": eph.deln,
        "inclination_rate": eph.idot,
        "ascending_node_rate": eph.OMGd,
        "cuc": eph.cuc,
        "cus": eph.cus,
        "crc": eph.crc,
        "crs": eph.crs,
        "cic": eph.cic,
        "cis": eph.cis,
        "clock_bias_s": eph.f0,
        "clock_drift": eph.f1,
        "clock_drift_rate": eph.f2,
    }


def differences(ours: Ephemeris, eph: Any) -> dict[str, tuple[float, float]]:
    """Fields that differ by more than rounding (sqrt_a is squared and rooted by the oracle)."""
    found = {}
    for name, theirs in oracle_fields(eph).items():
        mine = getattr(ours, name)
        if abs(mine - theirs) > 2e-15 * max(abs(mine), abs(theirs)):
            found[name] = (mine, theirs)
    for i, delay in enumerate(ours.group_delay_s):
        if abs(delay - eph.tgd[i]) > 1e-22:
            found[f"group_delay_s[{i}]"] = (delay, eph.tgd[i])
    return found
