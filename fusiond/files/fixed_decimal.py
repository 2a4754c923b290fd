"""Compiled writer and reader of fixed-decimal tables: tens of ns a number.

A number v with d decimals is written as sign, floor(|v|), '.', and round(frac(|v|) 10^d). Both
parts of the split are exact in binary, so only a fraction that lies on a rounding tie can differ
from the correctly rounded decimal, by one unit of the last place. NaN is an empty cell; zero has
no sign; beyond 1e18 the cell reads `inf`, which no reader takes for a number.

A number is read as m / 10^d with integer m: where m <= 2^53 and d <= 22 both are exact in binary,
so the one rounding of the division gives the correctly rounded number (Clinger, How to read
floating point numbers accurately, PLDI 1990).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.navigation.compiled import compiled

MAX_CELL = 32
"""Bytes that a cell may touch: sign, 18 digits, point, 9 decimals and what fills three fours."""
MAX_DECIMALS = 9

_COMMA, _NEWLINE, _POINT, _MINUS, _ZERO = 44, 10, 46, 45, 48
_LIMIT = 1e18
_INF = int.from_bytes(b"inf", "little")

_UNITS = np.array([10**k for k in range(19)], dtype=np.int64)
_SCALES = np.array([10.0**k for k in range(MAX_DECIMALS + 1)])
_FILL = np.array([10 ** (-k % 4) for k in range(MAX_DECIMALS + 1)], dtype=np.uint64)
"""Padding of a number of decimals to a multiple of four."""
_DIGITS = _ZERO + np.arange(10**4)[:, np.newaxis] // (1000, 100, 10, 1) % 10
_FOURS = _DIGITS.astype(np.uint8).view("<u4").ravel().astype(np.uint32)
"""Digits of 0000 to 9999, the first in the lowest byte: one table access replaces four
divisions."""


@compiled("void(u1[::1], u8, u4)", forceinline=True)
def _put(out: NDArray[np.uint8], at: np.uint64, four: np.uint32) -> None:
    """Write four bytes at `out[at:]`, the lowest first.

    All indices are unsigned: numba checks a signed one for a negative value before each use.
    """
    for k in range(4):
        out[at + np.uint64(k)] = np.uint8(four >> np.uint32(8 * k))


@compiled("u8(u1[::1], u8, u8)", forceinline=True)
def _write_whole(out: NDArray[np.uint8], at: np.uint64, number: np.uint64) -> np.uint64:
    """Write a whole number at `out[at:]`; returns its end, after which three bytes may change."""
    if number < np.uint64(10):
        out[at] = np.uint8(np.uint64(_ZERO) + number)
        return at + np.uint64(1)
    digits = 2
    while digits < _UNITS.shape[0] and number >= np.uint64(_UNITS[digits]):
        digits += 1
    if digits <= 4:
        _put(out, at, _FOURS[number] >> np.uint32(32 - 8 * digits))
        return at + np.uint64(digits)
    end = at + np.uint64(digits)
    k = end
    while number:
        rest = number // np.uint64(10)
        k -= np.uint64(1)
        out[k] = np.uint8(np.uint64(_ZERO) + number - np.uint64(10) * rest)
        number = rest
    return end


@compiled("u8(u1[::1], u8, u8, u8)", forceinline=True)
def _write_part(
    out: NDArray[np.uint8], at: np.uint64, decimals: np.uint64, number: np.uint64
) -> np.uint64:
    """Write decimals as a whole number at `out[at:]`; returns the end, after which three bytes may
    change."""
    end = at + decimals
    number *= _FILL[decimals]
    if decimals > np.uint64(8):
        first = number // np.uint64(10**8)
        number -= np.uint64(10**8) * first
        _put(out, at, _FOURS[first])
        at += np.uint64(4)
    if decimals > np.uint64(4):
        first = number // np.uint64(10**4)
        number -= np.uint64(10**4) * first
        _put(out, at, _FOURS[first])
        at += np.uint64(4)
    _put(out, at, _FOURS[number])
    return end


@compiled("i8(f8[:, ::1], i8[::1], i8[::1], u1[:, ::1], u1[::1])", nogil=True)
def format_rows(
    values: NDArray[np.float64],
    decimals: NDArray[np.int64],
    codes: NDArray[np.int64],
    labels: NDArray[np.uint8],
    out: NDArray[np.uint8],
) -> int:
    """Write rows of numbers, each ended by its label and a newline; returns the bytes written.

    `values` (n, m); `decimals` (m,), 0 to 9; `codes` (n,) choose a row of `labels` (k, w), ASCII
    padded with zeros, and an unknown code gives an empty label; with w = 0 rows end after their
    last number. `out` holds at least n (32 m + w + 1) bytes.
    """
    n, m = values.shape
    at, one = np.uint64(0), np.uint64(1)
    for i in range(n):
        for j in range(m):
            v = values[i, j]
            magnitude = abs(v)
            if magnitude < _LIMIT:
                d = np.uint64(decimals[j])
                unit = _UNITS[d]
                whole = np.int64(magnitude)
                part = np.int64(np.rint((magnitude - np.float64(whole)) * _SCALES[d]))
                if part >= unit:
                    whole += 1
                    part -= unit
                if v < 0.0 and (whole > 0 or part > 0):
                    out[at] = _MINUS
                    at += one
                at = _write_whole(out, at, np.uint64(whole))
                if d:
                    out[at] = _POINT
                    at = _write_part(out, at + one, d, np.uint64(part))
            elif magnitude >= _LIMIT:
                if v < 0.0:
                    out[at] = _MINUS
                    at += one
                _put(out, at, np.uint32(_INF))
                at += np.uint64(3)
            out[at] = _COMMA
            at += one
        code = codes[i]
        if labels.shape[1] == 0:
            at -= one
        elif 0 <= code < labels.shape[0]:
            for k in range(labels.shape[1]):
                if labels[code, k] == 0:
                    break
                out[at] = labels[code, k]
                at += one
        out[at] = _NEWLINE
        at += one
    return int(at)


_EXACT = 2**53
_EXACT_FOUR, _EXACT_EIGHT = _EXACT // 10**4, _EXACT // 10**8
"""Largest numbers that remain exact, or within 64 bits, with four or eight more digits."""
_POWERS = np.array([10.0**k for k in range(23)])
_ZEROS, _OVER, _HIGH = (np.uint64(byte * 0x0101010101010101) for byte in (_ZERO, 0x76, 0x80))
_NEWLINES, _LOW = (np.uint64(byte * 0x0101010101010101) for byte in (_NEWLINE, 0x7F))
_ONES = np.uint64(0x0101010101010101)


@compiled("i8(u8[::1])", nogil=True)
def _newlines(words: NDArray[np.uint64]) -> int:
    """Count the newlines: bytes of which nothing is left after the exclusive or."""
    found = np.uint64(0)
    for i in range(words.shape[0]):
        rest = words[i] ^ _NEWLINES
        something = ((rest & _LOW) + _LOW) | rest | _LOW
        found += ((~something >> np.uint64(7)) * _ONES) >> np.uint64(56)
    return int(found)


def newlines(text: NDArray[np.uint8]) -> int:
    """Number of digits in a text (n,) at the start of its memory."""
    whole = len(text) // 8 * 8
    words = _newlines(text[:whole].view(np.uint64))
    return words + int(np.count_nonzero(text[whole:] == _NEWLINE))


@compiled("u8(u1[::1], u8)", forceinline=True)
def _eight(text: NDArray[np.uint8], at: np.uint64) -> np.uint64:
    """Eight bytes, the first lowest, with '0' subtracted from digits."""
    word = np.uint64(0)
    for k in range(8):
        word |= np.uint64(text[at + np.uint64(k)]) << np.uint64(8 * k)
    return word ^ _ZEROS


@compiled("u8(u8)", forceinline=True)
def _joined(digits: np.uint64) -> np.uint64:
    """Number of eight digits, the first lowest: pairs are joined, then fours, then all."""
    pairs = np.uint64(10) * digits + (digits >> np.uint64(8))
    odd, even = pairs & np.uint64(0xFF000000FF), (pairs >> np.uint64(16)) & np.uint64(0xFF000000FF)
    odd *= np.uint64((1000000 << 32) + 100)
    even *= np.uint64((10000 << 32) + 1)
    return (odd + even) >> np.uint64(32)


@compiled("UniTuple(u8, 2)(u1[::1], u8, u8)", forceinline=True)
def _digits(
    text: NDArray[np.uint8], at: np.uint64, number: np.uint64
) -> tuple[np.uint64, np.uint64]:
    """Append the digits from `at` on to `number`; return it and the place where they end or the
    number is too large."""
    while at < np.uint64(text.shape[0]) and number <= np.uint64(_EXACT):
        digit = np.uint8(text[at] - np.uint8(_ZERO))
        if digit > np.uint8(9):
            break
        number = np.uint64(10) * number + np.uint64(digit)
        at += np.uint64(1)
    return number, at


@compiled("UniTuple(u8, 2)(u1[::1], u8, u8)", forceinline=True)
def _many_digits(
    text: NDArray[np.uint8], at: np.uint64, number: np.uint64
) -> tuple[np.uint64, np.uint64]:
    """Number of digits, as `_digits`, tested eight or four at once."""
    if at + np.uint64(8) <= np.uint64(text.shape[0]):
        word = _eight(text, at)
        # No carry comes of a digit, so that those before the first other byte are seen as such.
        others = ((word + _OVER) | word) & _HIGH
        if others == np.uint64(0) and number <= np.uint64(_EXACT_EIGHT):
            number = np.uint64(10**8) * number + _joined(word)
            at += np.uint64(8)
        elif others << np.uint64(32) == np.uint64(0) and number <= np.uint64(_EXACT_FOUR):
            number = np.uint64(10**4) * number + _joined(word << np.uint64(32))
            at += np.uint64(4)
    return _digits(text, at, number)


@compiled("b1(u1[::1], i8, f8[:, ::1])", nogil=True)
def parse_rows(text: NDArray[np.uint8], begin: int, values: NDArray[np.float64]) -> bool:
    """Parse `values` (columns, rows) from `text[begin:]`, rows of cells separated by commas.

    False, with `values` in part written, if a cell is anything but an optional sign, digits and an
    optional point (at most 2^53 without the point), or if there are more or fewer cells.
    """
    columns, rows = values.shape
    at, end, one = np.uint64(begin), np.uint64(text.shape[0]), np.uint64(1)
    for row in range(rows):
        for column in range(columns):
            negative = at < end and text[at] == _MINUS
            if negative:
                at += one
            first = at
            number, at = _digits(text, at, np.uint64(0))
            digits, decimals = at - first, np.uint64(0)
            if at < end and text[at] == _POINT:
                first = at + one
                number, at = _many_digits(text, first, number)
                decimals = at - first
                digits += decimals
            if digits == 0 or number > np.uint64(_EXACT) or decimals >= _POWERS.shape[0]:
                return False
            value = float(np.int64(number)) / _POWERS[decimals]
            values[column, row] = -value if negative else value
            if column < columns - 1:
                if at >= end or text[at] != _COMMA:
                    return False
                at += one
        if at < end and text[at] == 13:  # carriage return
            at += one
        if at < end:
            if text[at] != _NEWLINE:
                return False
            at += one
        elif row < rows - 1:
            return False
    return bool(at == end)
