"""Screened measurements in the federated filter: bad rows, a clock that is set, a receiver at
fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pytest

from fusiond.aiding.base import Linearised
from fusiond.aiding.position import PositionMeasurement
from fusiond.aiding.pseudorange import PseudorangeMeasurement, epoch_values
from fusiond.configuration.si_units import imu_noise
from fusiond.estimators.base import Estimator, Outcome
from fusiond.estimators.federated.isolation import INNOVATION
from fusiond.estimators.federated.no_reset import NoResetFilter
from fusiond.estimators.federated.options import FederatedOptions, Mode
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.gnss.nominal_constellation import EPOCH_S, Constellation, constellation
from fusiond.gnss.orbit import WEEK_S
from fusiond.models.blocks import CLOCK_OFFSET, clock_blocks
from fusiond.models.catalogue import make_model
from fusiond.navigator.assembly import federated
from tests import runs
from tests.estimators.screened_ranges import Ranges, ranges
from tests.estimators.town_drive import IMU, LEVER, SECONDS, begun, drive

MODES: tuple[Mode, ...] = ("no_reset", "fusion_reset", "zero_reset", "rescale")
MODEL = make_model("ins15", imu_noise(IMU), *clock_blocks(("G",)))


def through(estimator: Estimator, epochs: Sequence[Sequence[Linearised]]) -> list[Outcome]:
    """Apply all epochs, each measurement's outcome."""
    _, buffer, _, start, _ = drive()
    begun(estimator, start, runs.initial_sd(MODEL, np.radians([0.3, 0.3, 2.0]), 0.2, 3.0))
    outcomes = []
    for measurements in epochs:
        for measurement in measurements:
            estimator.propagate(buffer, measurement.t_ns)
            outcomes.append(estimator.update(measurement))
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
@pytest.mark.parametrize("names", [("raw", "gnss"), ("gnss",), ("gnss", "other")])
def test_a_bad_row_goes_alone_and_a_set_clock_is_found(mode: Mode, names: tuple[str, ...]) -> None:
    """Of a local filter's own and of a measurement common to all, one of whom has nothing else."""
    estimator = make(mode, names)
    outcomes = through(estimator, both(jump_at=25, wrong_at=20))
    assert {o.name for o in outcomes} == {"fused"}
    assert [o.degrees for o in outcomes if o.rows and any(o.rows)] == [5]
    slot = MODEL.slots_of(CLOCK_OFFSET)[0]
    assert abs(estimator.xi[slot] - 3000.0) < 5.0
    assert np.isfinite(estimator.covariance).all()
    assert estimator.isolated == {}


BAD, BAD_AT, SET_AT = "C38", 20, 25


def sky(range_error_m: float, set_at: int = 99) -> list[list[Linearised]]:
    """Velocity, ranges and rates to satellites, and a fix of a second receiver, each second.

    One range of epoch BAD_AT is off by `range_error_m`, not a number: not measured. The receiver's
    clock is at 5 m and from epoch `set_at` on at 3 km."""
    rng = np.random.default_rng(8)
    truth = runs.town_truth(SECONDS, IMU.rate_hz)
    of = Constellation(constellation(round(EPOCH_S / WEEK_S), 0.0, ("C",)))
    found: list[list[Linearised]] = []
    for k, (fix, velocity) in enumerate(drive()[2]):
        states = truth.at(np.array([fix.t_ns * 1e-9]), LEVER)
        lat, lon, height = (float(x) for x in states.position[0])
        up = of.line_of_sight(lat, lon, height, EPOCH_S + fix.t_ns * 1e-9).above(0.2)
        n = len(up.satellites)
        ranges_m = up.range_m + (3000.0 if k >= set_at else 5.0) + 3.0 * rng.standard_normal(n)
        if k == BAD_AT:
            ranges_m[up.satellites.index(BAD)] += range_error_m
        values = epoch_values(
            *(up.position_ecef_m, up.velocity_ecef_m_s, ranges_m),
            *(np.full(n, np.nan), np.full(n, 9.0), np.ones(n)),
        )
        raw = PseudorangeMeasurement(
            *("raw", fix.t_ns, 1 - 1e-9, up.satellites, values),
            *(np.zeros(n, dtype=np.int64), LEVER),
        )
        assert isinstance(fix, PositionMeasurement)
        found.append([velocity, raw, replace(fix, source="gnss")])
    return found


