"""`fusiond batch`: a row a drive, never done twice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusiond.batch.log_row import drive_row
from fusiond.commands.app import app
from fusiond.files.resumable_parquet import Row, read_rows
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS

CONFIG = """
[imu]
axes = ["+x", "-y", "-z"]
[aiding.gnss]
lever_arm_m = [0.0, 0.0, -1.0]
[estimator]
model = "ins21"
[alignment]
heading = ["config"]
heading_deg = 40.0
"""
DURATION_S = 12.0
LOGS = ("drive0", "drive1", "empty", "missing")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives, one of them without truth, and what is none."""
    folder = tmp_path_factory.mktemp("drives")
    (folder / "C.toml").write_text(CONFIG)
    for seed in range(2):
        simulate(SCENARIOS["drive"], folder / f"drive{seed}", seed, DURATION_S)
    (folder / "drive1" / "truth.csv").unlink()
    (folder / "empty").mkdir()
    return folder


def batch(folder: Path, logs: Sequence[str], *args: str) -> str:
    call = ["batch", str(folder / "C.toml"), *(str(folder / log) for log in logs)]
    done = CliRunner().invoke(app, [*call, "--out", str(folder / "rows.parquet"), *args])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.output


def rows_of(folder: Path) -> list[Row]:
    return read_rows(folder / "rows.parquet")


def test_a_row_a_drive_and_none_twice(drives: Path) -> None:
    assert "2 done, 2 error" in batch(drives, LOGS, "--workers", "1")
    found = rows_of(drives)
    rows = {Path(row["log"]).name: row for row in found}
    first, second = rows["drive0"], rows["drive1"]
    assert first["outcomes.gnss.fused"] > 0
    assert sum(v for k, v in first.items() if k.startswith("modes.")) == pytest.approx(1.0)
    # One sigma of a fix is 0.5 m to 2 m: what is off by much more is no navigation.
    assert 0.0 < first["error.horizontal_rms_m"] < 5.0
    assert "error.horizontal_rms_m" not in second
    assert "neither imu.csv nor a recording" in rows["empty"]["reason"]
    assert rows["missing"]["reason"].startswith("FileNotFoundError")
    # A worker finds what this process finds, bit for bit.
    here = drive_row(drives / "C.toml", drives / "drive0")
    assert {**first, **here} == first

    assert "4 there" in batch(drives, LOGS, "--workers", "1")
    assert rows_of(drives) == found

    (drives / "C.toml").write_text(CONFIG.replace("40.0", "41.0"))
    said = batch(drives, ["drive0"], "--workers", "1", "--timeout", "0.001")
    assert "1 timeout" in said
    late = [row for row in rows_of(drives) if row["ended"] == "timeout"]
    assert [row["reason"] for row in late] == ["no end after 0.001 s"]
    assert len({row["config_digest"] for row in rows_of(drives)}) == 2
    assert len(rows_of(drives)) == 5
