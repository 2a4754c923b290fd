"""Pages of two runs, each from a solution file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusiond.report.report import report
from tests.report.pages import item, items, read_page, series, solution


def test_two_runs_stand_side_by_side_and_their_difference_is_drawn(tmp_path: Path) -> None:
    first = solution(tmp_path / "a.csv", 1000.0)
    second = solution(tmp_path / "b.csv", 1000.0, east_m=2.0)
    report([first], tmp_path / "two.html", beside=[second])
    document = read_page(tmp_path / "two.html")
    assert [run["name"] for run in document["runs"]] == ["a.csv", "b.csv"]
    apart = item(document, "The second run against the first", "Distance")
    assert np.nanmedian(series(apart, "horizontal")) == pytest.approx(2.0, rel=0.01)
    sigmas = item(document, "The second run against the first", "The same in sigmas")
    assert np.nanmedian(series(sigmas, "east")) == pytest.approx(4.0, rel=0.01)
    rows = next(s["rows"] for s in document["sections"] if s["title"].startswith("Position"))
    assert all(len(row) == 2 for row in rows)


def test_a_run_beside_itself_is_the_same(tmp_path: Path) -> None:
    path = solution(tmp_path / "a.csv", 1000.0)
    report([path], tmp_path / "two.html", beside=[path])
    (same,) = items(read_page(tmp_path / "two.html"), "The second run against the first")
    assert same["text"] == "The same positions at all 400 instants that both have."


def test_runs_without_common_time_begin_together(tmp_path: Path) -> None:
    first = solution(tmp_path / "a.csv", 1000.0)
    second = solution(tmp_path / "b.csv", 9000.0)
    report([first], tmp_path / "two.html", beside=[second])
    document = read_page(tmp_path / "two.html")
    assert "no time in common" in document["note"]
    assert document["span"] == pytest.approx([0.0, 39.9])
