"""History as columns: a number takes eight bytes, each different text is stored once.

A row of five figures takes 500 bytes as a list, including its share of texts, and 50 as columns.
The rows of ten minutes are most of the dashboard's memory.

`kinds` has a letter a column: `d` for a number or None, `o` for anything else. Each row has a
number of a growing count, by which viewers ask for newer rows.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Hashable, Iterable, MutableSequence, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


class _Columns:
    """Rows in slots: a row is appended or replaces another."""

    def __init__(self, kinds: str) -> None:
        self._numbers = array("q")
        self._columns: tuple[array[float] | list[Any], ...] = tuple(
            array("d") if kind == "d" else [] for kind in kinds
        )

    def _put(self, slot: int, number: int, row: Sequence[Any]) -> None:
        _set(self._numbers, slot, number)
        for column, value in zip(self._columns, row, strict=True):
            if isinstance(column, array):
                _set(column, slot, _figure(value))
            else:
                _set(column, slot, sys.intern(value) if isinstance(value, str) else value)

    def _row(self, slot: int) -> list[Any]:
        values = [column[slot] for column in self._columns]
        return [None if isinstance(v, float) and math.isnan(v) else v for v in values]

    def _newer(self, count: int, newest_first: Iterable[int]) -> list[list[Any]]:
        rows = []
        for slot in newest_first:
            if self._numbers[slot] <= count:
                break
            rows.append(self._row(slot))
        return rows[::-1]


def _set(column: MutableSequence[T], slot: int, value: T) -> None:
    if slot == len(column):
        column.append(value)
    else:
        column[slot] = value


def _figure(value: float | None) -> float:
    """Convert to a float of an array: NaN for None and for an integer beyond all floats."""
    try:
        return math.nan if value is None else float(value)
    except OverflowError:
        return math.nan


class LatestRows(_Columns):
    """The last `most` rows."""

    def __init__(self, most: int, kinds: str) -> None:
        super().__init__(kinds)
        self._most = most
        self._added = 0

    def __len__(self) -> int:
        return len(self._numbers)

    def add(self, number: int, row: Sequence[Any]) -> None:
        """Add a row; the oldest one is dropped when the table is full."""
        self._put(self._added % self._most, number, row)
        self._added += 1

    def newer(self, count: int) -> list[list[Any]]:
        """Rows with a number greater than `count`, in order of arrival."""
        places = range(self._added - 1, self._added - 1 - len(self), -1)
        return self._newer(count, (place % self._most for place in places))


class LatestRowsByKey(_Columns):
    """The last row of each key, for the `most` latest keys."""

    def __init__(self, most: int, kinds: str) -> None:
        super().__init__(kinds)
        self._most = most
        self._slots: dict[Hashable, int] = {}

    def get(self, key: Hashable) -> list[Any] | None:
        """The row of a key."""
        slot = self._slots.get(key)
        return None if slot is None else self._row(slot)

    def put(self, key: Hashable, number: int, row: Sequence[Any]) -> None:
        """Replace the row of this key."""
        slot = self._slots.pop(key, None)
        if slot is None:
            full = len(self._slots) == self._most
            slot = self._slots.pop(next(iter(self._slots))) if full else len(self._slots)
        self._put(slot, number, row)
        self._slots[key] = slot

    def newer(self, count: int) -> list[list[Any]]:
        """Rows with a number greater than `count`, in order of arrival."""
        return self._newer(count, reversed(self._slots.values()))
