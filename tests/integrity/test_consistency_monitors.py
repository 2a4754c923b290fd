"""Verdicts by source: what innovations show of its sigma, and what they cannot."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.aiding.base import AidingMeasurement
from fusiond.aiding.height import HeightMeasurement
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.pseudorange import RANGE_BIAS
from fusiond.aiding.rdss_position import BIAS_BLOCK, RdssPositionMeasurement
from fusiond.configuration.schema import Config
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Outcome
from fusiond.integrity.consistency_monitors import Verdicts
from fusiond.models.blocks import position_bias
from fusiond.models.catalogue import make_model
from fusiond.navigator.navigator import Navigator

HERE = 0.5, 1.9, 40.0
SD = 2.0, 2.0, 3.0
NO_LEVER = 0.0, 0.0, 0.0
CAR = {"imu": {"axes": ["+x", "-y", "-z"], "rate_hz": 100.0}}


def _fix(bias: tuple[str, ...]) -> PositionMeasurement:
    return PositionMeasurement("gnss", 0, 0.9999, *HERE, SD, NO_LEVER, bias=bias)


def _rdss() -> RdssPositionMeasurement:
    return RdssPositionMeasurement("rdss", 0, 0.9999, *HERE[:2], (400.0, 0.0, 400.0), NO_LEVER)


def _verdicts(*blocks: str) -> tuple[Verdicts, list[tuple[str, str]]]:
    told: list[tuple[str, str]] = []
    model = make_model(
        "ins15",
        imu_noise(Config.model_validate(CAR).imu),
        *(position_bias(name, 1.0, 600.0) for name in blocks),
    )
    return Verdicts(50, 0.01, model, lambda source, verdict: told.append((source, verdict))), told


def _hear(verdicts: Verdicts, measurement: AidingMeasurement, sd: float, rows: int = 2) -> None:
    for z in sd * np.random.default_rng(5).standard_normal((150, rows)):
        verdicts.judge(measurement, Outcome("fused", float(z @ z), rows, tuple(z.tolist())))
    verdicts.report()


def test_small_innovations_of_fixes_that_share_an_error_tell_nothing_of_sigma() -> None:
    """A receiver that is off by its whole sigma for minutes has innovations as small as one whose
    sigma is too large: nobody is told that it may be lowered."""
    verdicts, told = _verdicts("fix_bias")
    _hear(verdicts, _fix(("fix_bias",)), 0.3)
    assert told == [("gnss", "cannot_tell")]
    report = verdicts.reports()["gnss"]
    assert report.verdict == report.window_verdict == verdicts.verdict("gnss") == "cannot_tell"
    assert report.nis_average < report.nis_limits[0]


def test_small_innovations_of_errors_that_are_white_are_pessimistic() -> None:
    verdicts, told = _verdicts()
    _hear(verdicts, _fix(()), 0.3)
    assert told == [("gnss", "pessimistic")]
    assert verdicts.reports()["gnss"].verdict == "pessimistic"


def test_a_measurement_that_could_share_an_error_of_which_the_model_has_no_state_is_judged() -> (
    None
):
    verdicts, told = _verdicts()
    _hear(verdicts, _rdss(), 0.3)
    assert told == [("rdss", "pessimistic")]


def test_what_is_shared_does_not_excuse_innovations_that_are_too_large() -> None:
    verdicts, told = _verdicts("fix_bias", BIAS_BLOCK)
    _hear(verdicts, _fix(("fix_bias",)), 2.0)
    _hear(verdicts, _rdss(), 1.0)
    assert told == [("gnss", "optimistic"), ("rdss", "consistent")]


@pytest.mark.parametrize("sd", [0.2, 0.4])
def test_a_height_that_came_with_a_fix_shares_what_the_fix_does(sd: float) -> None:
    verdicts, told = _verdicts(BIAS_BLOCK)
    _hear(verdicts, HeightMeasurement("rdss_height", 0, 0.9999, 40.0, 30.0, (BIAS_BLOCK,)), sd, 1)
    _hear(verdicts, HeightMeasurement("barometer", 0, 0.9999, 40.0, 30.0), sd, 1)
    assert told == [("rdss_height", "cannot_tell"), ("barometer", "pessimistic")]


def test_the_navigator_judges_by_the_states_that_it_has() -> None:
    """Fixes, RDSS and raw data share an error by default, and none where `bias_sd_m` is 0."""
    for bias, word in (({}, "cannot_tell"), ({"bias_sd_m": 0.0}, "pessimistic")):
        config = Config.model_validate({**CAR, "aiding": {"rdss": dict(bias)}})
        navigator = Navigator(config)
        _hear(navigator.verdicts, _rdss(), 0.3)
        assert navigator.verdicts.verdict("rdss") == word
    raw = Config.model_validate({**CAR, "aiding": {"gnss": {"kind": "raw"}}})
    assert Navigator(raw).model.slots_of_all(RANGE_BIAS).size == 3
