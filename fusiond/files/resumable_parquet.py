"""Rows of figures in a Parquet file that survive an interruption.

A Parquet file is written whole. Until then each row is a line of JSON in `F.parquet.journal`,
appended as soon as it is known; `ResumableRows` finds rows in both, so that a killed batch can
resume. The journal is removed once its rows are in the file.

A row is flat: numbers, texts and truth values by name; rows need not have the same names. NaN and
infinities, which JSON lacks, are left out.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from fusiond.files.csv_tables import MissingPackageError, TableError
from fusiond.files.install_extra import install_command

Row = dict[str, Any]
COMPRESSION = "zstd"


class ResumableRows:
    """Rows of the file `path` and added ones, all written on close.

    Raises `MissingPackageError` without pyarrow, `TableError` for a file without rows of figures,
    OSError.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._journal_path = path.with_name(f"{path.name}.journal")
        _arrow()
        self.rows = read_rows(path) if path.exists() else []
        self.rows += _journal(self._journal_path)
        self._journal = self._journal_path.open("a", encoding="utf-8")

    def __enter__(self) -> ResumableRows:
        return self

    def __exit__(self, *_: object) -> None:
        self._journal.close()
        write_rows(self._path, self.rows)
        self._journal_path.unlink()

    def add(self, row: Row) -> None:
        self._journal.write(json.dumps(row, allow_nan=False) + "\n")
        self._journal.flush()
        self.rows.append(row)


def read_rows(path: Path, without: Collection[str] = ()) -> list[Row]:
    """Rows of a Parquet file, without some names and without empty values."""
    arrow, parquet = _arrow()
    try:
        wanted = [name for name in parquet.read_schema(path).names if name not in without]
        found = parquet.read_table(path, columns=wanted).to_pylist()
    except arrow.ArrowInvalid as error:
        raise TableError(f"{path}: no Parquet file: {error}") from error
    return [{name: value for name, value in row.items() if value is not None} for row in found]


def write_rows(path: Path, rows: list[Row]) -> None:
    """Replace all rows of a file atomically."""
    arrow, parquet = _arrow()
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: arrow.array([row.get(name) for row in rows]) for name in names}
    unfinished = path.with_name(f"{path.name}.part")
    parquet.write_table(arrow.table(columns), unfinished, compression=COMPRESSION)
    os.replace(unfinished, path)


def flattened(values: dict[str, Any], before: str = "") -> Row:
    """Flatten nested names, joined by dots; values that are None, not finite or not plain are left
    out."""
    row: Row = {}
    for name, value in values.items():
        if isinstance(value, dict):
            row |= flattened(value, f"{before}{name}.")
        elif isinstance(value, float):
            if math.isfinite(value):
                row[before + name] = float(value)
        elif isinstance(value, str | bool | int):
            row[before + name] = str(value) if isinstance(value, str) else value
    return row


def _journal(path: Path) -> list[Row]:
    """Rows of the journal; a last line that was cut short is removed from the file."""
    if not path.exists():
        return []
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        os.truncate(path, whole)
    return [json.loads(line) for line in data[:whole].splitlines()]


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow  # noqa: PLC0415  (extra `[batch]`)
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError(f"rows need pyarrow: {install_command('batch')}") from error
    return pyarrow, parquet
