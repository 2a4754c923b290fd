"""Fixed-decimal text of a table of numbers, written and read compiled: tens of ns a number.

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
"""What makes of so many decimals a multiple of four."""
_DIGITS = _ZERO + np.arange(10**4)[:, np.newaxis] // (1000, 100, 10, 1) % 10
_FOURS = _DIGITS.astype(np.uint8).view("<u4").ravel().astype(np.uint32)
"""The digits of 0000 to 9999, the first in the lowest byte: one look instead of four divisions."""


@compiled("void(u1[::1], u8, u4)", forceinline=True)
def _put(out: NDArray[np.uint8], at: np.uint64, four: np.uint32) -> None:
    """Write four bytes at `out[at:]`, the lowest first.

    All is unsigned, since an index that may be negative is looked at before each use.
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
    """Write so many decimals, as a whole number, at `out[at:]`; returns their end, after which
    three bytes may change."""
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
_POWERS = np.array([10.0**k for k in range(23)])


@compiled("b1(u1[::1], i8, f8[:, ::1])", nogil=True)
def parse_rows(text: NDArray[np.uint8], at: int, values: NDArray[np.float64]) -> bool:
    """Read `values` (columns, rows) from `text[at:]`, rows of cells with a comma in between.

    False, with `values` in part written, if a cell is anything but an optional sign, digits and an
    optional point (at most 2^53 without the point), or if there are more or fewer cells.
    """
    columns, rows = values.shape
    end = text.shape[0]
    for row in range(rows):
        for column in range(columns):
            negative = at < end and text[at] == _MINUS
            if negative:
                at += 1
            number, digits, decimals = 0, 0, -1
            while at < end:
                byte = text[at]
                if 48 <= byte <= 57:
                    number = 10 * number + (byte - 48)
                    if number > _EXACT:
                        return False
                    digits += 1
                    decimals += decimals >= 0
                elif byte == _POINT and decimals < 0:
                    decimals = 0
                else:
                    break
                at += 1
            if digits == 0 or decimals >= _POWERS.shape[0]:
                return False
            value = float(number)
            if decimals > 0:
                value /= _POWERS[decimals]
            values[column, row] = -value if negative else value
            if column < columns - 1:
                if at >= end or text[at] != _COMMA:
                    return False
                at += 1
        if at < end and text[at] == 13:  # carriage return
            at += 1
        if at < end:
            if text[at] != _NEWLINE:
                return False
            at += 1
        elif row < rows - 1:
            return False
    return bool(at == end)
