"""Rows in a Parquet file: they outlive an interruption, and need not have the same names."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.files.csv_tables import TableError
from fusiond.files.resumable_parquet import ResumableRows, read_rows

ROWS = [{"log": "a", "fused": 3, "rms_m": 0.5}, {"log": "b", "ended": "died", "honest": True}]


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    for row in ROWS:  # the second time beside what is there
        with ResumableRows(path) as file:
            file.add(row)
    assert read_rows(path) == ROWS
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_rows_of_a_batch_that_was_killed_are_there(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    killed = ResumableRows(path)
    killed.add(ROWS[0])
    with (tmp_path / "rows.parquet.journal").open("a") as journal:
        journal.write('{"log": "cut sho')
    with ResumableRows(path) as file:
        assert file.rows == ROWS[:1]
        file.add(ROWS[1])
    assert read_rows(path) == ROWS


def test_another_file_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    path.write_text("t_s,lat_deg\n")
    with pytest.raises(TableError, match="no Parquet file"):
        ResumableRows(path)
    assert path.read_text() == "t_s,lat_deg\n"
