"""Rows by column are the rows that were put in, and take the memory that they say."""

from __future__ import annotations

import math
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.dashboard.history import LatestRows, LatestRowsByKey
from fusiond.dashboard.vehicle import MOST_INNOVATIONS

FIGURES = st.none() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False)
ROWS = st.lists(st.tuples(FIGURES, st.none() | st.text(), FIGURES), max_size=40)


@given(ROWS, st.integers(1, 12), st.integers(0, 40))
def test_a_ring_has_the_last_rows_as_they_came(
    rows: list[tuple[Any, ...]], most: int, count: int
) -> None:
    ring = LatestRows(most, "dod")
    for number, row in enumerate(rows, start=1):
        ring.add(number, row)
    assert len(ring) == min(most, len(rows))
    last = [(number, list(row)) for number, row in enumerate(rows, start=1)][-most:]
    assert ring.newer(count) == [row for number, row in last if number > count]


@given(st.lists(st.tuples(st.integers(0, 9), FIGURES), max_size=60), st.integers(0, 60))
def test_of_each_key_there_is_the_newest_row(puts: list[tuple[int, Any]], count: int) -> None:
    most, kept = 6, LatestRowsByKey(6, "od")
    expected: dict[int, tuple[int, list[Any]]] = {}
    for number, (key, value) in enumerate(puts, start=1):
        assert kept.get(key) == (expected[key][1] if key in expected else None)
        kept.put(key, number, [f"{key}", value])
        expected.pop(key, None)
        expected[key] = number, [f"{key}", value]
        if len(expected) > most:
            del expected[next(iter(expected))]
    assert kept.newer(count) == [row for number, row in expected.values() if number > count]


@pytest.mark.parametrize("value", [10**400, -(10**400), math.nan])
def test_integers_beyond_doubles_become_nan(value: float) -> None:
    ring = LatestRows(3, "d")
    ring.add(1, [value])
    assert ring.newer(0) == [[None]]


def test_ten_minutes_of_innovations_take_three_megabytes() -> None:
    """Each with texts and floats of its own, as messages bring them; lists took 6 MB."""
    kept = LatestRowsByKey(MOST_INNOVATIONS, "doodd")
    tracemalloc.start()
    try:
        for k in range(MOST_INNOVATIONS + 5000):
            row = [k * 0.05, "".join(["gn", "ss"]), "".join(["fus", "ed"]), k * 0.1, 3]
            kept.put(("gnss", k * 50.0), k, row)
        assert tracemalloc.get_traced_memory()[0] < 3e6
    finally:
        tracemalloc.stop()
    assert len(kept.newer(0)) == MOST_INNOVATIONS
