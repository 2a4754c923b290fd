"""No solution of a kept recording changes unseen."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.golden.golden import FOLDER, LOGS, VEHICLES, driven, kept, solution
from tests.places import DATA

TOLERANCE = 1.5
"""Of the last printed digit: compiled code may differ in the last bit between processors."""


@pytest.mark.parametrize("name", [*LOGS, *VEHICLES])
def test_the_solution_is_the_one_that_was_approved(name: str, tmp_path: Path) -> None:
    if name in VEHICLES and not (DATA / name).is_dir():
        pytest.skip(f"recorded data is absent: {DATA / name} (set FUSIOND_DATA)")
    with kept(name).open(newline="") as file:
        approved = list(csv.DictReader(file))
    found = solution([FOLDER / name] if name in LOGS else driven(name, tmp_path))
    assert len(found) == len(approved)
    for now, before in zip(found, approved, strict=True):
        changed = [f"{c} {v} -> {now[c]}" for c, v in before.items() if not _same(now[c], v)]
        assert not changed, (
            f"at t_s {before['t_s']}: {', '.join(changed)}; "
            "if that is wanted: make golden, and commit the difference"
        )


def _same(now: str, before: str) -> bool:
    if now == before or "" in (now, before) or before.isalpha():
        return now == before
    digits = len(before.partition(".")[2])
    return abs(float(now) - float(before)) <= TOLERANCE * 10.0**-digits


def test_every_log_of_the_folder_is_in_the_list() -> None:
    assert {path.name for path in FOLDER.glob("*.mcap")} == set(LOGS)
