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
"""Bytes of the longest cell with its comma: sign, 18 digits, point, 9 decimals, comma."""
MAX_DECIMALS = 9

_COMMA, _NEWLINE, _POINT, _MINUS, _ZERO = 44, 10, 46, 45, 48
_LIMIT = 1e18


_UNITS = np.array([10**k for k in range(19)], dtype=np.int64)
_SCALES = np.array([10.0**k for k in range(MAX_DECIMALS + 1)])
_PAIRS = np.array([_ZERO + digit for k in range(100) for digit in divmod(k, 10)], dtype=np.uint8)
"""The digits of 00 to 99: two at a time are half as many divisions."""


@compiled("void(u1[::1], u8, u8, u8)", forceinline=True)
def _write_digits(
    out: NDArray[np.uint8], at: np.uint64, count: np.uint64, number: np.uint64
) -> None:
    """Write the last `count` digits of `number` at `out[at:]`.

    Four at a time: their two divisions do not wait for each other. All is unsigned, since an index
    that may be negative is looked at before each of them.
    """
    k = at + count
    while count >= np.uint64(4):
        rest = number // np.uint64(10000)
        four = number - np.uint64(10000) * rest
        first = four // np.uint64(100)
        second = np.uint64(2) * (four - np.uint64(100) * first)
        first *= np.uint64(2)
        number = rest
        count -= np.uint64(4)
        k -= np.uint64(4)
        out[k], out[k + np.uint64(1)] = _PAIRS[first], _PAIRS[first + np.uint64(1)]
        out[k + np.uint64(2)], out[k + np.uint64(3)] = _PAIRS[second], _PAIRS[second + np.uint64(1)]
    if count >= np.uint64(2):
        rest = number // np.uint64(100)
        pair = np.uint64(2) * (number - np.uint64(100) * rest)
        number = rest
        count -= np.uint64(2)
        k -= np.uint64(2)
        out[k], out[k + np.uint64(1)] = _PAIRS[pair], _PAIRS[pair + np.uint64(1)]
    if count:
        out[k - np.uint64(1)] = np.uint64(_ZERO) + number % np.uint64(10)


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
    at = 0
    for i in range(n):
        for j in range(m):
            v = values[i, j]
            magnitude = abs(v)
            if magnitude < _LIMIT:
                d = decimals[j]
                unit = _UNITS[d]
                whole = np.int64(magnitude)
                part = np.int64(np.rint((magnitude - np.float64(whole)) * _SCALES[d]))
                if part >= unit:
                    whole += 1
                    part -= unit
                if v < 0.0 and (whole > 0 or part > 0):
                    out[at] = _MINUS
                    at += 1
                digits = 1
                while digits < _UNITS.shape[0] and whole >= _UNITS[digits]:
                    digits += 1
                _write_digits(out, np.uint64(at), np.uint64(digits), np.uint64(whole))
                at += digits
                if d > 0:
                    out[at] = _POINT
                    _write_digits(out, np.uint64(at + 1), np.uint64(d), np.uint64(part))
                    at += 1 + d
            elif magnitude >= _LIMIT:
                if v < 0.0:
                    out[at] = _MINUS
                    at += 1
                out[at] = 105
                out[at + 1] = 110
                out[at + 2] = 102
                at += 3
            out[at] = _COMMA
            at += 1
        code = codes[i]
        if labels.shape[1] == 0:
            at -= 1
        elif 0 <= code < labels.shape[0]:
            for k in range(labels.shape[1]):
                if labels[code, k] == 0:
                    break
                out[at] = labels[code, k]
                at += 1
        out[at] = _NEWLINE
        at += 1
    return at


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
