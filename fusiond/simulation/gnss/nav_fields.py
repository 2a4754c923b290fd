r"""Broadcast ephemerides as the integers that a navigation message carries.

    value = integer * scale,   integer of `bits`, two's complement where signed

One table for GPS LNAV and one for BeiDou D1/D2; RTCM 1019 and 1042 carry the same integers. Angles
are semicircles on the wire (pi rad), group delays of BeiDou tenths of a ns, toe and toc units of
16 s (GPS) or 8 s (BeiDou).

Source: IS-GPS-200N tables 20-I, 20-III and 20-X; BDS-SIS-ICD-B1I-3.0 tables 5-4, 5-8, 5-9 and 5-10.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from drivers.raw.messages import Ephemeris, Klobuchar, System
from drivers.raw.subframes import ura_m

SEMICIRCLE = math.pi


class Field(NamedTuple):
    """Number in the message."""

    bits: int
    scale: float
    signed: bool = True

    def encode(self, value: float) -> int:
        """Nearest integer, two's complement in `bits`. Raises ValueError out of range."""
        raw = round(value / self.scale)
        low = -(1 << (self.bits - 1)) if self.signed else 0
        if not low <= raw < low + (1 << self.bits):
            raise ValueError(f"{value} does not fit {self.bits} bits of {self.scale}")
        return raw & ((1 << self.bits) - 1)

    def decode(self, raw: int) -> float:
        """Value of an integer made by `encode`."""
        if self.signed and raw >> (self.bits - 1):
            raw -= 1 << self.bits
        return raw * self.scale


_ORBIT = {
    "eccentricity": Field(32, 2.0**-33, False),
    "sqrt_a": Field(32, 2.0**-19, False),
    "mean_anomaly": Field(32, SEMICIRCLE * 2.0**-31),
    "ascending_node": Field(32, SEMICIRCLE * 2.0**-31),
    "inclination": Field(32, SEMICIRCLE * 2.0**-31),
    "perigee": Field(32, SEMICIRCLE * 2.0**-31),
    "mean_motion_correction": Field(16, SEMICIRCLE * 2.0**-43),
    "inclination_rate": Field(14, SEMICIRCLE * 2.0**-43),
    "ascending_node_rate": Field(24, SEMICIRCLE * 2.0**-43),
}
FIELDS: dict[System, dict[str, Field]] = {
    "G": {
        **_ORBIT,
        **dict.fromkeys(("cuc", "cus", "cic", "cis"), Field(16, 2.0**-29)),
        **dict.fromkeys(("crc", "crs"), Field(16, 2.0**-5)),
        **dict.fromkeys(("toe_s", "toc_s"), Field(16, 16.0, False)),
        "clock_bias_s": Field(22, 2.0**-31),
        "clock_drift": Field(16, 2.0**-43),
        "clock_drift_rate": Field(8, 2.0**-55),
    },
    "C": {
        **_ORBIT,
        **dict.fromkeys(("cuc", "cus", "cic", "cis"), Field(18, 2.0**-31)),
        **dict.fromkeys(("crc", "crs"), Field(18, 2.0**-6)),
        **dict.fromkeys(("toe_s", "toc_s"), Field(17, 8.0, False)),
        "clock_bias_s": Field(24, 2.0**-33),
        "clock_drift": Field(22, 2.0**-50),
        "clock_drift_rate": Field(11, 2.0**-66),
    },
}
GROUP_DELAY: dict[System, Field] = {"G": Field(8, 2.0**-31), "C": Field(10, 1e-10)}
ALPHA = tuple(Field(8, 2.0**power) for power in (-30, -27, -24, -24))
BETA = tuple(Field(8, 2.0**power) for power in (11, 14, 16, 16))


@dataclass(frozen=True, slots=True)
class Wire:
    """Ephemeris as integers: `raw` by field name of `Ephemeris`, the other fields as attributes."""

    system: System
    prn: int
    week: int
    raw: dict[str, int]
    group_delay: tuple[int, ...]
    accuracy: int
    issue: int
    healthy: bool


def wire(ephemeris: Ephemeris) -> Wire:
    """Integers of a GPS or BeiDou ephemeris. Raises ValueError for a value that no message can
    carry."""
    system = ephemeris.system
    if system not in FIELDS:
        raise ValueError(f"no message for system {system}")
    limit = math.inf if ephemeris.accuracy_m is None else ephemeris.accuracy_m
    return Wire(
        system,
        ephemeris.prn,
        ephemeris.week,
        {name: f.encode(getattr(ephemeris, name)) for name, f in FIELDS[system].items()},
        tuple(GROUP_DELAY[system].encode(delay) for delay in ephemeris.group_delay_s),
        _accuracy_index(limit),
        ephemeris.issue,
        ephemeris.healthy,
    )


def _accuracy_index(accuracy_m: float) -> int:
    """Least index (URA, URAI) whose accuracy is not better than the true one; 15 states none."""
    for index in range(15):
        stated = ura_m(index)
        if stated is not None and accuracy_m <= stated:
            return index
    return 15


def quantised(ephemeris: Ephemeris) -> Ephemeris:
    """Ephemeris after encoding and decoding. Raises ValueError as `wire`."""
    system, numbers = ephemeris.system, wire(ephemeris)
    values: dict[str, Any] = {
        name: f.decode(numbers.raw[name]) for name, f in FIELDS[system].items()
    }
    delays = tuple(GROUP_DELAY[system].decode(raw) for raw in numbers.group_delay)
    return replace(ephemeris, **values, group_delay_s=delays, accuracy_m=ura_m(numbers.accuracy))


def klobuchar_wire(model: Klobuchar) -> tuple[int, ...]:
    """Eight integers: alpha 0 to 3, beta 0 to 3. Raises ValueError out of range."""
    fields, values = (*ALPHA, *BETA), (*model.alpha, *model.beta)
    return tuple(f.encode(value) for f, value in zip(fields, values, strict=True))


class Bits:
    """A string of bits, most significant first."""

    def __init__(self) -> None:
        self.value = 0
        self.length = 0

    def put(self, value: int, bits: int) -> Bits:
        """Append the low `bits` of an integer. Raises ValueError if it has more, or is negative."""
        if value < 0 or value >> bits:
            raise ValueError(f"{value} does not fit {bits} bits")
        self.value = self.value << bits | value
        self.length += bits
        return self

    def put_all(self, items: Iterable[tuple[int, int]]) -> Bits:
        """Append (value, bits) pairs."""
        for value, bits in items:
            self.put(value, bits)
        return self

    def words(self, lengths: Iterable[int]) -> list[int]:
        """Split into words of these lengths. Raises ValueError unless they add up."""
        lengths = list(lengths)
        if sum(lengths) != self.length:
            raise ValueError(f"{self.length} bits, not {sum(lengths)}")
        out, left = [], self.length
        for bits in lengths:
            left -= bits
            out.append(self.value >> left & ((1 << bits) - 1))
        return out

    def to_bytes(self) -> bytes:
        """Whole bytes, the last one filled up with zeros."""
        size = -(-self.length // 8)
        return (self.value << (8 * size - self.length)).to_bytes(size, "big")
