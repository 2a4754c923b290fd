"""Rows of the fault matrix, one of each kind: nothing lies, it is told by name, and it is over.

The whole matrix is run by `make faults`; docs/faults.md has what it found.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond.studies.faults.power import SIZES, alarms_of, power_of
from fusiond.studies.faults.runs import Row, run_row
from fusiond.studies.faults.tables import TABLES, put_into

# Fault and phase; the event that names it; within how many seconds of its end the mode is
# `navigating` again with errors inside five sigma (None: it lasts to the end of the drive).
ROWS = [
    ("step_500m", "navigating", "isolated", 10.0),
    ("fix_frozen", "navigating", "isolated", 10.0),
    ("velocity_reversed", "navigating", "isolated", 5.0),
    ("drift_0.5_m_s", "coasting", "isolated", 10.0),
    ("wheels_frozen", "coasting", "isolated", 5.0),
    ("gyro_bias_1_deg_s", "navigating", "isolated", None),
    ("gyro_spike_in_range", "navigating", "imu_spike", 3.0),
    ("imu_stuck_15s", "navigating", "imu_repeated", 20.0),
    ("imu_stamps_reversed", "aligning", "imu_time", None),
    ("heading_off_by_90_deg", "aligning", "heading_contradicted", None),
]


@pytest.mark.parametrize(("fault", "phase", "event", "within_s"), ROWS)
def test_it_is_told_and_never_lied_about(
    fault: str, phase: str, event: str, within_s: float | None
) -> None:
    found = run_row(Row(fault, phase), seed=0)  # type: ignore[arg-type]
    assert found["verdict"] == "degraded and said so", found
    assert event in {e["code"] for e in found["events"]}
    if within_s is not None:
        assert found["recovered_s"] is not None
        assert found["recovered_s"] <= within_s


def test_a_step_is_seen_and_quiet_minutes_raise_no_alarm() -> None:
    assert ("step", 50.0) in SIZES
    found = power_of(("step", 50.0), [0])
    assert found["noticed"] == found["runs"] == 1
    assert found["median_s"] < 2.0
    quiet = alarms_of(0, 240.0)
    assert quiet["crash"] is None
    assert "isolated" not in quiet["events"]
    assert quiet["longest_lie_s"] == 0.0
    assert "| step 50 m | 1 | 1 of 1 |" in TABLES["power"]([found])
    assert "0.0666667 hours simulated" in TABLES["alarms"]([quiet])


def test_a_table_goes_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- power: written by --page -->\nold\n<!-- end of power -->\nb\n")
    put_into(page, "power", "new\n")
    put_into(page, "power", "newer\n")
    text = page.read_text()
    assert text.startswith("a\n")
    assert text.endswith("\nb\n")
    assert text.count("newer") == 1
    assert "old" not in text
    with pytest.raises(ValueError, match="no marks of matrix"):
        put_into(page, "matrix", "")
