"""The faults of the matrix put into a recording: where they begin, and what it is compared with."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

from fusiond.configuration.load import load_config
from fusiond.offline.can_through_drivers import read_can_log
from fusiond.studies.faults.extra_faults import EVERY
from fusiond.studies.faults.recorded import Place, recorded_rows, run_recorded, smooth
from fusiond.studies.faults.tables import TABLES
from tests.places import DATA, REPOSITORY

DRIVE = DATA / "drive_0708"
BUS = DATA / "css_164" / "can.log.gz"
LATE_FROM_S = 1_627_210_367.671
"""By that log's clock."""

pytestmark = pytest.mark.skipif(
    not DRIVE.is_dir(), reason=f"real drive drive_0708 is absent: {DRIVE} (set FUSIOND_DATA)"
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    smoothed = tmp_path_factory.mktemp("recorded") / "smoothed.csv"
    found = Place(REPOSITORY / "config" / "drive_0708.toml", DRIVE, smoothed)
    smooth(found)
    return found


def test_what_the_recording_has_not_is_not_put_in(place: Place) -> None:
    found = recorded_rows(place, [230.0, 350.0], None, None)
    named = {row.fault for row in found}
    assert named < set(EVERY)
    assert {"step_500m", "gyro_bias_1_deg_s", "imu_clock_200ppm", "no_aids"} <= named
    assert not any(name.startswith(("wheels", "rdss", "creeping")) for name in named)
    assert {row.at_s for row in found} == {230.0, 350.0}
    assert recorded_rows(place, [1.0], "wheels_slip", None) == []


def test_nothing_wrong_is_inside_and_a_step_is_told(place: Place) -> None:
    """The solution of one part and that of all measurements agree within their sigmas."""
    [none] = recorded_rows(place, [230.0], "none", "navigating")
    quiet = run_recorded(none, place)
    assert quiet["verdict"] == "survived", quiet
    assert quiet["longest_lie_s"] <= 1.0  # a bump
    assert 0.0 < quiet["largest_horizontal_m"] < 0.15
    [step] = recorded_rows(place, [230.0], "step_50m", "navigating")
    found = run_recorded(step, place)
    assert found["verdict"] == "degraded and said so", found
    assert found["noticed_s"] < 2.0
    assert "isolated" in {event["code"] for event in found["events"]}
    text = TABLES["recorded"]([quiet, {**found, "verdict": "lie"}])
    assert "| step_50m, at 230 s | navigating | lie |" in text
    assert "none, at" not in text
    assert text.endswith("2 rows: 1 survived, 1 lie.\n")
    assert np.isfinite(found["recovered_s"])


@pytest.mark.xfail(strict=True, reason="of centimetres by quality 1 learned shares stay open")
def test_nothing_wrong_is_within_a_decimetre(place: Place) -> None:
    """The bound of before fixes said by their velocities how much of their error lasts."""
    [none] = recorded_rows(place, [230.0], "none", "navigating")
    assert run_recorded(none, place)["largest_horizontal_m"] < 0.1


@pytest.mark.parametrize(
    ("fault", "event"),
    [("drift_0.1_m_s", "isolated"), ("mount_turned_10_deg", "sensor_fault")],
)
def test_what_lied_on_it_does_not(place: Place, fault: str, event: str) -> None:
    """A drift came back while it went on, hidden by the receiver's offset in time and a vehicle
    that braked; a unit that had turned was vouched for with a yaw between old and new."""
    [row] = recorded_rows(place, [230.0], fault, "navigating")
    found = run_recorded(row, place)
    assert found["verdict"] == "degraded and said so", found
    assert event in {e["code"] for e in found["events"]}
    assert found["longest_lie_s"] <= 2.0


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """Three minutes of a car with a consumer unit, a receiver of one fix a second and OBD speed."""
    if not BUS.is_file():
        pytest.skip(f"real drive css_164 is absent: {BUS} (set FUSIOND_DATA)")
    folder = tmp_path_factory.mktemp("bus")
    part = folder / "part.log.gz"
    with gzip.open(BUS, "rt") as whole, gzip.open(part, "wt", compresslevel=1) as some:
        for line in whole:
            if abs(float(line[1 : line.index(")")]) - LATE_FROM_S + 25.0) < 100.0:
                some.write(line)
    found = Place(REPOSITORY / "config" / "css_164.toml", part, folder / "smoothed.csv")
    smooth(found)
    return found


def test_fixes_that_become_late_are_not_followed(bus: Place) -> None:
    """The filter's offsets in time followed them, and the vehicle with them: eight sigma off for 35
    s of this part, and nothing told for the first 52."""
    log = read_can_log(bus.recording, load_config(bus.config))
    [row] = recorded_rows(bus, [LATE_FROM_S - log.imu.t_s[0]], "fixes_late_0.8s", "navigating")
    found = run_recorded(row, bus)
    assert found["verdict"] == "degraded and said so", found
    assert found["noticed_s"] < 10.0
    assert "isolated" in {event["code"] for event in found["events"]}
