"""`fusiond bench` prints its figures for people, and writes them as JSON where it is asked to."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.bench import bench as timing
from fusiond.commands.app import app

FIGURES = (
    "numpy_product_us",
    "block_step_ratio",
    "single_step_ratio",
    "rewind_2s_ratio",
    "raw_epoch_40_ratio",
    "late_tick_ratio",
    "late_raw_tick_ratio",
    "multiscale_step_ratio",
    "federated_step_ratio",
    "unscented_step_ratio",
    "unscented_propagation_step_ratio",
    "process_epoch_ratio",
    "process_start_s",
    "reduced_order_step_ratio",
    "fix_functions",
    "fix_modules",
    "wired_fix_functions",
    "wired_fix_modules",
)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real benchmark, short, and run once."""
    whole = timing.bench
    monkeypatch.setattr(timing, "STEP_SECONDS", 10)
    monkeypatch.setattr(timing, "bench", cache(lambda: whole(repetitions=2, process_s=90.0)))


@pytest.mark.usefixtures("short")
def test_bench_prints_a_table_and_writes_json(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    printed = CliRunner().invoke(app, ["bench", "--json", str(path)])
    assert printed.exit_code == 0, printed.output
    figures = json.loads(path.read_text())
    assert list(figures)[: len(FIGURES)] == list(FIGURES)
    assert all(figures[name] > 0.0 for name in FIGURES)  # how large they are is not tested
    assert figures["cpu"]
    for name, value in figures.items():
        timed = name.endswith(("_ratio", "_s"))
        assert (f"{value:.4g}" if timed else str(value)) in printed.output, name
        assert name in printed.output or not timed, name
    assert "\x1b" not in printed.output
    piped = CliRunner().invoke(app, ["bench", "--json", "-"])
    assert json.loads(piped.output) == figures
    assert CliRunner().invoke(app, ["bench"]).output == printed.output
