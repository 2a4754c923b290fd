"""Which lever arms a filter estimates, of what the configuration says and leaves out."""

from __future__ import annotations

from typing import Any

import pytest

from fusiond.configuration.aiding import UNKNOWN_LEVER_SD_M
from fusiond.configuration.schema import Config
from fusiond.models.vehicle_parameter_blocks import ANTENNA_LEVER, FIX_MARKOV
from fusiond.navigator.navigator import Navigator


def _levers(**settings: Any) -> dict[str, float]:
    """The blocks of lever arms, with their priors (m)."""
    model = Navigator(Config.model_validate(settings)).model
    return {b.name: b.initial for b in model.blocks if b.name.startswith(ANTENNA_LEVER)}


def _wanders(**settings: Any) -> bool:
    """Whether the error that fixes share for seconds is a state."""
    return Navigator(Config.model_validate(settings)).model.slots_of(FIX_MARKOV) != []


@pytest.mark.parametrize(
    ("section", "sd_m"),
    [
        ({}, UNKNOWN_LEVER_SD_M),
        ({"bias_sd_m": 0.0}, UNKNOWN_LEVER_SD_M),
        ({"lever_arm_m": [0.0, 0.0, 0.0]}, 0.0),
        ({"lever_arm_m": [0.0, 0.0, -1.0]}, 0.0),
        ({"lever_arm_m": [0.0, 0.0, -1.0], "lever_arm_sd_m": 0.3}, 0.3),
        ({"lever_arm_sd_m": 2.0}, 2.0),
        ({"lever_arm_sd_m": 0.0}, 0.0),
    ],
)
def test_a_lever_arm_that_nobody_gave_is_estimated(section: dict[str, Any], sd_m: float) -> None:
    expected = {ANTENNA_LEVER: sd_m} if sd_m else {}
    assert _levers(aiding={"gnss": section}) == expected


def test_of_several_receivers_only_what_is_asked_for() -> None:
    two: dict[str, Any] = {"gnss": {}, "roof": {"kind": "gnss"}}
    assert _levers(aiding=two) == {}
    two["roof"]["lever_arm_sd_m"] = 0.5
    assert _levers(aiding=two) == {f"{ANTENNA_LEVER}_roof": 0.5}


def test_without_room_nothing_is_estimated_that_nobody_asked_for() -> None:
    full: dict[str, Any] = {
        "aiding": {
            "gnss": {},
            "wheel": {},
            "barometer": {},
            "rear": {"kind": "wheel", "drift_sd_m_s": 0.0},
        },
        "constraints": {"non_holonomic": {"enabled": True}},
    }
    assert _levers(**full) == {}
    del full["aiding"]["rear"]
    assert _levers(**full) == {ANTENNA_LEVER: UNKNOWN_LEVER_SD_M}
    assert not _wanders(**full)
    del full["aiding"]["barometer"]
    assert _wanders(**full)
