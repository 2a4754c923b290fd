"""Satellites that come by a wall alone, with truth: who is left out, and who is believed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.aiding.base import Linearised
from fusiond.configuration.aiding import RawAiding
from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.base import AS_STATED, Outcome
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.estimators.screening import KEPT
from fusiond.gnss.orbit import WEEK_S
from fusiond.models.catalogue import make_model
from fusiond.navigator.intake import Intake
from fusiond.simulation.gnss.raw import START, GnssRaw
from fusiond.studies.bds_tight import runs
from fusiond.studies.live_filter import DURATION_S, LiveFilter, drive_samples, drive_truth
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

SIGNALS = (("G", "1C"), ("G", "2L"), ("C", "2I"), ("C", "6I"))
EPOCHS, FROM = 250, 30


class Told(KalmanEstimator):
    """Keeps what became of the last measurement's rows."""

    rows: tuple[int, ...] = ()

    def update(self, measurement: Linearised, noise: Any = AS_STATED) -> Outcome:
        outcome = super().update(measurement, noise)
        self.rows = outcome.rows
        return outcome


class Scored(NamedTuple):
    """Ranges by whether they came straight and whether they were left out (2, 2), by how much the
    believed ones of those that did not were too long (m), horizontal errors (n,) m, NEES of three
    in the mean."""

    counts: NDArray[np.int64]
    believed_m: list[float]
    off_m: Any
    nees: float


def scored(per_hour: float, number: int) -> Scored:
    rng = np.random.default_rng([7, number])
    samples, unit = drive_samples(runs.IMU, rng), rng.standard_normal(9)
    options = replace(
        runs.OPTIONS,
        signals=SIGNALS,
        reflections_per_hour=per_hour,
    )
    begin = START[0], START[1] + rng.uniform(0.0, WEEK_S - DURATION_S)
    sim = GnssRaw(drive_truth(), options, rng, begin)
    intake = Intake({"raw": RawAiding(systems=("G", "C"), lever_arm_m=runs.LEVER)})
    model = make_model("ins15", imu_noise(runs.IMU), *intake.extra_blocks())
    level, height, velocity, tilt, heading = runs.START_SD
    sd = model.initial.copy()
    sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[level] * 2, height]
    t_s = runs.epochs()[:EPOCHS]
    nav = true_nav(drive_truth(), np.r_[0.0, t_s])
    estimator = Told(model, runs.IMU.gap_s)
    live = LiveFilter(estimator, runs.IMU.gap_s, samples, with_error(nav[0], unit * sd[:9]), sd)
    raw = intake.receivers["raw"]
    for message in runs.broadcast(sim):
        raw.learn(message)
    column = {name: k for k, name in enumerate(sim.satellites)}
    counts, believed, off, nees = np.zeros((2, 2), np.int64), [], [], []
    for k, t in enumerate(t_s):
        live.advance(t)
        measurement = raw.measurement(sim.epoch(k), round(t * 1e9))
        live.advance(t, [measurement])
        if k < FROM or measurement.memory.corrected is None:
            continue
        x, p = nav_error(estimator.nav, nav[k + 1])[6:], estimator.covariance[6:9, 6:9]
        off.append(np.hypot(*x[:2]))
        nees.append(x @ np.linalg.solve(p, x))
        labels = measurement.memory.corrected.measurement.labels
        for (name, what), code in zip(labels, estimator.rows, strict=True):
            if what != "range":
                continue
            more = float(sim.reflected_m[k, column[name]])
            counts[int(more > 0.0), int(code != KEPT)] += 1
            if more > 0.0 and code == KEPT:
                believed.append(more)
    return Scored(counts, believed, np.array(off), float(np.mean(nees)))


@pytest.mark.parametrize(("per_hour", "most_m"), [(0.0, 3.0), (60.0, 4.0)])
def test_who_is_left_out_and_who_is_believed(per_hour: float, most_m: float) -> None:
    """Sixty reflections an hour and satellite, 3 to 60 m longer for 20 s: a quarter of all ranges.
    Two runs of 500 s (of 30 an hour) had 0 of 16,129 sound ranges left out, and 22 % of 3,182 that
    were too long believed: half of these by less than 4.8 m, none by more than 11.3."""
    found = [scored(per_hour, number) for number in (0, 1)]
    counts = sum((f.counts for f in found), np.zeros((2, 2), np.int64))
    believed = [m for f in found for m in f.believed_m]
    assert counts[0, 1] <= 0.01 * counts[0].sum()
    if per_hour:
        assert counts[1].sum() > 500
        assert counts[1, 0] < 0.45 * counts[1].sum()
        assert max(believed) < 20.0
    assert max(f.off_m.max() for f in found) < most_m
    assert np.mean([f.nees for f in found]) < (4.2 if per_hour == 0.0 else 12.0)
