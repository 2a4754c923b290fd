"""Bit positions of a message's signals, precomputed so that a frame is read as one integer.

A frame's data is one number N, little-endian for Intel's signals and big-endian for Motorola's. A
signal of n bits is

    raw = N >> shift & (2^n - 1),   signed: (raw ^ 2^(n-1)) - 2^(n-1)

shift = start for Intel, whose start is the least significant bit. Motorola's is the most
significant one, counted as bit s of byte b: 8 b + s; in L bytes shift = 8 (L - 1 - b) + s - n + 1.
A signal under multiplexers is there while each of them has one of the values that select it.

Signals that fill whole bytes of one byte order, as those of most devices do, are one `struct`.

Source: Vector Informatik, DBC File Format Documentation 1.0.5, signal definitions.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from cantools.database.can import Message
from cantools.database.can.signal import Signal

_FLOATS = {16: struct.Struct(">e"), 32: struct.Struct(">f"), 64: struct.Struct(">d")}
_CODES = {8: "B", 16: "H", 32: "I", 64: "Q"}


class AbsentSignalError(Exception):
    """A frame does not hold a signal: its multiplexer says so, or the message is too short."""


class _Bits(NamedTuple):
    """Bits of a signal; `sign`: the value of its sign bit, 0 without one."""

    big: bool
    shift: int
    mask: int
    sign: int
    floating: struct.Struct | None


class Layout:
    """Layout of some signals of a message, by name."""

    def __init__(self, message: Message, wanted: Sequence[str]) -> None:
        self._length = message.length
        signals = {signal.name: signal for signal in message.signals}
        self._wanted: list[_Bits] = []
        self._selectors: list[tuple[_Bits, Container[int]]] = []
        self._readable = True
        for name in wanted:
            signal: Signal | None = signals[name]
            self._wanted.append(self._bits(signals[name]))
            while signal is not None and signal.multiplexer_signal is not None:
                parent = signals[signal.multiplexer_signal]
                self._selectors.append(
                    (self._bits(parent), frozenset(signal.multiplexer_ids or ()))
                )
                signal = parent
        used = (*self._wanted, *(bits for bits, _ in self._selectors))
        self._little, self._big = any(not b.big for b in used), any(b.big for b in used)
        self._struct = None if self._selectors or not self._readable else self._as_struct()

    def raw(self, data: bytes) -> list[Any]:
        """Raw numbers of the signals, in order, from a frame's data of at least the message's
        length. Raises `AbsentSignalError`."""
        if self._struct is not None:
            return list(self._struct.unpack_from(data))
        if not self._readable:
            raise AbsentSignalError
        little = int.from_bytes(data, "little") if self._little else 0
        big = int.from_bytes(data[: self._length], "big") if self._big else 0
        for bits, values in self._selectors:
            if (big if bits.big else little) >> bits.shift & bits.mask not in values:
                raise AbsentSignalError
        numbers: list[Any] = []
        for of_big, shift, mask, sign, floating in self._wanted:
            number = (big if of_big else little) >> shift & mask
            if floating is not None:
                (number,) = floating.unpack(number.to_bytes(floating.size, "big"))
            elif sign:
                number = (number ^ sign) - sign
            numbers.append(number)
        return numbers

    def _as_struct(self) -> struct.Struct | None:
        """Reader of the wanted signals at once; None where they are not whole bytes of one byte
        order, one after the other."""
        places = [self._place(bits) for bits in self._wanted]
        disjoint = all(before[1] <= after[0] for before, after in pairwise(places))
        whole = all(b.shift % 8 == 0 and b.mask.bit_length() in _CODES for b in self._wanted)
        if not places or not disjoint or not whole or (self._little and self._big):
            return None
        codes, at = [">" if self._big else "<"], 0
        for bits, (begin, end) in zip(self._wanted, places, strict=True):
            code = _CODES[bits.mask.bit_length()]
            if bits.floating is not None:
                code = bits.floating.format[-1:]
            codes.append(f"{begin - at}x{code.lower() if bits.sign else code}")
            at = end
        return struct.Struct("".join(codes))

    def _place(self, bits: _Bits) -> tuple[int, int]:
        """Range of bytes of a signal of whole bytes."""
        begin, size = bits.shift // 8, bits.mask.bit_length() // 8
        if bits.big:
            begin = self._length - begin - size
        return begin, begin + size

    def _bits(self, signal: Signal) -> _Bits:
        shift = signal.start
        big = signal.byte_order == "big_endian"
        if big:
            byte, bit = divmod(signal.start, 8)
            shift = 8 * (self._length - 1 - byte) + bit - signal.length + 1
        self._readable &= 0 <= shift <= 8 * self._length - signal.length
        sign = 1 << signal.length - 1 if signal.is_signed and not signal.is_float else 0
        floating = _FLOATS.get(signal.length) if signal.is_float else None
        self._readable &= floating is not None or not signal.is_float
        return _Bits(big, max(0, shift), (1 << signal.length) - 1, sign, floating)
