"""Screened aids in the federated filter: bad rows, a clock that is set, a receiver at fault."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionAid
from fusiond.estimators.base import Estimator, Outcome
from fusiond.estimators.federated_options import FederatedOptions, Mode
from fusiond.estimators.isolation import INNOVATION
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.model import CLOCK_OFFSET, clock_blocks, make_model
from fusiond.filters import federated
from fusiond.settings import imu_noise
from tests import runs
from tests.test_estimator_multiscale import IMU, begun, drive
from tests.test_multiscale_screened import Ranges, ranges

MODES: tuple[Mode, ...] = ("no_reset", "fusion_reset", "zero_reset", "rescale")
MODEL = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))


def through(estimator: Estimator, epochs: list[list[Linearised]]) -> list[Outcome]:
    """Apply all epochs, each aid's outcome."""
    _, buffer, _, start, _ = drive()
    begun(estimator, start, runs.initial_sd(MODEL, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0))
    outcomes = []
    for aids in epochs:
        for aid in aids:
            estimator.propagate(buffer, aid.t_ns)
            outcomes.append(estimator.update(aid))
    return outcomes


def make(mode: Mode, names: tuple[str, ...] = ("raw", "gnss"), **options: Any) -> Estimator:
    return federated(MODEL, IMU.gap_s, names, FederatedOptions(mode=mode, **options))


def both(**options: Any) -> list[list[Linearised]]:
    """Ranges and velocity, and a fix of a second receiver."""
    epochs = ranges(drive()[2], **options)
    found = []
    for velocity, raw in epochs:
        assert isinstance(raw, Ranges)
        found.append([velocity, raw, replace(raw.fix, source="gnss")])
    return found


@pytest.mark.parametrize("mode", ["fusion_reset", "zero_reset"])
def test_with_a_reset_it_is_the_centralised_filter(mode: Mode) -> None:
    """A bad row and a set clock on the way."""
    epochs = both(jump_at=25, wrong_at=20)
    own, best = make(mode), KalmanEstimator(MODEL, IMU.gap_s)
    outcomes, expected = through(own, epochs), through(best, epochs)
    assert [o.name for o in outcomes] == [o.name for o in expected]
    assert [o.rows for o in outcomes] == [o.rows for o in expected]
    sigma = np.sqrt(np.diag(best.covariance)[:9])
    assert np.abs(runs.nav_error(own.nav, best.nav) / sigma).max() < 1e-4
    assert own.xi == pytest.approx(best.xi, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("names", [("raw", "gnss"), ("gnss",)])
def test_a_bad_row_goes_alone_and_a_set_clock_is_found(mode: Mode, names: tuple[str, ...]) -> None:
    """Of a local filter's own and of an aid common to all."""
    estimator = make(mode, names)
    outcomes = through(estimator, both(jump_at=25, wrong_at=20))
    assert {o.name for o in outcomes} == {"fused"}
    assert [o.degrees for o in outcomes if o.rows and any(o.rows)] == [5]
    slot = MODEL.slots_of(CLOCK_OFFSET)[0]
    assert abs(estimator.xi[slot] - 3000.0) < 5.0
    assert np.isfinite(estimator.covariance).all()
    assert estimator.isolated == {}


@pytest.mark.parametrize("mode", MODES)
def test_a_receiver_whose_rows_all_fail_is_isolated(mode: Mode) -> None:
    """Its position is 300 m off from the tenth epoch: half of the ranges may be a clock, a position
    is not."""
    epochs = both()
    for aids in epochs[10:]:
        raw = aids[1]
        assert isinstance(raw, Ranges)
        moved = PositionAid(
            *(raw.fix.source, raw.t_ns, raw.gate, raw.fix.lat_rad + 5e-5, raw.fix.lon_rad - 5e-5),
            *(raw.fix.height_m, raw.fix.sd, raw.fix.lever),
        )
        aids[1] = replace(raw, fix=moved)
    estimator = make(mode)
    outcomes = through(estimator, epochs)
    assert estimator.isolated == {"raw": INNOVATION}
    raw_outcomes = [o for o in outcomes if o.rows]
    assert raw_outcomes[-1].name == "isolated"
    true = drive()[2][-1][0]
    assert isinstance(true, PositionAid)
    assert abs(estimator.nav[0] - true.lat_rad) * 6.4e6 < 10.0
