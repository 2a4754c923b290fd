"""Bit strings of broadcast messages and the scaled numbers in them, by table.

    value = n * 2^exponent            n: `length` bits from bit `at`, most significant first,
                                      two's complement where signed; angles times PI

A table has the start, the length and the weight of the last bit of each number. Bits count from 0
in a string without parity and headers, so that a number which the message splits over two words or
pages is in one piece.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

PI = 3.1415926535898
"""The value that IS-GPS-200 (20.3.3.4.3), BDS-SIS-ICD-B1I and the Galileo OS SIS ICD prescribe."""


@dataclass(frozen=True, slots=True)
class Bits:
    """`length` bits in the integer `value`; bit 0 is the most significant one."""

    value: int
    length: int

    def unsigned(self, at: int, length: int) -> int:
        """`length` bits from bit `at`."""
        return self.value >> (self.length - at - length) & ((1 << length) - 1)

    def signed(self, at: int, length: int) -> int:
        """Two's complement number."""
        n = self.unsigned(at, length)
        return n - (1 << length) if n >> (length - 1) else n

    def cut(self, start: int, end: int) -> Bits:
        """Bits from `start` to before `end`."""
        return Bits(self.unsigned(start, end - start), end - start)

    @classmethod
    def join(cls, *parts: Bits) -> Bits:
        """Concatenate bit strings."""
        value = length = 0
        for part in parts:
            value = value << part.length | part.value
            length += part.length
        return cls(value, length)

    @classmethod
    def of_bytes(cls, data: bytes) -> Bits:
        return cls(int.from_bytes(data, "big"), 8 * len(data))


@dataclass(frozen=True, slots=True)
class Number:
    """Number in a message: see the module."""

    at: int
    length: int
    signed: bool = False
    exponent: int = 0
    factor: float = 1.0

    def read(self, bits: Bits) -> float:
        n = (
            bits.signed(self.at, self.length)
            if self.signed
            else bits.unsigned(self.at, self.length)
        )
        return n * 2.0**self.exponent * self.factor


def u(at: int, length: int, exponent: int = 0, factor: float = 1.0) -> Number:
    """Unsigned number."""
    return Number(at, length, False, exponent, factor)


def s(at: int, length: int, exponent: int = 0, factor: float = 1.0) -> Number:
    """Signed number."""
    return Number(at, length, True, exponent, factor)


def angle(at: int, length: int, exponent: int) -> Number:
    """Signed, sent in semicircles (or semicircles per second), read in rad."""
    return Number(at, length, True, exponent, PI)


Table = dict[str, Number]


def read(bits: Bits, table: Table) -> dict[str, Any]:
    """Numbers of `table` by name, as floats."""
    return {name: number.read(bits) for name, number in table.items()}


def bdgim_table(at: int) -> tuple[Number, ...]:
    """Table of BDGIM's nine coefficients in eighths of a TECU, 74 bits from bit `at` (table 7-10 of
    BDS-SIS-ICD-B1C-1.0): the third and fourth have no sign, the fifth is always negative."""
    first = u(at, 10, -3), s(at + 10, 8, -3)
    mean = u(at + 18, 8, -3), u(at + 26, 8, -3), u(at + 34, 8, -3, -1.0)
    return (*first, *mean, *(s(at + k, 8, -3) for k in (42, 50, 58, 66)))


KlobucharTable = tuple[tuple[Number, ...], tuple[Number, ...]]


def klobuchar_table(at: int) -> KlobucharTable:
    """Table of alpha and beta of GPS and BeiDou, eight bits each, from bit `at` on."""
    alpha = tuple(s(at + 8 * i, 8, e) for i, e in enumerate((-30, -27, -24, -24)))
    beta = tuple(s(at + 32 + 8 * i, 8, e) for i, e in enumerate((11, 14, 16, 16)))
    return alpha, beta
