"""A clock whose drift runs on, and satellites whose orbits drift: what carriers make of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusiond.configuration.si_units import DEG, imu_noise
from fusiond.estimators.kalman import KalmanEstimator
from fusiond.models.catalogue import make_model
from fusiond.navigator.intake import Intake
from fusiond.navigator.intake.raw import CLOCK_RAMP
from fusiond.studies.bds_tight import runs
from fusiond.studies.live_filter import LiveFilter, drive_samples, drive_truth
from fusiond.studies.navigation_error import nav_error, true_nav, with_error

Array = NDArray[np.float64]

RAMP_M_S2 = -0.17


def test_a_clock_that_warms_is_followed() -> None:
    """Its drift by 0.17 m/s each second, as of a receiver on a walk: a minute tells it to 0.05."""
    simulated, _ = runs.observe("open", 45, 1)
    t_s = runs.epochs()[:60]
    simulated.clock_m[:60] += 0.5 * RAMP_M_S2 * t_s * t_s
    simulated.clock_drift_m_s[:60] += RAMP_M_S2 * t_s
    intake = Intake({"raw": runs.RAW})
    model = make_model("ins15", imu_noise(runs.IMU), *intake.extra_blocks())
    rng = np.random.default_rng([45, 1])
    level, height, velocity, tilt, heading = runs.START_SD
    sd = model.initial.copy()
    sd[:9] = [tilt * DEG, tilt * DEG, heading * DEG, *[velocity] * 3, *[level] * 2, height]
    nav = true_nav(drive_truth(), np.r_[0.0, t_s])
    started = with_error(nav[0], rng.standard_normal(9) * sd[:9])
    samples = drive_samples(runs.IMU, rng)
    live = LiveFilter(KalmanEstimator(model, runs.IMU.gap_s), runs.IMU.gap_s, samples, started, sd)
    raw = intake.receivers["raw"]
    for message in runs.broadcast(simulated):
        raw.learn(message)
    for k, t in enumerate(t_s):
        live.advance(t)
        live.advance(t, [raw.measurement(simulated.epoch(k), round(t * 1e9))])
    (slot,) = model.slots_of(CLOCK_RAMP)
    e = live.estimator
    found, sigma = float(e.xi[slot]), float(np.sqrt(e.covariance[slot, slot]))
    assert sigma < 0.06
    assert found == pytest.approx(RAMP_M_S2, abs=3.0 * sigma)
    velocity_error = nav_error(e.nav, nav[-1])[3:6]
    assert np.abs(velocity_error).max() < 0.1


def test_four_satellites_of_a_poor_geometry_are_not_believed() -> None:
    """DOP 40, all orbits drift by 0.7 mm/s one way: the place is carried along by 30 mm/s for 200
    s, to 5 m. With what they drift by at each anchor alone the mean NEES of three was 13.5, sigma
    1.2 m; a mean over 200 s, which is one draw, is above 7.8 once in twenty."""
    rng = np.random.default_rng([0, 2])
    samples, unit = drive_samples(runs.IMU, rng), rng.standard_normal(9)
    simulated, observed = runs.observe("canyon4", 0, 2)
    nothing = [None] * len(observed)
    row = runs._FILTERS["tight_ekf"]
    trace = runs._filter_trace(row, simulated, observed, nothing, samples, unit)
    stretch = runs.in_stretch(runs.epochs())
    assert trace.nees[stretch].mean() < 7.8
    assert np.abs(trace.error[stretch]).max() < 6.0