@pytest.mark.parametrize("mode", MODES)
def test_a_bad_satellite_is_refused_by_name_and_nobody_learns_of_it(mode: Mode) -> None:
    """Every filter is as if that range had not been measured."""
    bad, absent = make(mode), make(mode)
    epochs = sky(500.0)
    outcomes = through(bad, epochs)
    refused = [
        (k // 3, label)
        for k, (measurement, outcome) in enumerate(zip(chain(*epochs), outcomes, strict=True))
        if isinstance(measurement, PseudorangeMeasurement)
        for label, code in zip(measurement.labels, outcome.rows, strict=True)
        if code
    ]
    assert refused == [(BAD_AT, (BAD, "range"))]
    assert {o.name for o in outcomes} == {"fused"}
    assert all(not o.rows or not any(o.rows) for o in through(absent, sky(math.nan)))
    assert bad.nav == pytest.approx(absent.nav, rel=1e-12, abs=1e-9)
    assert bad.covariance == pytest.approx(absent.covariance, rel=1e-9, abs=1e-15)
    if isinstance(bad, NoResetFilter) and isinstance(absent, NoResetFilter):
        for name in ("raw", "gnss"):
            for own, other in zip(bad.local(name), absent.local(name), strict=True):
                assert own == pytest.approx(other, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("names", [("raw", "gnss"), ("gnss", "other")])
@pytest.mark.parametrize("mode", ["no_reset", "rescale"])
def test_every_filter_learns_that_a_clock_was_set(mode: Mode, names: tuple[str, ...]) -> None:
    """Of a measurement of its own source and of a common one: nobody goes on with the old
    offset."""
    epochs = sky(0.0, set_at=SET_AT)
    estimator = make(mode, names)
    assert isinstance(estimator, NoResetFilter)
    through(estimator, epochs[:SET_AT])
    slot = MODEL.slots_of(CLOCK_OFFSET)[0]

    def clocks() -> list[tuple[float, float]]:
        """Offset (m) and its sigma in each local filter."""
        found = [estimator.local(name) for name in names]
        # What a filter's error estimate says is to be added to a parameter.
        return [(float(estimator.xi[slot] + x[slot]), math.sqrt(p[slot, slot])) for x, p in found]

    knew = [sigma < 20.0 for _, sigma in clocks()]
    assert any(knew)
    for (offset, sigma), known in zip(clocks(), knew, strict=True):
        if known:
            assert abs(offset - 5.0) < 4.0 * sigma
    _, buffer, _, _, _ = drive()
    for measurements in epochs[SET_AT:]:
        for measurement in measurements:
            estimator.propagate(buffer, measurement.t_ns)
            assert estimator.update(measurement).name == "fused"
    for (offset, sigma), known in zip(clocks(), knew, strict=True):
        assert abs(offset - 3000.0) < 4.0 * sigma
        assert (sigma < 20.0) == known


@pytest.mark.parametrize("mode", MODES)
def test_a_receiver_whose_rows_all_fail_is_isolated(mode: Mode) -> None:
    """Its position is 300 m off from the tenth epoch: half of the ranges may be a clock, a position
    is not."""
    epochs = both()
    for measurements in epochs[10:]:
        raw = measurements[1]
        assert isinstance(raw, Ranges)
        moved = PositionMeasurement(
            *(raw.fix.source, raw.t_ns, raw.gate, raw.fix.lat_rad + 5e-5, raw.fix.lon_rad - 5e-5),
            *(raw.fix.height_m, raw.fix.sd, raw.fix.lever),
        )
        measurements[1] = replace(raw, fix=moved)
    estimator = make(mode)
    outcomes = through(estimator, epochs)
    assert estimator.isolated == {"raw": INNOVATION}
    raw_outcomes = [o for o in outcomes if o.rows]
    assert raw_outcomes[-1].name == "isolated"
    true = drive()[2][-1][0]
    assert isinstance(true, PositionMeasurement)
    assert abs(estimator.nav[0] - true.lat_rad) * 6.4e6 < 10.0
