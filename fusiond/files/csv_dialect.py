"""Normalisation of a CSV file: comma between cells, decimal points, uncompressed.

Spreadsheets of half the world write semicolons or tabs between cells, and commas in numbers. Each
is replaced by one character, so that line numbers stay. `.gz` is decompressed. An ambiguous file is
refused, with its name.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Text = NDArray[np.uint8]

_GZIP = b"\x1f\x8b"
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_LOOKED_AT = 100
"""Rows by which the decimal sign is found; a column of whole numbers does not show it."""
_COMMA_NUMBER = re.compile(rb"^[+-]?\d*,\d+([eE][+-]?\d+)?$")
_FIRST_LINE = re.compile(rb"[^\n]*")
_POINT_NUMBER = re.compile(rb"^[+-]?\d*\.\d+([eE][+-]?\d+)?$")


class DialectError(ValueError):
    """Error: an unsupported way of writing a table; the text names it and the remedy."""


def plain_csv(path: Path) -> Text:
    """Read the file's bytes (n,) with commas between cells and points in numbers.

    Raises `DialectError`, and `OSError` for a file that cannot be read.
    """
    data = _contents(path)
    if data[:2].tobytes() == _GZIP:
        data = _text(_unzipped(data.tobytes()))
    if data[:2].tobytes() in _UTF_16:
        raise DialectError("UTF-16 text: save it as CSV in UTF-8")
    return _with_commas(_without_quotes(data))


def first_line(data: Text) -> bytes:
    """Bytes before the first newline."""
    found = _FIRST_LINE.match(data.data)
    return found[0] if found else b""


def _contents(path: Path) -> Text:
    """Read all bytes of a file, into large memory pages in a third of the time of `read_bytes`."""
    with path.open("rb") as file:
        data = np.empty(os.fstat(file.fileno()).st_size, dtype=np.uint8)
        data = data[: file.readinto(data.data)]
        rest = file.read()  # of what has no size, or has grown meanwhile
    return np.concatenate((data, _text(rest))) if rest else data


def _text(data: bytes) -> Text:
    return np.frombuffer(data, dtype=np.uint8).copy()


def _unzipped(data: bytes) -> bytes:
    import gzip  # noqa: PLC0415 - few files are
    import zlib  # noqa: PLC0415

    try:
        return gzip.decompress(data)
    except (EOFError, OSError, zlib.error) as error:
        raise DialectError(f"damaged .gz: {error}") from error


def _without_quotes(data: Text) -> Text:
    """Remove quotes around cells, as R and spreadsheets write; numbers and column names need
    none."""
    if b'"' in first_line(data) or b'"' in first_line(data[len(first_line(data)) + 1 :]):
        return np.where(data == ord('"'), np.uint8(ord(" ")), data)
    return data


def _with_commas(data: Text) -> Text:
    header = first_line(data).strip()
    if data.size and not header:
        raise DialectError("line 1 is empty: take it out, so that the names lead")
    if header.startswith(b"#"):
        raise DialectError("line 1 is a comment (#): take it out, so that the names lead")
    if b"," in header:
        return data
    if header.lower().startswith(b"sep="):
        raise DialectError("line 1 is a spreadsheet's 'sep=': take it out, so that the names lead")
    between = next((mark for mark in (b";", b"\t") if mark in header), None)
    if between is None:
        if len(header.split()) > 1:
            raise DialectError("blanks between the cells: write commas, semicolons or tabs")
        return data
    text = data.tobytes()
    if _decimal(text, between) == b",":
        return _text(text.translate(bytes.maketrans(between + b",", b",.")))
    return _text(text.translate(bytes.maketrans(between, b",")))


def _decimal(data: bytes, between: bytes) -> bytes:
    """Find the decimal sign: a comma or a point."""
    points = commas = False
    for row in data.split(b"\n", _LOOKED_AT + 1)[1 : _LOOKED_AT + 1]:
        for cell in row.split(between):
            points |= _POINT_NUMBER.match(cell.strip()) is not None
            commas |= _COMMA_NUMBER.match(cell.strip()) is not None
    if points and commas:
        raise DialectError("numbers with a point and numbers with a comma: write one of the two")
    return b"," if commas else b"."
