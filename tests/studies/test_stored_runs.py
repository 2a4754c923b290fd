"""Runs of a study as rows: the same as without, and none made twice."""

from __future__ import annotations

import base64
import pickle
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fusiond.commands.app import app
from fusiond.files.csv_tables import TableError
from fusiond.files.resumable_parquet import ResumableRows, read_rows, write_rows
from fusiond.studies import random_drives_study
from fusiond.studies.monte_carlo import map_runs, run_generator, runner_context
from fusiond.studies.rdss import static
from fusiond.studies.rdss.runs import simulate
from fusiond.studies.stored_runs import StoredRuns, stable_text
from fusiond.workers.runner_interface import Outcome

DURATION_S = 25.0
"""Long enough to align and to drive off."""


class Here:
    """Runs in this process; counts them."""

    workers = 1

    def __init__(self) -> None:
        self.made = 0

    def outcomes(
        self, work: Callable[[Any], Any], items: Sequence[Any], chunk: int = 1
    ) -> Iterator[Outcome[Any]]:
        for index, item in reversed(list(enumerate(items))):  # in whatever order they come
            self.made += 1
            yield Outcome(index, "done", result=work(item))


def kept_runs(
    path: Path, work: Callable[[int], Any], runs: int, study: str = "s"
) -> tuple[list[Any], int]:
    """Results, and how many were made for them."""
    here = Here()
    with ResumableRows(path) as file, runner_context(here, StoredRuns(file, study, 0)):
        return map_runs(work, runs), here.made


def test_a_row_a_drive_by_the_names_of_batch(tmp_path: Path) -> None:
    path, work = tmp_path / "rows.parquet", partial(random_drives_study.drive_run, DURATION_S, 3)
    first, made = kept_runs(path, work, 2)
    assert made == 2
    assert kept_runs(path, work, 2) == (first, 0)
    row, other = sorted(read_rows(path), key=lambda row: int(row["run"]))
    assert (row["seed"], row["run"], row["ended"]) == (0, 0, "done")
    assert row["error.horizontal_rms_m"] < 5.0
    assert row["outcomes.gnss.fused"] > 0
    assert sum(v for k, v in row.items() if k.startswith("modes.")) == pytest.approx(1.0)
    assert row["error.east_rms_m"] != other["error.east_rms_m"]
    # Run 1 is the same without run 0.
    assert work(1) == first[1]


def test_a_summary_of_kept_runs_is_that_of_new_ones(tmp_path: Path) -> None:
    path, work = tmp_path / "rows.parquet", partial(simulate, static.CASE, 0)
    kept_runs(path, work, 1)
    found, made = kept_runs(path, work, 2)
    assert made == 1
    for number in range(2):
        for name, trace in work(number).items():
            assert np.array_equal(found[number][name].error, trace.error, equal_nan=True)
            assert found[number][name].gated == trace.gated
    rows = read_rows(path)
    assert {row["part"] for row in rows} == {"static"}
    assert rows[0]["rewind.nees.mean"] == pytest.approx(np.mean(found[0]["rewind"].nees))


def test_another_case_has_rows_of_its_own() -> None:
    case = static.CASE
    names = [stable_text(partial(simulate, c, 0)) for c in (case, replace(case, window=40))]
    assert names[0] != names[1]
    assert names[0] == stable_text(partial(simulate, replace(case), 0))
    assert " at 0x" not in names[0]


class Harmful:
    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("called",))


@pytest.mark.parametrize("result", [pickle.dumps(Harmful()), b"\x80"])
def test_a_file_of_rows_calls_nothing(tmp_path: Path, result: bytes) -> None:
    path, work = tmp_path / "rows.parquet", partial(simulate, static.CASE, 0)
    kept_runs(path, work, 1)
    (row,) = read_rows(path)
    packed = base64.b64encode(zlib.compress(result)).decode("ascii")
    write_rows(path, [row | {"result": packed}])
    with pytest.raises(TableError, match="result of run 0 cannot be read"):
        kept_runs(path, work, 1)


def test_runs_are_children_of_the_seeds_sequence() -> None:
    """Child k, whoever makes it, and none that another seed has."""
    whole = np.random.SeedSequence(7).spawn(4)
    assert np.array_equal(run_generator(7, 3).generate_state(4), whole[3].generate_state(4))
    states = {tuple(run_generator(s, k).generate_state(2)) for s in range(20) for k in range(20)}
    assert len(states) == 400


def test_the_command_goes_on_where_its_rows_end(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    kept_runs(
        path, partial(random_drives_study.drive_run, random_drives_study.DURATION_S, 0), 2, "drives"
    )
    call = ["study", "drives", "--workers", "1", "--out", str(path), "--runs"]
    done = CliRunner().invoke(app, [*call, "2"])
    assert "2 there" in done.stderr
    assert "2 of 2 drives navigated" in done.stdout
    other = CliRunner().invoke(app, ["study", "rdss-map", "--out", str(path)])
    assert other.exit_code == 2
    assert "none is a row" in other.stderr
