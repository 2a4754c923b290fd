"""The calibration on disk: of this mounting it serves the next start, anything else is refused."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import pytest

from fusiond.aiding.fix_error_correlation import SHOWN
from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.schema import Config
from fusiond.live.calibration_keeper import CalibrationKeeper
from fusiond.navigator.aiding_drift_sigma_estimation import GRID as LEVELS
from fusiond.navigator.imu_vibration_noise_share import GRID
from fusiond.navigator.navigator import Navigator
from fusiond.navigator.saved_calibration import (
    SavedCalibration,
    load_calibration,
    mounting_digest,
    save_calibration,
)
from fusiond.navigator.saved_noise import SavedNoise

CONFIG: dict[str, Any] = {"constraints": {"non_holonomic": {"enabled": True}}}
VALUES = {"mounting_yaw_deg": (2.0, 0.2)}


def vehicle(folder: Path, **more: Any) -> Config:
    return Config.model_validate({**CONFIG, **more, "state_file": folder / "truck.json"})


def offered(config: Config) -> tuple[SavedCalibration | None, list[str]]:
    """What a navigator of that configuration takes up, and the events."""
    events: list[str] = []
    navigator = Navigator(config)
    CalibrationKeeper(
        config, Clock(config.clock), lambda code, text: events.append(code)
    ).restore_into(navigator)
    return navigator.calibration, events


def test_what_was_kept_is_taken_up(tmp_path: Path) -> None:
    config = vehicle(tmp_path)
    assert offered(config) == (None, [])
    saved = SavedCalibration(mounting_digest(config), VALUES)
    save_calibration(tmp_path / "truck.calibration.json", saved)
    assert offered(config) == (saved, [])


def test_what_is_taken_up_stands_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config, path = vehicle(tmp_path), tmp_path / "truck.calibration.json"
    with caplog.at_level("INFO", "fusiond"):
        offered(config)
        assert caplog.messages == [f"{path}: no saved calibration"]
        save_calibration(path, SavedCalibration(mounting_digest(config), VALUES))
        offered(config)
    assert caplog.messages[1:] == [f"{path}: mounting_yaw_deg"]


def test_another_mounting_voids_it(tmp_path: Path) -> None:
    saved = SavedCalibration(mounting_digest(vehicle(tmp_path)), VALUES)
    save_calibration(tmp_path / "truck.calibration.json", saved)
    turned = vehicle(tmp_path, imu={"mounting_deg": [0.0, 0.0, 2.0]})
    assert offered(turned) == (None, ["calibration_refused"])


@pytest.mark.parametrize(
    "damage",
    [
        {"values": {"mounting_yaw_deg": [2.0, 0.0]}},
        {"values": {"mounting_yaw_deg": [2.0]}},
        {"values": {"mounting_yaw_deg": ["2.0", 0.2]}},
        {"values": {"mounting_yaw_deg": [90.0, 0.2]}},
        {"version": 2},
        {"more": 1},
    ],
)
def test_what_is_no_calibration_is_put_aside(tmp_path: Path, damage: dict[str, Any]) -> None:
    config = vehicle(tmp_path)
    path = tmp_path / "truck.calibration.json"
    sound = {"configuration": mounting_digest(config), "values": {}, "version": 1}
    path.write_text(json.dumps({**sound, **damage}))
    assert offered(config) == (None, ["calibration_damaged"])
    assert not path.exists()
    assert path.with_name(path.name + ".bad").exists()
    assert offered(config) == (None, [])


@pytest.mark.parametrize(("age_s", "kept"), [(0.0, 0.2), (7 * 86400.0, 0.2 * math.exp(-1.0))])
def test_noise_counts_a_fifth_at_the_next_start_and_fades(
    tmp_path: Path, age_s: float, kept: float
) -> None:
    config = vehicle(tmp_path)
    fixes = {"gnss by code": (1.0,) * SHOWN}
    drifts = {"side_drift": (30.0, *(-5.0,) * len(LEVELS))}
    noise = SavedNoise(time.time() - age_s, fixes, 30.0, (-5.0,) * 3 * len(GRID), drifts)
    saved = SavedCalibration(mounting_digest(config), VALUES, noise)
    save_calibration(tmp_path / "truck.calibration.json", saved)
    found, events = offered(config)
    assert not events
    assert found is not None
    assert found.noise is not None
    assert found.noise.predictions == pytest.approx(30.0 * kept, rel=1e-3)
    level = (30.0 * kept, *(-5.0 * kept,) * len(LEVELS))
    assert found.noise.drifts["side_drift"] == pytest.approx(level, rel=1e-3)
    assert found.noise.fixes["gnss by code"] == pytest.approx((kept,) * SHOWN, rel=1e-3)
    navigator = Navigator(config)
    navigator.calibration = found
    assert navigator.shown_noise(None).predictions == found.noise.predictions


async def test_nothing_is_kept_before_it_navigates(tmp_path: Path) -> None:
    config = vehicle(tmp_path)
    keeper = CalibrationKeeper(config, Clock(config.clock), lambda code, text: None)
    navigator = Navigator(config)
    keeper.keep(1, navigator)
    await keeper.close(navigator)
    path = tmp_path / "truck.calibration.json"
    assert load_calibration(path, navigator.model, mounting_digest(config)) is None
