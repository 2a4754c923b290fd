"""Jumps of positions: within what their fixes share, or a fault."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.aiding.position import PositionMeasurement
from fusiond.estimators.base import Estimator
from fusiond.estimators.fault_bank_interface import Estimated
from fusiond.integrity.correlated_fix_jumps import renewed_slots
from fusiond.navigation.strapdown import NAV_SIZE
from fusiond.navigator.navigator import Navigator
from fusiond.studies.faults.matched_noise_drives import CODE, SHARING, Receiver, Vehicle
from fusiond.studies.faults.service import Job, service_run

BLOCKS = ("gnss_bias", "gnss_bias_down")
JUMP_SD_M = 0.6


def estimator(receiver: Receiver, north_m: float = 0.0) -> Estimator:
    """A filter that knows its position to a metre, and takes fixes for so far to the north."""
    found = Navigator(Vehicle("data sheet", receiver, told="noise").config()).estimator
    nav, xi = np.zeros(NAV_SIZE), np.zeros(found.model.size)
    xi[[slot for name in BLOCKS[:1] for slot in found.model.slots_of(name)][:1]] = north_m
    nav[0] = 0.8
    found.initialise(0, 0, nav, xi, np.eye(found.model.size))
    return found


def changed(
    of: Estimator,
    north_m: float,
    share: float = 1.0,
    bias: tuple[str, ...] = BLOCKS,
    less: float = 0.0,
) -> bool:
    at = 0.8, 0.1, 40.0
    fix = PositionMeasurement(
        *("gnss", 0, 0.9999, *at, (0.8, 0.8, 1.6), (0.0, 0.0, 0.0)),
        bias=bias,
        bias_share=(share,) * 3,
    )
    jump, n = np.array([north_m, 0.0, 0.0]), of.model.size
    known = JUMP_SD_M**2 * np.eye(3)
    step = Estimated(0, 0.0, 20.0, 30.0, jump, known, np.zeros(n), np.zeros((n, n)))
    return bool(renewed_slots(fix, of, step, less))


@pytest.mark.parametrize(
    ("was_m", "jump_m", "expected"),
    [
        (6.0, -6.0, True),
        (10.0, -12.0, True),
        (0.0, 2.0, True),
        (0.0, 20.0, False),
        (-6.0, -6.0, False),
    ],
)
def test_what_comes_back_to_where_it_may_be_has_renewed_slots(
    was_m: float, jump_m: float, expected: bool
) -> None:
    assert changed(estimator(SHARING, was_m), jump_m) is expected


def test_fixes_that_share_little_jump_by_little() -> None:
    of = estimator(SHARING)
    assert changed(of, 6.0)
    assert not changed(of, 6.0, share=0.01)


def test_what_a_drift_explains_better_is_a_drift() -> None:
    assert changed(estimator(SHARING, 6.0), -6.0, less=2.0)
    assert not changed(estimator(SHARING, 6.0), -6.0, less=20.0)


def test_of_fixes_that_share_nothing_every_jump_is_a_fault() -> None:
    assert not changed(estimator(CODE), 2.0, bias=())
    assert not changed(estimator(CODE), 2.0)  # the model has no state for it


def test_the_end_of_a_drift_too_slow_to_be_told_costs_no_service() -> None:
    """Fixes came back by 6 m after a minute: the position was out for eight minutes."""
    found = service_run(Job(0, SHARING.name, "position runs away, 0.1 m/s"), "looked")
    assert found["out_s"] == 0.0
    assert found["events"].get("fault_over") == 1
    assert not found["lies"]
    assert found["largest_m"] < 3.0
