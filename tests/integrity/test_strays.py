"""What the state of an error that fixes share leaves open once it is beyond chance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fusiond.aiding.base import State
from fusiond.aiding.position import PositionAid
from fusiond.configuration.schema import Config, Imu
from fusiond.configuration.settings import imu_noise
from fusiond.estimators.base import Outcome
from fusiond.integrity.hedge import SELDOM, STRAYS
from fusiond.integrity.isolation import Isolation
from fusiond.models.catalogue import make_model
from fusiond.models.vehicle import FIX_WANDER, fix_wander
from fusiond.navigation.error_model import DR, DV, PHI
from fusiond.navigation.strapdown import STEP_SIZE
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.aid_faults import drift
from fusiond.studies.faults.recording import Drive
from fusiond.studies.faults.runs import VEHICLE, navigate
from tests.integrity.series_bench import GATE, LEVER, NAV, SD_M

MODEL = make_model("ins15", imu_noise(Imu()), fix_wander(FIX_WANDER, 30.0))
NORTH, EAST = MODEL.slots_of(FIX_WANDER)
FIX = PositionAid("gnss", 0, GATE, NAV[0], NAV[1], 40.0, (SD_M,) * 3, LEVER)


def _covariance() -> np.ndarray:
    """Of states that all go together, after measurements: the wander's prior is of variance one."""
    rng = np.random.default_rng(4)
    root = rng.standard_normal((MODEL.size, MODEL.size)) / math.sqrt(MODEL.size)
    prior = root @ root.T
    scale = np.ones(MODEL.size)
    scale[[NORTH, EAST]] = 1.0 / np.sqrt(np.diag(prior)[[NORTH, EAST]])
    prior *= np.outer(scale, scale)
    h = rng.standard_normal((3, MODEL.size))
    return prior - prior @ h.T @ np.linalg.solve(h @ prior @ h.T + np.eye(3), h @ prior)


def _opened(p: np.ndarray, strays: float, slot: int = NORTH) -> np.ndarray | None:
    isolation, xi = Isolation(), np.zeros(MODEL.size)
    xi[slot] = strays
    state = State(NAV, xi, np.zeros(STEP_SIZE), MODEL, p)
    outcome = Outcome("fused", 1.0, 3, (0.0, 0.0, 0.0))
    isolation.judge(replace(FIX, wander=FIX_WANDER), outcome, NAV, p, state)
    return isolation.hedge.wider.get("gnss" + STRAYS)


@pytest.mark.parametrize("slot", [NORTH, EAST])
def test_an_estimate_beyond_chance_is_open_by_what_its_prior_holds_back(slot: int) -> None:
    """By as much as all states move once the prior is taken off, in information form."""
    p = _covariance()
    shown = 1.0 - p[slot, slot]
    estimate = 1.5 * math.sqrt(SELDOM * shown)
    without = np.linalg.inv(p)
    told = without[:, slot] * estimate  # of an estimate that is zero but for what goes with it
    xi = p[:, slot] / p[slot, slot] * estimate
    told = without @ xi
    without[slot, slot] -= 1.0
    moved = np.linalg.solve(without, told) - xi
    found = _opened(p, estimate, slot)
    assert found is not None
    beyond = 1.0 - SELDOM * shown / estimate**2
    assert found[:3] == pytest.approx(beyond * moved[DR : DR + 3] ** 2)
    assert found[3:6] == pytest.approx(beyond * moved[DV : DV + 3] ** 2)
    assert found[6:8] == pytest.approx(beyond * float(np.sum(moved[PHI : PHI + 2] ** 2)))
    assert found[8] == pytest.approx(beyond * moved[PHI + 2] ** 2)


def test_within_chance_nothing_is_open() -> None:
    p = _covariance()
    assert _opened(p, 0.99 * math.sqrt(SELDOM * (1.0 - p[NORTH, NORTH]))) is None
    known = np.eye(MODEL.size)
    assert _opened(known, 0.0) is None


@pytest.mark.parametrize(("drift_m_s", "least"), [(0.0, 1.0), (0.2, 1.5)])
def test_a_drift_that_is_not_told_yet_goes_beyond_what_fixes_share(
    drift_m_s: float, least: float
) -> None:
    """Of a simulated drive, by how much the published sigma is wider."""
    made = VEHICLE.model_dump(exclude_unset=True)
    made["aiding"]["gnss"].update(bias_sd_m=1.0)
    config = Config.model_validate(made)
    truth, recording = Drive(duration_s=150.0, gnss_rate_hz=1.0).recorded(config, seed=5)
    if drift_m_s:
        recording = drift(recording, 80.0, 60.0, drift_m_s)
    wider = [1.0]

    def watch(navigator: Navigator) -> None:
        opened = navigator.timeline.isolation.hedge.wider.get("gnss" + STRAYS)
        if opened is not None:
            own = navigator.estimator.covariance[DR, DR]
            wider.append(math.sqrt(1.0 + float(opened[0] / own)))

    navigate(config, recording, truth, watch)
    assert max(wider) > least if drift_m_s else max(wider) == least
