"""`fusiond process --smooth` on files: rows, starts, what is kept where; and on the real drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusiond.configuration.load import ConfigError, load_config
from fusiond.files.measurement_csv import TrajectoryTable, read_solution, read_truth
from fusiond.files.resumable_parquet import flattened
from fusiond.files.solution_csv import SMOOTHED
from fusiond.navigation.solution import Mode
from fusiond.offline import smooth
from fusiond.offline.compare import compare
from fusiond.offline.process import process
from fusiond.simulation.files import simulate
from fusiond.simulation.scenarios import SCENARIOS
from tests.places import REPOSITORY

SECONDS = 125.0  # it aligns after 70 s, with the first motion
GAP_S = (102.0, 107.0)
OUTAGE = (80.0, 12.0)


class Files:
    """A simulated drive whose IMU falls silent for a while: two starts of the filter."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        simulate(SCENARIOS["drive"], folder, 3, SECONDS)
        lines = (folder / "imu.csv").read_text().splitlines(keepends=True)
        first = float(lines[1].split(",")[0])
        kept = [
            line
            for line in lines[1:]
            if not GAP_S[0] < float(line.split(",")[0]) - first < GAP_S[1]
        ]
        (folder / "imu.csv").write_text("".join([lines[0], *kept]))
        self.outages = [(first + OUTAGE[0], OUTAGE[1])]

    def process(self, name: str, smoothed: bool) -> tuple[dict[str, Any], Path]:
        out = self.folder / name
        config = load_config(REPOSITORY / "config" / "vehicle.toml")
        measurements = [(kind, self.folder / f"{kind}.csv") for kind in ("gnss", "rdss")]
        imu = self.folder / "imu.csv"
        return process(config, imu, measurements, self.outages, out, smooth=smoothed), out


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return Files(tmp_path_factory.mktemp("drive"))


def _excess(smoothed: TrajectoryTable, filtered: TrajectoryTable) -> float:
    return max(
        float(np.nanmax(getattr(smoothed, name) - getattr(filtered, name)))
        for name in ("sd_position", "sd_v", "sd_rpy")
    )


def test_each_start_is_smoothed(files: Files) -> None:
    before, causal = files.process("causal.csv", smoothed=False)
    after, out = files.process("smoothed.csv", smoothed=True)
    assert "smoothed" not in before
    counts = after.pop("smoothed")
    # The first pass crosses each sample alone, since nodes hold the transitions between them.
    found, expected = flattened(after.pop("consistency")), flattened(before.pop("consistency"))
    assert after == before
    for name, value in expected.items():
        wanted = pytest.approx(value, rel=1e-4) if isinstance(value, float) else value
        assert found.pop(name) == wanted, name
    assert not found
    assert counts["starts"] == 2
    filtered, table = read_solution(causal), read_solution(out)
    assert np.array_equal(table.t_s, filtered.t_s)
    kept = {Mode.INVALID: Mode.INVALID}
    assert table.status == [kept.get(Mode(word), SMOOTHED) for word in filtered.status]
    assert counts["rows"] == table.status.count(SMOOTHED) > 3000
    # Late fixes: the filter's rows are those of the first pass, along another trajectory.
    assert _excess(table, filtered) < 1e-3
    truth = read_truth(files.folder / "truth.csv")
    was, now = compare(filtered, truth), compare(table, truth)
    # Position is the fixes', whose shared error nothing tells; motion is what the future tells.
    assert now["v_horizontal_rms_m_s"] < 0.8 * was["v_horizontal_rms_m_s"]
    assert now["pitch_rms_deg"] < 0.5 * was["pitch_rms_deg"]
    assert now["horizontal_max_m"] < 0.8 * was["horizontal_max_m"]


def test_what_does_not_fit_into_memory_goes_to_a_file(
    files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = files.folder / "smoothed.csv"
    if not whole.exists():
        files.process(whole.name, smoothed=True)
    monkeypatch.setattr(smooth, "MOST_BYTES", 0)
    monkeypatch.setattr(smooth, "BLOCK_NODES", 50)
    monkeypatch.setattr(smooth, "BLOCK_ROWS", 300)
    _, blocks = files.process("blocks.csv", smoothed=True)
    assert blocks.read_bytes() == whole.read_bytes()


def test_a_filter_without_a_tape_is_refused(files: Files) -> None:
    config = load_config(REPOSITORY / "config" / "vehicle.toml")
    other = config.estimator.model_copy(update={"filter": "unscented"})
    config = config.model_copy(update={"estimator": other})
    with pytest.raises(ConfigError, match="'unscented' cannot be smoothed; choose 'kalman'"):
        process(config, files.folder / "imu.csv", [], None, files.folder / "x.csv", smooth=True)
